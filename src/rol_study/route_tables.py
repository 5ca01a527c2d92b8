"""Runs of the filters on the real route over many seeds, settings and wrong starts, as tables;
hours of filtering.

A table is written row by row; a run that was stopped continues where it ended.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from rol.evaluation import METRICS, pose_errors, rmse
from rol.files import write_text
from rol.mcl import MclSettings, Measurement
from rol.pix2pix import load_network
from rol_beyond import unet  # noqa: F401 (registers its architecture)
from rol_beyond.consistency import consistency
from rol_beyond.motion import MotionModel
from rol_beyond.recovery import DetectionSettings, RecoverySettings
from rol_beyond.robust import settings_for
from rol_data.rall import PLACES, POSES_PATH, load_poses
from rol_study.filter_runs import FilterRun
from rol_study.oxford_route import list_sessions, published_motion, published_reference_contrast
from rol_study.rendered_points import build_segment, render_points
from rol_study.route_experiments import (
    CELL_M,
    RouteExperiment,
    add_outliers,
    change_front_end,
    cut_scans,
    displace,
    first_lasting,
    kidnap,
    localize_globally,
    prepare_experiment,
    run_displaced,
    run_method,
    sample_session,
    skew_by_motion,
)
from rol_study.sampled_points import FrontEnd, fraction_within_2m

PAPER_SESSIONS = PLACES["oxford"].main_sessions  # Seq01 to Seq04 of the paper; session 01 made the map
SHORT = 3000  # scans of the runs that compare settings
# Fractions within 1 m; 0.40 is the table "seeds". A lost filter takes minutes, so the poorest come last.
QUALITIES = (0.44, 0.47, 0.50, 0.60, 0.80, 0.35, 0.30)
COMPARED = (0.40, 0.47)  # qualities at which settings and causes are compared
# Fractions within 1 m and 2 m at other places: KAIST's map is too dense for 47 %.
PLACE_QUALITIES = {"kaist": ((0.65, 0.78),), "dcc": ((0.47, 0.65), (0.65, 0.78))}
DEG = float(np.deg2rad(1.0))
SETTINGS = {
    "particles": [("n_particles", n) for n in (50, 100, 500, 2000)],
    "lambda": [("exponent", value) for value in (1.0, 5.0, 20.0, 80.0, 320.0)],
    "d_th [m]": [("d_th_m", value) for value in (0.125, 0.25, 0.5, 1.0, 2.0)],
    "noise": [("noise", value) for value in (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)],
}
FLAT = {"exponent": 1.0}
TWICE = {"forward_m": 1.0, "left_m": 0.6, "yaw_rad": 2.0 * DEG}
LASTING = {"persistent_fraction": 1.0, "life_scans": 40.0}
# What could make the paper's errors larger: changes of the filter, of the points, and whether motion is
# compensated.
CAUSES = {
    "as in the tables": ({}, {}, True),
    "flat weights": (FLAT, {}, True),
    "twice the motion noise": (TWICE, {}, True),
    "matching distance of 2 m": ({"d_th_m": 2.0}, {}, True),
    "100 points a scan": ({}, {"n_points": 100}, True),
    "all false points last for 10 s": ({}, LASTING, True),
    "motion not compensated": ({}, {}, False),
    "flat weights and motion not compensated": (FLAT, {}, False),
    "flat weights and lasting false points": (FLAT, LASTING, True),
}
COMPARED_ODOMETRIES = ("true", "cfear")
CLASSES = ("within_1m_2deg", "within_2m_5deg", "within_5m_10deg")
# Read as text: pandas reads "true" as a truth value and "01" as a number.
TEXT = dict.fromkeys(("job", "session", "odometry"), str)
RUN_COLUMNS = ["fraction_1m", "odometry", *METRICS]
INGREDIENTS = {
    "all of robust": {},
    "all places of the map alike": {"density_radius_m": 0.0},
    "a hard threshold": {"measurement": Measurement(cell_m=0.25)},
    "plain resampling after each scan": {"scheme": "multinomial", "ess_fraction": 1.0},
    "lambda of 60": {"exponent": 60.0},
}
UNCALIBRATED = "motion as measured, not learnt"
# Ingredients that are no settings of the filter itself.
RECOVERIES = {
    "without recovery": {"detection": DetectionSettings(search_below=-np.inf, lost_below=-np.inf)},
    "standing scans count in full": {"stationary_weight": 1.0},
}
INGREDIENTS |= {name: {} for name in (*RECOVERIES, UNCALIBRATED)}
# Wrong starts of the method `paper`: distance [m] and turn [deg]. The last is that of the table "kidnapped".
DISPLACEMENTS = ((5.0, 5.0), (10.0, 5.0), (20.0, 5.0), (20.0, 20.0))
NARROW = {"d_th_m": 0.25}  # the best of the first sweep on session 02, whose ends these were
QUIET = {"forward_m": 0.1, "left_m": 0.06, "yaw_rad": 0.2 * DEG}
TUNED = {"both": NARROW | QUIET, "d_th of 0.25 m": NARROW, "a fifth of the noise": QUIET}


@lru_cache(maxsize=1)
def session_of(
    real_root: str,
    number: str,
    max_scans: int = 0,
    settings: MclSettings | None = None,
    odometry: str = "rall",
) -> RouteExperiment:
    """Prepare the experiment once per worker and session, with the paper's front end."""
    how = {"max_scans": max_scans, "settings": settings, "odometry": odometry}
    return prepare_experiment(real_root, number, FrontEnd(), **how)


