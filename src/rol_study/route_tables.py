"""Runs of the filters on the real route over many seeds, settings and wrong starts, as tables; hours of filtering.

A table is written row by row; a run that was stopped continues where it ended.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from rol.evaluation import pose_errors, summarize
from rol.files import write_text
from rol.mcl import MclSettings, Measurement
from rol.pix2pix import load_network
from rol_beyond import unet  # noqa: F401 (registers its architecture)
from rol_beyond.consistency import consistency
from rol_beyond.motion import MotionModel
from rol_beyond.recovery import DetectionSettings, RecoverySettings
from rol_beyond.robust import settings_for
from rol_data.rall import POSES_PATH, load_poses
from rol_study.oxford_route import RouteSession, list_sessions
from rol_study.rendered_points import build_segment, render_points
from rol_study.route_experiments import (
    FilterRun,
    RouteExperiment,
    add_outliers,
    kidnap,
    localize_globally,
    prepare_experiment,
    run_method,
    sample_session,
)
from rol_study.sampled_points import FrontEnd

SHORT = 3000  # scans of the runs that compare settings
DEG = float(np.deg2rad(1.0))
SETTINGS = {
    "particles": [("n_particles", n) for n in (50, 100, 500, 2000)],
    "lambda": [("exponent", value) for value in (1.0, 5.0, 20.0, 80.0)],
    "d_th [m]": [("d_th_m", value) for value in (0.25, 0.5, 1.0, 2.0)],
    "noise": [("noise", value) for value in (0.2, 0.5, 1.0, 2.0)],
}
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
NARROW = {"d_th_m": 0.25}
QUIET = {"forward_m": 0.1, "left_m": 0.06, "yaw_rad": 0.2 * DEG}
TUNED = {"both": NARROW | QUIET, "d_th of 0.25 m": NARROW, "a fifth of the noise": QUIET}
FRONTS = ((0.40, 0.60), (0.50, 0.70), (0.65, 0.80), (0.80, 0.90))


@lru_cache(maxsize=1)
def experiment_of(
    real_root: str,
    number: str,
    shares: tuple[float, float] = (0.40, 0.60),
    max_scans: int = 0,
    settings: MclSettings | None = None,
) -> RouteExperiment:
    """Prepare the experiment once per worker and session."""
    return prepare_experiment(real_root, number, FrontEnd(*shares), max_scans=max_scans, settings=settings)


def row_of(experiment: RouteExperiment, run: FilterRun, method: str, seed: int) -> dict:
    """Compute the metrics of one run."""
    truth, errors = experiment.session.truth, pose_errors(run.poses, experiment.session.truth)
    about = {"method": method, "session": experiment.session.number, "seed": seed}
    update_ms = float(np.median(run.update_ms))
    row = summarize(run.poses, truth, failures=len(run.failures), update_ms_median=update_ms, **about)
    return row | {
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


def measure_seeds(real_root: str, number: str, seed: int) -> list[dict]:
    """Run both methods over a whole session."""
    experiment = experiment_of(real_root, number)
    clouds = sample_session(experiment, seed)
    return [
        row_of(experiment, run_method(experiment, method, clouds, seed), method, seed)
        for method in ("paper", "robust")
    ]


def measure_settings(real_root: str, number: str, seed: int) -> list[dict]:
    """Run the method `paper` with one setting after the other changed."""
    experiment, rows = experiment_of(real_root, number, (0.40, 0.60), SHORT), []
    clouds = sample_session(experiment, seed)
    for name, values in SETTINGS.items():
        for setting, value in values:
            changes = {setting: value}
            if setting == "noise":
                changes = {"forward_m": 0.5 * value, "left_m": 0.3 * value, "yaw_rad": value * DEG}
            run = run_method(experiment, "paper", clouds, seed, **changes)
            rows.append({"what": name, "value": value, **row_of(experiment, run, "paper", seed)})
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
    """Run the method `paper` over a whole session with the settings that were best on the first scans of session 02."""
    experiment = experiment_of(real_root, number)
    run = run_method(experiment, "paper", sample_session(experiment, seed), seed, **TUNED[what])
    return [{"what": what, **row_of(experiment, run, "tuned", seed)}]


def measure_registration(real_root: str, number: str, seed: int) -> list[dict]:
    """Run scan-to-map ICP without a filter over a whole session."""
    experiment = experiment_of(real_root, number)
    run = run_method(experiment, "registration", sample_session(experiment, seed), seed)
    return [row_of(experiment, run, "registration", seed)]


def measure_fronts(real_root: str, number: str, share_1m: float, share_2m: float, seed: int) -> list[dict]:
    """Run both methods with better and better front ends."""
    experiment = experiment_of(real_root, number, (share_1m, share_2m), SHORT)
    clouds, shares = sample_session(experiment, seed), {"share_1m": share_1m, "share_2m": share_2m}
    return [
        shares | row_of(experiment, run_method(experiment, m, clouds, seed), m, seed)
        for m in ("paper", "robust")
    ]


def measure_outliers(real_root: str, number: str, share: float, seed: int) -> list[dict]:
    """Run both methods with outliers in the odometry."""
    experiment = experiment_of(real_root, number, (0.40, 0.60), SHORT)
    disturbed = replace(
        experiment, session=add_outliers(experiment.session, share, np.random.default_rng(seed))
    )
    clouds = sample_session(experiment, seed)
    return [
        {"share": share} | row_of(disturbed, run_method(disturbed, m, clouds, seed), m, seed)
        for m in ("paper", "robust")
    ]


def measure_rendered(
    real_root: str, number: str, first: int, n_scans: int, seed: int, *, weights: str
) -> list[dict]:
    """Run both methods on points generated from the simulated radar, on a segment that the network was not trained on."""
    torch.set_num_threads(1)
    experiment = experiment_of(real_root, number, (0.80, 0.88))
    simulated = build_segment(real_root, number, first, n_scans, seed)
    clouds = list(render_points(simulated, load_network(weights)))
    truth, increments = (
        experiment.session.truth[first : first + n_scans],
        experiment.session.increments[first : first + n_scans - 1],
    )
    part = replace(experiment, session=RouteSession(number, truth, increments))
    return [
        row_of(part, run_method(part, method, clouds, seed), method, seed) for method in ("paper", "robust")
    ]


def measure_trial(what: str):
    """Make the measurement of a wrong start."""

    def trial(real_root: str, number: str, first: int, seed: int) -> list[dict]:
        found = {"kidnapped": kidnap, "anywhere": localize_globally}[what](
            experiment_of(real_root, number), first, seed
        )[0]
        return [{"session": number, "first": first, "seed": seed, **vars(found)}]

    return trial


MEASURES = {
    "seeds": measure_seeds,
    "settings": measure_settings,
    "fronts": measure_fronts,
    "ingredients": measure_ingredients,
    "tuned": measure_tuned,
    "registration": measure_registration,
    "outliers": measure_outliers,
    "rendered": measure_rendered,
    "kidnapped": measure_trial("kidnapped"),
    "anywhere": measure_trial("anywhere"),
}


def list_jobs(real_root: str) -> dict[str, list[tuple]]:
    """List the jobs of each table. Wrong starts are drawn once, from all sessions but the mapping one."""
    numbers, rng = list_sessions(real_root), np.random.default_rng(2020)
    driven = [number for number in numbers if number != "01"] or numbers
    lengths = {number: len(load_truth(real_root, number)) for number in driven}

    def places(n: int, seconds: float) -> list[tuple]:
        picked = [driven[k % len(driven)] for k in range(n)]
        return sorted(
            (name, int(rng.integers(100, lengths[name] - 4 * seconds)), k) for k, name in enumerate(picked)
        )

    first = driven[0]
    return {
        "seeds": [(number, seed) for seed in range(1, 11) for number in numbers],
        "kidnapped": places(100, 15),
        "settings": [(first, seed) for seed in (1, 2, 3)],
        "outliers": [(first, share, seed) for share in (0.015, 0.05) for seed in (1, 2, 3)],
        "anywhere": places(50, 120),
        "ingredients": [(driven[-1], name, seed) for name in INGREDIENTS for seed in (1, 2, 3, 4, 5)],
        "tuned": list_tuned(numbers),
        "registration": [(number, seed) for seed in (1, 2) for number in numbers],
        "fronts": [(first, *shares, seed) for shares in FRONTS for seed in (1, 2, 3)],
        "rendered": [key for key in (("02", 6000, 400, 1), ("07", 5050, 400, 1)) if key[0] in numbers],
    }


def list_tuned(numbers: list[str]) -> list[tuple]:
    """List the jobs with tuned settings, without the session that they were tuned on."""
    judged = [number for number in numbers if number != "02"]
    return [(number, what, seed) for number in judged for what in TUNED for seed in (1, 2, 3)]


def load_truth(real_root: str, number: str) -> np.ndarray:
    """Read the ground-truth poses of a session."""
    return load_poses(Path(real_root, POSES_PATH, f"pose_xy_{number}.txt"))


def run_table(
    pool: ProcessPoolExecutor, what: str, jobs: list[tuple], path: Path, *, real_root: str, weights: str
) -> None:
    """Run the jobs that the table of a file lacks, and write the table after each.

    Raises
    ------
    ValueError
        If the table holds jobs that are not listed, such as those of another set of sessions; nothing is dropped.
    """
    table = (
        pd.read_csv(path, dtype={"session": str, "job": str}) if path.is_file() else pd.DataFrame({"job": []})
    )
    wanted = [" ".join(map(str, key)) for key in jobs]
    if unlisted := sorted(set(table.job) - set(wanted)):
        raise ValueError(
            f"{path}: {len(unlisted)} jobs are not listed, such as {unlisted[0]!r}; move the file away"
        )
    missing = [key for key, name in zip(jobs, wanted, strict=True) if name not in set(table.job)]
    running = [pool.submit(measure, real_root, weights, what, key) for key in missing]
    for done, future in enumerate(as_completed(running), start=1):
        rows = future.result()
        table = (
            pd.concat([table, pd.DataFrame(rows)], ignore_index=True) if len(table) else pd.DataFrame(rows)
        )
        table = table.sort_values("job", kind="stable")
        write_text(path, table.to_csv(index=False, float_format="%.5g"))
        print(f"{what} {done}/{len(missing)}: {rows[0]['job']}", flush=True)
