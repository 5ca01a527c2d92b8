"""Tables of the chapters on the real route."""

import numpy as np
import pandas as pd
import pytest

from rol_study import route_results as results
from rol_study.oxford_route import RouteSession
from rol_study.route_tables import CLASSES


def rows(**columns: list) -> pd.DataFrame:
    """Make runs with given columns, and others that are alike."""
    n = len(next(iter(columns.values())))
    usual = {"session": "02", "method": "paper", "seed": 1, "rmse_m": 1.0, "rmse_yaw_deg": 2.0}
    usual |= {"failures": 1, "rmse_sound_m": 0.5, **dict.fromkeys(CLASSES, 0.5)}
    return pd.DataFrame({name: [value] * n for name, value in usual.items()} | columns)


def papers() -> tuple[pd.DataFrame, pd.DataFrame]:
    """Make the paper's two tables for one session."""
    index = pd.Index(["seq01"], name="sequence")
    table2 = pd.DataFrame({"failures": [2], "rmse_m": [8.46], "rmse_yaw_deg": [5.43]}, index=index)
    return table2, pd.DataFrame({name: [0.3] for name in CLASSES}, index=index)


def test_the_curve_keeps_the_seeds_that_have_all_higher_qualities() -> None:
    runs = rows(
        session=["02", "02", "07", "07", "07", "07", "02"],
        seed=[1, 1, 1, 1, 2, 7, 1],
        fraction_1m=[0.4, 0.5, 0.4, 0.5, 0.5, 0.3, 0.35],
    )
    chosen = results.select_qualities(runs)
    assert 2 not in chosen.seed.to_numpy()  # session 07, seed 2 has no run at 40 %
    found = chosen.groupby("fraction_1m").agg(n=("seed", "size"), full=("is_complete", "all"))
    assert found.n.to_dict() == {0.3: 1, 0.35: 1, 0.4: 2, 0.5: 2}
    assert found.full.to_dict() == {0.3: False, 0.35: False, 0.4: True, 0.5: True}
    more = results.select_qualities(pd.concat([runs, rows(session=["07"], fraction_1m=[0.35])]))
    assert more[more.fraction_1m == 0.35].is_complete.all()


def test_both_methods_of_a_run_count_once() -> None:
    runs = pd.concat([rows(fraction_1m=[0.3, 0.4], method=[name] * 2) for name in ("paper", "robust")])
    chosen = results.select_qualities(pd.concat([runs, rows(session=["07"], fraction_1m=[0.4])]))
    assert chosen.groupby("fraction_1m").is_complete.all().to_dict() == {0.3: False, 0.4: True}


def test_the_papers_rows_stand_beside_ours() -> None:
    runs = rows(fraction_1m=[0.5, 0.5, 0.4], rmse_m=[1.0, 2.0, 3.0], rmse_sound_m=[1.0, 1.0, np.nan])
    table2, table3 = results.paper_tables(runs, *papers())
    assert table2["within 1 m [%]"].tolist() == ["40", "50", "the paper"]
    assert table2["RMSE [m]"].tolist() == ["3.00 ± 0.00", "1.50 ± 0.50", "8.46"]
    assert table2["RMSE [m], sound truth"].tolist() == ["3.00 ± 0.00", "1.00 ± 0.00", ""]
    assert table3["1 m, 2°"].tolist() == ["50.0 ± 0.0", "50.0 ± 0.0", "30.0"]
    alone = results.paper_tables(runs, None, None)[0]
    assert len(alone) == 2
    assert [len(table) for table in results.paper_tables(runs[:0], *papers())] == [0, 0]


def test_causes_keep_their_order_and_end_with_the_paper() -> None:
    causes = rows(cause=["b", "a", "b", "a"], fraction_1m=[0.4, 0.4, 0.5, 0.5], rmse_m=[1.0, 2.0, 3.0, 4.0])
    table = results.cause_table(causes, *papers())
    assert table.index.tolist() == ["b", "a", "the paper (mean)"]
    assert table["50 %"]["RMSE [m]"].tolist() == [3.0, 4.0, 8.46]
    assert table["40 %"]["failures"].tolist() == [1.0, 1.0, 2.0]
    assert table["40 %"]["1 m, 2° [%]"].tolist() == [50.0, 50.0, 30.0]


def test_odometries_are_compared_on_the_same_runs() -> None:
    runs = rows(
        fraction_1m=[0.4] * 3, odometry=["rall", "rall", "true"], seed=[1, 2, 2], rmse_m=[9.0, 3.0, 1.0]
    )
    groups = results.odometry_table(runs)
    assert groups.rmse_m.to_dict() == {(0.4, "02", "rall", "paper"): 3.0, (0.4, "02", "true", "paper"): 1.0}


def make_session(number: str, left_m: float) -> RouteSession:
    """Make a session of 400 m along x with a stop, whose odometry turns on meanwhile."""
    x = np.concatenate([np.arange(200.0), np.full(8, 199.0), np.arange(200.0, 400.0)])
    truth = np.column_stack([x, np.full(len(x), left_m), np.zeros(len(x))])
    increments = np.column_stack([np.diff(x), np.zeros((len(x) - 1, 2))])
    increments[200:204, 2] = np.deg2rad(1.0)
    return RouteSession(number, truth, increments, is_faulty=np.arange(len(x)) < 3)