@lru_cache(maxsize=1)
def experiment_of(
    real_root: str, number: str, front_end: FrontEnd | None = None, max_scans: int = 0, **how: object
) -> RouteExperiment:
    """Prepare the experiment once per worker, session and front end."""
    experiment = session_of(real_root, number, max_scans, **how)
    return experiment if front_end is None else change_front_end(experiment, front_end)


def front_end_of(fraction_1m: float, **changes: float) -> FrontEnd:
    """Return the front end with a fraction of its points within 1 m,
    and `fraction_within_2m` of it within 2 m."""
    return FrontEnd(fraction_1m, fraction_within_2m(fraction_1m), **changes)


def row_of(experiment: RouteExperiment, run: FilterRun, method: str, seed: int) -> dict:
    """Compute the metrics of one run."""
    truth, errors = experiment.session.truth, pose_errors(run.poses, experiment.session.truth)
    row = run.summarize(truth, method, experiment.session.number, seed)
    is_faulty = experiment.session.is_faulty
    is_sound = np.ones(len(truth), dtype=bool) if is_faulty is None else ~is_faulty
    return row | {
        "n_faulty": int((~is_sound).sum()),
        "rmse_sound_m": rmse(errors.position_m[is_sound]),
        "median_m": float(np.median(errors.position_m)),
        "median_yaw_deg": float(np.rad2deg(np.median(np.abs(errors.yaw_rad)))),
        "largest_m": float(errors.position_m.max()),
        "lost_share": float(run.is_lost.mean()),
        "n_particles": float(run.n_particles.mean()),
        **(consistency(run.poses, truth, run.covariances) if np.isfinite(run.covariances).all() else {}),
    }


def measure(real_root: str, weights: str, what: str, key: tuple) -> list[dict]:
    """Run one job; return its rows, each with the job's key.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    weights : path
        Network of the table "rendered".
    what : str
        Name of the table, one of `MEASURES`.
    key : tuple
        The job, from `list_jobs`.
    """
    own = {"weights": weights} if what == "rendered" else {}
    return [{"job": " ".join(map(str, key)), **row} for row in MEASURES[what](real_root, *key, **own)]


def run_both(experiment: RouteExperiment, clouds: list[np.ndarray], seed: int, **about: object) -> list[dict]:
    """Run both methods on the same points; each row begins with the columns `about`."""
    return [
        about | row_of(experiment, run_method(experiment, method, clouds, seed), method, seed)
        for method in ("paper", "robust")
    ]


