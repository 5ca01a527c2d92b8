"""What the long measurement on the real route asks for, and how it keeps its tables."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from rol_beyond.motion import MotionModel
from rol_data import rall
from rol_study import route_tables
from rol_study.filter_runs import FilterRun
from rol_study.oxford_route import RouteSession, published_motion
from rol_study.route_experiments import RouteExperiment

N = 30


def write_route(root: Path, number: str, n: int) -> None:
    """Write poses along a line, and as many increments."""
    for name in (f"{rall.POSES_PATH}/pose_xy_{number}.txt", f"{rall.ODOMETRY_PATH}/seq{number}_odom.txt"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(root / name, np.column_stack([np.arange(n), np.zeros((n, 2))]))


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[SimpleNamespace]:
    """Note what each run is asked for, and give a run that is right."""
    truth = np.column_stack([np.arange(N), np.zeros((N, 2))])
    experiment = RouteExperiment(
        RouteSession("07", truth, np.diff(truth, axis=0)), np.zeros((9, 2)), route_tables.FrontEnd(),
        None, truth, truth, None, published_motion(), "01", 0.05, None,
    )  # fmt: skip
    noted = []

    def run(experiment, method, clouds, seed, *, recovery=None, **changes) -> FilterRun:
        noted.append(
            SimpleNamespace(
                experiment=experiment,
                method=method,
                recovery=recovery,
                changes=changes,
                seed=seed,
                clouds=np.array(clouds),
            )
        )
        spread = np.full((N, 3, 3), np.nan) if method == "registration" else np.tile(np.eye(3), (N, 1, 1))
        is_lost, n_particles, update_ms = np.zeros(N, dtype=bool), np.full(N, 100), np.ones(N)
        return FilterRun(truth, spread, [], is_lost, n_particles, update_ms, pd.DataFrame())

    def prepare(real_root, number, front_end=None, max_scans=0, settings=None, odometry="rall"):
        session = replace(experiment.session, odometry=odometry)
        return replace(experiment, front_end=front_end or route_tables.FrontEnd(), session=session)

    monkeypatch.setattr(route_tables, "experiment_of", prepare)
    monkeypatch.setattr(route_tables, "sample_session", lambda experiment, seed: [np.ones((1, 2))] * N)
    monkeypatch.setattr(route_tables, "run_method", run)
    return noted


def test_each_ingredient_changes_one_thing(asked: list) -> None:
    for name in route_tables.INGREDIENTS:
        (row,) = route_tables.measure_ingredients("", "07", name, 3)
        assert row["without"] == name and row["seed"] == 3 and row["rmse_m"] == 0.0
    found = {
        name: (
            made.changes,
            made.experiment.motion == published_motion(),
            np.isfinite([made.recovery.detection.search_below, made.recovery.detection.lost_below]).all(),
            made.recovery.stationary_weight,
        )
        for name, made in zip(route_tables.INGREDIENTS, asked, strict=True)
    }
    usual = found.pop("all of robust")
    assert usual == ({}, True, True, 0.25) and {made.recovery.reference_contrast for made in asked} == {0.05}
    for name, given in found.items():
        assert sum(a != b for a, b in zip(given, usual, strict=True)) == 1, name
    assert not found["without recovery"][2]
    assert found["standing scans count in full"][3] == 1.0
    assert (
        asked[list(route_tables.INGREDIENTS).index(route_tables.UNCALIBRATED)].experiment.motion
        == MotionModel()
    )


def test_tuned_is_the_paper_with_the_best_of_the_swept_settings(asked: list) -> None:
    for what in route_tables.TUNED:
        (row,) = route_tables.measure_tuned("", "07", what, 2)
        assert (row["what"], row["method"], row["failures"]) == (what, "tuned", 0)
    both, narrow, quiet = (made.changes for made in asked)
    assert {made.method for made in asked} == {"paper"} and both == narrow | quiet
    assert narrow == {"d_th_m": 0.25}
    usual = route_tables.settings_for("paper")
    assert (
        quiet == pytest.approx({name: 0.2 * getattr(usual.motion, name) for name in quiet})
        and len(quiet) == 3
    )


def test_each_cause_changes_one_thing_but_the_last_two(asked: list) -> None:
    rows = route_tables.measure_causes("", "07", 0.47, 3)
    assert [row["cause"] for row in rows] == list(route_tables.CAUSES)
    assert {(row["fraction_1m"], row["seed"], row["method"]) for row in rows} == {(0.47, 3, "paper")}
    usual = asked[0]
    assert (usual.experiment.front_end.fraction_1m, usual.experiment.front_end.fraction_2m) == (0.47, 0.65)
    n_changed = [
        (made.changes != usual.changes)
        + (made.experiment.front_end != usual.experiment.front_end)
        + (not np.allclose(made.clouds, usual.clouds))
        for made in asked
    ]
    assert n_changed == [0, *[1] * (len(asked) - 3), 2, 2]
    assert not np.allclose(asked[-3].clouds, usual.clouds)  # the motion is left in the points


def test_better_points_and_another_odometry_are_run_with_both_methods(asked: list) -> None:
    rows = route_tables.measure_quality("", "07", 0.5, 2)
    rows += route_tables.measure_odometry("", "07", "true", 0.5, 2)
    assert [row["method"] for row in rows] == ["paper", "robust"] * 2 and rows[-1]["odometry"] == "true"
    assert {made.experiment.front_end.fraction_2m for made in asked} == {0.67}
    assert [made.experiment.session.odometry for made in asked] == ["rall"] * 2 + ["true"] * 2


def test_other_places_are_run_with_both_calibrations(asked: list, monkeypatch: pytest.MonkeyPatch) -> None:
    def prepare(real_root, number, front_end, *, place):
        experiment = route_tables.experiment_of(real_root, number, front_end)
        session = replace(experiment.session, place=place)
        return replace(experiment, session=session, motion=MotionModel(), reference_contrast=0.2)

    monkeypatch.setattr(route_tables, "prepare_experiment", prepare)
    rows = route_tables.measure_places("", "02", "dcc", 0.65, 0.78, 2)
    assert [(row["method"], row["calibrated_on"]) for row in rows] == [
        ("paper", "none"), ("robust", "dcc 01"), ("robust", "oxford 01")
    ]  # fmt: skip
    assert {(row["place"], row["fraction_1m"]) for row in rows} == {("dcc", 0.65)}
    _, own, oxford = (made.experiment for made in asked)
    assert (own.motion, own.reference_contrast) == (MotionModel(), 0.2)
    assert oxford.motion == published_motion() and oxford.reference_contrast == 0.172
    assert {made.experiment.front_end.fraction_2m for made in asked} == {0.78}
    assert all(made.changes == {} and made.recovery is None for made in asked)  # settings untouched


def test_other_places_are_judged_without_the_session_of_their_map(tmp_path: Path) -> None:
    assert route_tables.list_places(str(tmp_path)) == []
    for number in ("01", "02"):
        for path in (rall.PLACES["dcc"].poses, rall.PLACES["dcc"].odometry):
            (tmp_path / path.format(number)).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / path.format(number)).touch()
    jobs = route_tables.list_places(str(tmp_path))
    assert {job[:2] for job in jobs} == {("02", "dcc")} and {job[-1] for job in jobs} == {1, 2, 3}


def test_a_row_is_also_judged_without_scans_of_faulty_ground_truth(asked: list) -> None:
    route_tables.measure_registration("", "07", 1)
    experiment, run = asked[0].experiment, route_tables.run_method(asked[0].experiment, "paper", [], 1)
    shifted = replace(run, poses=run.poses + np.where(np.arange(N) < 3, 4.0, 0.0)[:, None] * (1.0, 0.0, 0.0))
    row = route_tables.row_of(experiment, shifted, "paper", 1)
    assert (row["n_faulty"], row["rmse_sound_m"]) == (0, row["rmse_m"]) and row["rmse_m"] > 1.0
    marked = replace(experiment, session=replace(experiment.session, is_faulty=np.arange(N) < 3))
    row = route_tables.row_of(marked, shifted, "paper", 1)
    assert (row["n_faulty"], row["rmse_sound_m"]) == (3, 0.0) and row["rmse_m"] > 1.0


def test_displaced_starts_share_their_points_and_directions(
    asked: list, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts = []

    def run(experiment, start, clouds, seed) -> np.ndarray:
        starts.append(start - experiment.session.truth[0])
        return np.linspace(9.0, 0.0, 31)

    monkeypatch.setattr(route_tables, "run_displaced", run)
    monkeypatch.setattr(route_tables, "cut_scans", lambda experiment, first, n_scans: experiment)
    rows = route_tables.measure_displaced("", "07", 0.4, 12, 3)
    assert [(row["distance_m"], row["turn_deg"]) for row in rows] == list(route_tables.DISPLACEMENTS)
    np.testing.assert_allclose(np.hypot(*np.array(starts)[:, :2].T), [5.0, 10.0, 20.0, 20.0])
    np.testing.assert_allclose(np.abs(np.rad2deg(starts))[:, 2], [5.0, 5.0, 5.0, 20.0])
    assert np.ptp(np.arctan2(*np.array(starts)[:, :2].T)) < 1e-9
    assert (rows[0]["below_5m_s"], rows[0]["below_2m_s"], rows[0]["error_m"]) == (3.5, np.inf, 0.0)


def test_settings_are_swept_past_the_best_of_the_first_sweep(asked: list) -> None:
    swept = {
        name: [row["value"] for row in route_tables.measure_settings("", "07", name, 0.4, 1)]
        for name in route_tables.SETTINGS
    }
    assert min(swept["d_th [m]"]) < 0.25 and min(swept["noise"]) < 0.2 and max(swept["lambda"]) > 80
    assert asked[-1].changes == pytest.approx({"forward_m": 1.0, "left_m": 0.6, "yaw_rad": np.deg2rad(2.0)})


def test_registration_has_a_row_without_a_covariance(asked: list) -> None:
    (row,) = route_tables.measure_registration("", "07", 1)
    assert asked[0].method == row["method"] == "registration"
    assert row["rmse_m"] == 0.0 and "mean_nees" not in row
    (other,) = route_tables.measure_ingredients("", "07", "all of robust", 1)
    assert other["mean_nees"] == 0.0


def test_settings_are_not_judged_where_they_were_chosen() -> None:
    jobs = route_tables.list_tuned(["01", "02", "07"])
    assert {number for number, _, _ in jobs} == {"01", "07"} and len(set(jobs)) == len(jobs) == 18


def test_sessions_are_those_of_the_paper_whatever_else_lies_there(tmp_path: Path) -> None:
    for number in ("01", "02", "03", "07", "08", "10", "44"):
        write_route(tmp_path, number, n=600)
    jobs = route_tables.list_jobs(str(tmp_path))
    assert {job[0] for job in jobs["seeds"]} == {"01", *route_tables.PAPER_SESSIONS}
    assert {job[0] for job in jobs["quality"]} == set(route_tables.PAPER_SESSIONS)
    assert all(set(job[:1]) <= set(route_tables.PAPER_SESSIONS) for job in jobs["kidnapped"] + jobs["causes"])
    assert set(jobs) == set(route_tables.MEASURES)
    assert all(isinstance(job[-1], int) for listed in jobs.values() for job in listed)  # the seed


def test_a_kept_table_is_no_more_and_no_less_than_the_jobs() -> None:
    for what, key in (("tuned", "what"), ("registration", "session"), ("ingredients", "without")):
        path = Path(__file__).resolve().parents[2] / "data" / "ablations" / f"route_{what}.csv"
        table = pd.read_csv(path, dtype={"session": str})
        assert not table.job.duplicated().any() and table[key].notna().all()
    ingredients = table.groupby("without").seed.nunique()
    assert set(ingredients.index) == set(route_tables.INGREDIENTS) and (ingredients >= 3).all()


def test_the_kept_runs_at_other_places_are_whole_sessions() -> None:
    table = route_tables.load_table(Path(__file__).resolve().parents[2] / "data" / "ablations", "places")
    assert (table.groupby("job").size() == 3).all()  # paper, and robust with both calibrations
    found = {(place, quality) for place, quality in zip(table.place, table.fraction_1m, strict=True)}
    listed = route_tables.PLACE_QUALITIES.items()
    assert found == {(place, quality) for place, pairs in listed for quality, _ in pairs}
    assert set(table.session) == {"02", "03"} and table.n_scans.min() > 3000


def test_a_table_is_completed_and_nothing_is_measured_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = []

    def run(real_root: str, number: str, seed: int) -> list[dict]:
        measured.append((real_root, number, seed))
        return [{"session": number, "seed": seed, "rmse_m": 0.5 * seed}]

    monkeypatch.setitem(route_tables.MEASURES, "seeds", run)

    def few(job: tuple) -> bool:
        return job[-1] < 9

    path, files = tmp_path / "route_seeds.csv", {"real_root": "real", "weights": ""}
    with ThreadPoolExecutor(1) as pool:
        route_tables.run_table(pool, "seeds", [("07", 1)], path, **files)
        route_tables.run_table(pool, "seeds", [("02", 3), ("07", 1), ("07", 9)], path, is_chosen=few, **files)
    assert measured == [("real", "07", 1), ("real", "02", 3)]
    table = pd.read_csv(path, dtype={"session": str})
    assert table.job.tolist() == ["02 3", "07 1"] and table.rmse_m.tolist() == [1.5, 0.5]
    before = path.read_bytes()
    with (
        ThreadPoolExecutor(1) as pool,
        pytest.raises(ValueError, match="1 jobs are not listed, such as '02 3'"),
    ):
        route_tables.run_table(pool, "seeds", [("07", 1)], path, **files)
    assert path.read_bytes() == before


def test_stored_runs_carry_their_quality_and_odometry(tmp_path: Path) -> None:
    assert len(route_tables.load_runs(tmp_path)) == 0 and len(route_tables.load_table(tmp_path, "seeds")) == 0
    run = {"session": "02", "method": "paper", "seed": 1, "rmse_m": 1.0, "rmse_yaw_deg": 2.0, "failures": 1}
    run |= {name: 0.5 for name in route_tables.CLASSES}
    for what, more in (
        ("seeds", [{"rmse_m": 3.0}, {"session": "10", "seed": 2, "failures": 2}]),
        ("quality", [{"fraction_1m": 0.5}]),
        ("odometry", [{"fraction_1m": 0.4, "odometry": "true"}]),
    ):
        pd.DataFrame([run | change for change in more]).to_csv(tmp_path / f"route_{what}.csv", index=False)
    runs = route_tables.load_runs(tmp_path)
    assert runs[["session", "fraction_1m", "odometry"]].to_numpy().tolist() == [
        ["02", 0.4, "rall"], ["10", 0.4, "rall"], ["02", 0.5, "rall"], ["02", 0.4, "true"]
    ]  # fmt: skip
    groups = route_tables.summarize_runs(runs, ["fraction_1m", "odometry"])
    row = groups.loc[(0.4, "rall")]
    assert (row.n_runs, row.n_sessions, row.n_seeds) == (2, 2, 2) and row.failures == 1.5
    assert (row.rmse_m, row.min_m, row.max_m, row.within_1m_2deg) == (2.0, 1.0, 3.0, 50.0)