def test_sessions_are_described() -> None:
    sessions = {"01": make_session("01", 0.0), "02": make_session("02", -0.7)}
    table = results.describe_sessions(sessions).set_index("session")
    assert table["offset [m]"].to_dict() == pytest.approx({"01": 0.0, "02": 0.7})
    assert table["length [km]"]["02"] == pytest.approx(0.399) and table["faulty scans"]["02"] == 3
    assert table["in the paper"].to_dict() == {"01": "map", "02": "seq01"}
    assert results.describe_sessions({"02": sessions["02"]})["offset [m]"].isna().all()
    assert results.largest_standing_turn(sessions.values()) == pytest.approx((4.0, 2.0))
    assert np.isnan(results.largest_standing_turn([])[0])


def test_errors_by_speed() -> None:
    truth = make_session("02", 0.0).truth
    truth = np.concatenate([truth, truth[-1] + np.outer(np.arange(1, 600), (3.0, 0.0, 0.0))])
    is_still = np.hypot(*np.gradient(truth[:, :2], axis=0).T) < 0.1
    off = np.where(is_still, 3.0, np.where(np.arange(len(truth)) < 408, 1.0, 2.0))
    estimate = truth + np.column_stack([np.zeros(len(truth)), off, np.where(off == 2.0, 0.1, 0.0)])
    numbers = results.errors_by_speed([estimate], [truth])
    assert numbers["still_m"] == pytest.approx(3.0) and numbers["slow_m"] == pytest.approx(1.0, abs=0.02)
    assert numbers["fast_m"] == pytest.approx(2.0, abs=0.02)
    assert numbers["heading_within"] == pytest.approx(100 * np.mean(off != 2.0))
    assert np.isnan(list(results.errors_by_speed([], []).values())).all()


def test_chance_grows_with_the_map() -> None:
    truth = np.zeros((5, 3))
    grid = np.stack(np.meshgrid(*[np.arange(-70.0, 70.0)] * 2), -1).reshape(-1, 2)
    assert results.fraction_by_chance(grid, truth) == 1.0
    assert results.fraction_by_chance(grid[grid[:, 0] < 0.0], truth) == pytest.approx(0.5, abs=0.1)


def test_places_compare_the_calibrations() -> None:
    runs = rows(
        place=["dcc"] * 4,
        fraction_1m=[0.47] * 4,
        method=["paper", "robust", "robust", "robust"],
        calibrated_on=["none", "dcc 01", "oxford 01", "oxford 01"],
        rmse_m=[0.4, 0.1, 0.2, 0.4],
        seed=[1, 1, 1, 2],
    )
    numbers = results.place_numbers(runs)
    assert numbers["dcc_47_robust_m"] == 0.1 and numbers["dcc_47_paper_failures"] == 1
    assert numbers["dcc_47_oxford_m"] == pytest.approx(0.3) and numbers["dcc_47_oxford_worst_m"] == 0.4
    assert [numbers[f"places_{name}"] for name in ("runs", "sessions", "failures")] == [1, 1, 4]
    table = results.place_table(runs)
    assert table["rmse_m"].loc[("dcc", "02", 0.47)].to_list() == pytest.approx([0.4, 0.1, 0.3])


def test_displaced_starts_are_counted() -> None:
    trials = pd.DataFrame({
        "distance_m": [5.0] * 3 + [20.0], "turn_deg": 5.0, "fraction_1m": [0.40, 0.40, 0.47, 0.40],
        "below_2m_s": [3.0, np.inf, 0.0, np.inf],
    })  # fmt: skip
    table = results.displaced_table(trials)
    assert table.loc[(5.0, 5.0)].to_list() == [50.0, 100.0] and table.loc[(20.0, 5.0), 0.40] == 0.0


def test_peers_share_sessions_and_seeds() -> None:
    tuned = rows(what=["both", "d_th of 0.25 m"], session=["07", "07"], method=["tuned"] * 2)
    registered = rows(session=["07", "02"], method=["registration"] * 2, rmse_m=[5.0, 99.0])
    runs = rows(session=["07", "07", "02"], seed=[1, 9, 1], rmse_m=[3.0, 99.0, 99.0])
    peers = results.peer_table(tuned, registered, runs)
    assert peers.rmse_m.to_dict() == {
        "registration alone": 5.0, "paper": 3.0, "paper with both": 1.0, "paper, d_th of 0.25 m": 1.0
    }  # fmt: skip


def test_trials_are_summarized() -> None:
    trials = pd.DataFrame(
        {
            "found_s": [1.0, 20.0, np.inf, np.inf],
            "is_lost_at_end": [False, False, True, False],
            "told_share": [0.5, 1.0, np.nan, np.nan],
            "n_particles": [10, 20, 30, 5],
            "seconds": [1.0, 2.0, 3.0, 4.0],
        }
    )
    numbers = results.trial_numbers(trials, within_s=10.0)
    assert numbers == {
        "found": 25.0, "median_s": 10.5, "wrong": 1.0, "particles": 30.0, "told": 75.0, "cpu_s": 2.5, "n": 4
    }  # fmt: skip


def test_mean_and_deviation_are_one_text() -> None:
    values = pd.Series([3.37, 4.75])
    assert results.spread(values) == "4.06 ± 0.69" and results.spread(values, 100.0, digits=0) == "406 ± 69"