def measure_seeds(real_root: str, number: str, seed: int) -> list[dict]:
    """Run both methods over a whole session."""
    experiment = experiment_of(real_root, number)
    return run_both(experiment, sample_session(experiment, seed), seed)


def measure_quality(real_root: str, number: str, fraction_1m: float, seed: int) -> list[dict]:
    """Run both methods over a whole session with points of another quality."""
    experiment = experiment_of(real_root, number, front_end_of(fraction_1m))
    return run_both(experiment, sample_session(experiment, seed), seed, fraction_1m=fraction_1m)


def measure_odometry(real_root: str, number: str, odometry: str, fraction_1m: float, seed: int) -> list[dict]:
    """Run both methods over a whole session with another odometry, each calibrated on it."""
    experiment = experiment_of(real_root, number, front_end_of(fraction_1m), odometry=odometry)
    about = {"odometry": odometry, "fraction_1m": fraction_1m}
    return run_both(experiment, sample_session(experiment, seed), seed, **about)


def measure_places(
    real_root: str, number: str, place: str, fraction_1m: float, fraction_2m: float, seed: int
) -> list[dict]:
    """Run both methods over a whole session of another place, with all settings as on Oxford.

    The method `robust` is run twice: with motion model and reference contrast of another session of the same
    place, and with those of Oxford's session 01.
    """
    own = prepare_experiment(real_root, number, FrontEnd(fraction_1m, fraction_2m), place=place)
    reference = published_reference_contrast(fraction_1m)
    oxford = replace(own, motion=published_motion(), reference_contrast=reference)
    clouds, rows = sample_session(own, seed), []
    for method, experiment, calibrated_on in (
        ("paper", own, "none"),
        ("robust", own, f"{place} {own.calibration_session}"),
        ("robust", oxford, "oxford 01"),
    ):
        about = {"place": place, "fraction_1m": fraction_1m, "calibrated_on": calibrated_on}
        rows.append(about | row_of(experiment, run_method(experiment, method, clouds, seed), method, seed))
    return rows


def measure_causes(real_root: str, number: str, fraction_1m: float, seed: int) -> list[dict]:
    """Run the method `paper` with one possible cause of larger errors after the other."""
    rows = []
    for name, (settings, points, is_compensated) in CAUSES.items():
        experiment = experiment_of(real_root, number, front_end_of(fraction_1m, **points), SHORT)
        clouds = sample_session(experiment, seed)
        if not is_compensated:
            clouds = skew_by_motion(clouds, experiment.session.true_increments)
        run = run_method(experiment, "paper", clouds, seed, **settings)
        about = {"cause": name, "fraction_1m": fraction_1m}
        rows.append(about | row_of(experiment, run, "paper", seed))
    return rows


def measure_settings(real_root: str, number: str, what: str, fraction_1m: float, seed: int) -> list[dict]:
    """Run the method `paper` with each value of a setting."""
    experiment, rows = experiment_of(real_root, number, front_end_of(fraction_1m), SHORT), []
    clouds = sample_session(experiment, seed)
    for setting, value in SETTINGS[what]:
        changes = {setting: value}
        if setting == "noise":
            changes = {"forward_m": 0.5 * value, "left_m": 0.3 * value, "yaw_rad": value * DEG}
        run = run_method(experiment, "paper", clouds, seed, **changes)
        about = {"what": what, "value": value, "fraction_1m": fraction_1m}
        rows.append(about | row_of(experiment, run, "paper", seed))
    return rows


def measure_ingredients(real_root: str, number: str, without: str, seed: int) -> list[dict]:
    """Run the method `robust` over a whole session with one of its ingredients changed."""
    changes = INGREDIENTS[without]
    experiment = experiment_of(real_root, number, settings=settings_for("robust", **changes))
    if without == UNCALIBRATED:
        experiment = replace(experiment, motion=MotionModel())
    recovery = RecoverySettings(experiment.reference_contrast, **RECOVERIES.get(without, {}))
    run = run_method(
        experiment, "robust", sample_session(experiment, seed), seed, recovery=recovery, **changes
    )
    return [{"without": without, **row_of(experiment, run, "robust", seed)}]


