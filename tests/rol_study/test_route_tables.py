"""What the long measurement on the real route asks for, and how it keeps its tables."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from rol_beyond.motion import MotionModel
from rol_study import route_tables
from rol_study.oxford_route import RouteSession, published_motion
from rol_study.route_experiments import FilterRun, RouteExperiment

N = 30


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[SimpleNamespace]:
    """Note what each run is asked for, and give a run that is right."""
    truth = np.column_stack([np.arange(N), np.zeros((N, 2))])
    experiment = RouteExperiment(
        RouteSession("07", truth, np.diff(truth, axis=0)), np.zeros((9, 2)), route_tables.FrontEnd(),
        None, None, published_motion(), "01", 0.05, None,
    )  # fmt: skip
    noted = []

    def run(experiment, method, clouds, seed, *, recovery=None, **changes) -> FilterRun:
        noted.append(
            SimpleNamespace(
                experiment=experiment, method=method, recovery=recovery, changes=changes, seed=seed
            )
        )
        spread = np.full((N, 3, 3), np.nan) if method == "registration" else np.tile(np.eye(3), (N, 1, 1))
        return FilterRun(truth, spread, [], np.zeros(N, dtype=bool), np.ones(N), np.full(N, 100), np.ones(N))

    monkeypatch.setattr(route_tables, "experiment_of", lambda *a, **k: experiment)
    monkeypatch.setattr(route_tables, "sample_session", lambda experiment, seed: [])
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
    assert narrow == {"d_th_m": min(value for _, value in route_tables.SETTINGS["d_th [m]"])}
    factor = min(value for _, value in route_tables.SETTINGS["noise"])
    usual = route_tables.settings_for("paper")
    assert (
        quiet == pytest.approx({name: factor * getattr(usual.motion, name) for name in quiet})
        and len(quiet) == 3
    )


def test_registration_has_a_row_without_a_covariance(asked: list) -> None:
    (row,) = route_tables.measure_registration("", "07", 1)
    assert asked[0].method == row["method"] == "registration"
    assert row["rmse_m"] == 0.0 and "mean_nees" not in row
    (other,) = route_tables.measure_ingredients("", "07", "all of robust", 1)
    assert other["mean_nees"] == 0.0


def test_settings_are_not_judged_where_they_were_chosen() -> None:
    jobs = route_tables.list_tuned(["01", "02", "07"])
    assert {number for number, _, _ in jobs} == {"01", "07"} and len(set(jobs)) == len(jobs) == 18


def test_a_kept_table_is_no_more_and_no_less_than_the_jobs() -> None:
    for what, key in (("tuned", "what"), ("registration", "session"), ("ingredients", "without")):
        path = Path(__file__).resolve().parents[2] / "data" / "ablations" / f"route_{what}.csv"
        table = pd.read_csv(path, dtype={"session": str})
        assert not table.job.duplicated().any() and table[key].notna().all()
    ingredients = table.groupby("without").seed.nunique()
    assert set(ingredients.index) == set(route_tables.INGREDIENTS) and (ingredients >= 3).all()


def test_a_table_is_completed_and_nothing_is_measured_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = []

    def run(real_root: str, number: str, seed: int) -> list[dict]:
        measured.append((real_root, number, seed))
        return [{"session": number, "seed": seed, "rmse_m": 0.5 * seed}]

    monkeypatch.setitem(route_tables.MEASURES, "seeds", run)
    path, files = tmp_path / "route_seeds.csv", {"real_root": "real", "weights": ""}
    with ThreadPoolExecutor(1) as pool:
        route_tables.run_table(pool, "seeds", [("07", 1)], path, **files)
        route_tables.run_table(pool, "seeds", [("02", 3), ("07", 1)], path, **files)
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