def measure_tuned(real_root: str, number: str, what: str, seed: int) -> list[dict]:
    """Run the method `paper` over a whole session with the settings that were best on the first scans of
    session 02."""
    experiment = experiment_of(real_root, number)
    run = run_method(experiment, "paper", sample_session(experiment, seed), seed, **TUNED[what])
    return [{"what": what, **row_of(experiment, run, "tuned", seed)}]


def measure_registration(real_root: str, number: str, seed: int) -> list[dict]:
    """Run scan-to-map ICP without a filter over a whole session."""
    experiment = experiment_of(real_root, number)
    run = run_method(experiment, "registration", sample_session(experiment, seed), seed)
    return [row_of(experiment, run, "registration", seed)]


def measure_outliers(real_root: str, number: str, share: float, seed: int) -> list[dict]:
    """Run both methods with outliers in the odometry."""
    experiment = experiment_of(real_root, number, None, SHORT)
    session = add_outliers(experiment.session, share, np.random.default_rng(seed))
    clouds = sample_session(experiment, seed)
    return run_both(replace(experiment, session=session), clouds, seed, share=share)


def measure_rendered(
    real_root: str, number: str, first: int, n_scans: int, seed: int, *, weights: str
) -> list[dict]:
    """Run both methods on points generated from the simulated radar,
    on a segment that the network was not trained on."""
    torch.set_num_threads(1)
    experiment = experiment_of(real_root, number, FrontEnd(0.80, 0.88))
    simulated = build_segment(real_root, number, first, n_scans, seed)
    clouds = list(render_points(simulated, load_network(weights)))
    return run_both(cut_scans(experiment, first, n_scans), clouds, seed)


def measure_trial(what: str):
    """Run the trial of a wrong start."""

    def trial(real_root: str, number: str, first: int, seed: int) -> list[dict]:
        found = {"kidnapped": kidnap, "anywhere": localize_globally}[what](
            experiment_of(real_root, number), first, seed
        )[0]
        return [{"session": number, "first": first, "seed": seed, **vars(found)}]

    return trial


def measure_displaced(real_root: str, number: str, fraction_1m: float, first: int, seed: int) -> list[dict]:
    """Run the method `paper` from wrong poses for a minute; a row has the times from which on the position
    error is below 5 m and 2 m for two seconds."""
    front_end, settings = front_end_of(fraction_1m), settings_for("paper", cell_m=CELL_M)
    experiment = cut_scans(experiment_of(real_root, number, front_end, settings=settings), first, 240)
    clouds, rows = sample_session(experiment, seed), []
    for distance_m, turn_deg in DISPLACEMENTS:
        rng = np.random.default_rng([seed, first, 2])
        start = displace(experiment.session.truth[0], distance_m, np.deg2rad(turn_deg), rng)
        errors_m = run_displaced(experiment, start, clouds, seed)
        rows.append({
            "session": number, "first": first, "seed": seed, "fraction_1m": fraction_1m,
            "distance_m": distance_m, "turn_deg": turn_deg, "below_5m_s": first_lasting(errors_m < 5.0),
            "below_2m_s": first_lasting(errors_m < 2.0), "error_m": errors_m[-1],
        })  # fmt: skip
    return rows


MEASURES = {
    "seeds": measure_seeds,
    "quality": measure_quality,
    "causes": measure_causes,
    "settings": measure_settings,
    "odometry": measure_odometry,
    "places": measure_places,
    "ingredients": measure_ingredients,
    "tuned": measure_tuned,
    "registration": measure_registration,
    "outliers": measure_outliers,
    "rendered": measure_rendered,
    "kidnapped": measure_trial("kidnapped"),
    "displaced": measure_displaced,
    "anywhere": measure_trial("anywhere"),
}


def list_jobs(real_root: str) -> dict[str, list[tuple]]:
    """List the jobs of each table; each ends with its seed. Wrong starts are drawn once,
    from sessions 02 and 07."""
    numbers, rng = list_sessions(real_root), np.random.default_rng(2020)
    ours = [number for number in ("01", *PAPER_SESSIONS) if number in numbers] or numbers
    driven = [number for number in ours if number != "01"] or ours
    starts = [number for number in ("02", "07") if number in numbers] or driven
    lengths = {number: len(load_truth(real_root, number)) for number in starts}

    def places(n: int, seconds: float) -> list[tuple]:
        picked = [starts[k % len(starts)] for k in range(n)]
        return sorted(
            (name, int(rng.integers(100, lengths[name] - 4 * seconds)), k) for k, name in enumerate(picked)
        )

    first, wrong_starts = driven[0], places(100, 15)
    last_first = sorted(driven, key=lambda number: (number not in (first, driven[-1]), number))
    return {
        "seeds": [(number, seed) for seed in range(1, 11) for number in ours],
        "kidnapped": wrong_starts,
        "displaced": [(n, q, first, k) for q in COMPARED for n, first, k in wrong_starts],
        "quality": [(number, q, seed) for q in QUALITIES for number in last_first for seed in (1, 2, 3)],
        "causes": [(n, q, seed) for n in last_first[:2] for q in COMPARED for seed in (1, 2, 3)],
        "settings": [
            (n, what, q, seed)
            for n in last_first[:2]
            for what in (SETTINGS if n == first else ["particles"])
            for q in COMPARED
            for seed in (1, 2, 3)
        ],
        "odometry": list_odometry(last_first[:2]),
        "places": list_places(real_root),
        "outliers": [(first, share, seed) for share in (0.015, 0.05) for seed in (1, 2, 3)],
        "anywhere": places(50, 120),
        "ingredients": [(starts[-1], name, seed) for name in INGREDIENTS for seed in (1, 2, 3, 4, 5)],
        "tuned": list_tuned(ours),
        "registration": [(number, seed) for seed in (1, 2, 3) for number in ours],
        "rendered": [key for key in (("02", 6000, 400, 1), ("07", 5050, 400, 1)) if key[0] in numbers],
    }


def list_tuned(numbers: list[str]) -> list[tuple]:
    """List the jobs with tuned settings, without the session that they were tuned on."""
    judged = [number for number in numbers if number != "02"]
    return [(number, what, seed) for number in judged for what in TUNED for seed in (1, 2, 3)]


def list_odometry(numbers: list[str]) -> list[tuple]:
    """List the jobs with another odometry; CFEAR's is published for sessions 01 and 02."""
    wanted = [
        (number, name)
        for number in numbers
        for name in COMPARED_ODOMETRIES
        if number == "02" or name == "true"
    ]
    return [(*key, quality, seed) for quality in (0.40, 0.50) for seed in (1, 2, 3) for key in wanted]


def list_places(real_root: str) -> list[tuple]:
    """List the jobs of other places: all sessions but the one that a place's map was made from."""
    return [
        (number, place, *quality, seed)
        for seed in (1, 2, 3)
        for place, qualities in PLACE_QUALITIES.items()
        for number in list_sessions(real_root, place)
        if number != PLACES[place].mapping_session
        for quality in qualities
    ]


def load_truth(real_root: str, number: str) -> np.ndarray:
    """Read the ground-truth poses of a session."""
    return load_poses(Path(real_root, POSES_PATH, f"pose_xy_{number}.txt"))


def run_table(
    pool: ProcessPoolExecutor,
    what: str,
    jobs: list[tuple],
    path: Path,
    *,
    is_chosen: Callable[[tuple], bool] = bool,
    **files: str,
) -> None:
    """Run the jobs that the table of a file lacks, and write the table after each.

    Parameters
    ----------
    pool : concurrent.futures.Executor
        Runs the jobs.
    what : str
        Name of the table, one of `MEASURES`.
    jobs : list of tuple
        All jobs of the table, from `list_jobs`.
    path : pathlib.Path
        File of the table.
    is_chosen : callable
        Run only the jobs for which this is true.
    **files
        ``real_root`` and ``weights``, see `measure`.

    Raises
    ------
    ValueError
        If the table holds jobs that are not listed, such as those of another set of sessions; nothing is
        dropped.
    """
    table = pd.read_csv(path, dtype=TEXT) if path.is_file() else pd.DataFrame({"job": []})
    wanted = [" ".join(map(str, key)) for key in jobs]
    if unlisted := sorted(set(table.job) - set(wanted)):
        raise ValueError(
            f"{path}: {len(unlisted)} jobs are not listed, such as {unlisted[0]!r}; move the file away"
        )
    missing = [key for key, name in zip(jobs, wanted, strict=True) if name not in set(table.job)]
    missing = [key for key in missing if is_chosen(key)]
    running = [pool.submit(measure, files["real_root"], files["weights"], what, key) for key in missing]
    for done, future in enumerate(as_completed(running), start=1):
        rows = future.result()
        table = (
            pd.concat([table, pd.DataFrame(rows)], ignore_index=True) if len(table) else pd.DataFrame(rows)
        )
        table = table.sort_values("job", kind="stable")
        write_text(path, table.to_csv(index=False, float_format="%.5g"))
        print(f"{what} {done}/{len(missing)}: {rows[0]['job']}", flush=True)


def load_table(folder: Path | str, what: str) -> pd.DataFrame:
    """Load a stored table.

    Parameters
    ----------
    folder : path
        Folder of the tables, ``data/ablations`` of the repository.
    what : str
        Name of the table, one of `MEASURES`.

    Returns
    -------
    table : pandas.DataFrame
        One row per run; without rows and columns where the table is missing.
    """
    path = Path(folder, f"route_{what}.csv")
    return pd.read_csv(path, dtype=TEXT) if path.is_file() else pd.DataFrame()


def load_runs(folder: Path | str) -> pd.DataFrame:
    """Load the stored runs of both methods over whole sessions: seeds, qualities and odometries.

    Parameters
    ----------
    folder : path
        Folder of the tables.

    Returns
    -------
    runs : pandas.DataFrame
        One row per run: the columns of `row_of`, ``fraction_1m`` of the points, and ``odometry``, which is
        "rall" for the authors' own.
    """
    own = {"seeds": {"fraction_1m": 0.40}, "quality": {}, "odometry": {}}
    tables = [load_table(folder, what).assign(**about) for what, about in own.items()]
    runs = pd.concat([table for table in tables if len(table)] or [pd.DataFrame(columns=RUN_COLUMNS)])
    runs = runs.reindex(columns=[*RUN_COLUMNS, *runs.columns.difference(RUN_COLUMNS, sort=False)])
    return runs.assign(odometry=runs.odometry.fillna("rall")).drop(columns="job", errors="ignore")


def summarize_runs(runs: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Average runs over seeds and sessions, group by group.

    Parameters
    ----------
    runs : pandas.DataFrame
        Rows of `row_of`.
    by : list of str
        Columns that make a group.

    Returns
    -------
    groups : pandas.DataFrame
        Indexed by `by`: ``n_runs``, ``n_sessions`` and ``n_seeds``; means of ``rmse_m`` [m] with ``min_m``
        and ``max_m`` over the runs, of ``rmse_yaw_deg`` [deg] and of the three classes [%]; ``failures`` per
        run.
    """
    measures = {name: (name, "mean") for name in ("rmse_m", "rmse_yaw_deg", *CLASSES, "failures")}
    groups = runs.groupby(by).agg(
        n_runs=("seed", "size"), n_sessions=("session", "nunique"), n_seeds=("seed", "nunique"),
        min_m=("rmse_m", "min"), max_m=("rmse_m", "max"), **measures,
    )  # fmt: skip
    groups[list(CLASSES)] *= 100.0
    return groups
