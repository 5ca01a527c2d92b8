"""The paper's Seq01 from real radar to Tables II and III: `python -m rol_study.seq01`, or `make seq01`.

It reads the 8,618 radar images that the RaLL repository links, or with ``--session`` the raw scans of a
folder in Oxford's layout, and writes trajectories and metrics of both methods. It can be stopped; the same
command goes on.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

import rol_beyond.unet  # noqa: F401 (registers the architecture)
from rol.evaluation import summarize, write_metrics, write_tum
from rol.files import write_text
from rol.pix2pix import TrainedNetwork, has_bf16, load_network
from rol_beyond.front_ends import evaluate_on_map
from rol_data.rall import MAP_PATH, MAP_SHAPE, RallError, find_real_root, load_map_points
from rol_study import end_to_end
from rol_study.end_to_end import RadarSession, Report
from rol_study.filter_runs import FilterRun, find_failures

EVERY = 20  # of the points of this many scans one is compared with the map
TABLES = {"table2_rmse.csv": "II", "table3_distribution.csv": "III"}
PAPER = Path("data/paper")


def run_session(
    session: RadarSession, network: TrainedNetwork, real_root: Path, out: Path, seed: int, report: Report
) -> pd.DataFrame:
    """Run both methods over a session and write trajectories and metrics.

    Parameters
    ----------
    session : RadarSession
        From `rol_study.end_to_end.open_images` or `open_oxford`.
    network : TrainedNetwork
        From `rol.pix2pix.load_network`.
    real_root : path
        Folder of the real data.
    out : path
        Where ``<session>/points``, ``<session>/<method>`` and ``<session>/results.csv`` are written.
    seed : int
        Of the particles.
    report : callable
        Takes a line of text.

    Returns
    -------
    table : DataFrame
        A row per method: metrics, and the fraction of its points near the map.

    Raises
    ------
    rol_study.end_to_end.EndToEndError
        If the start is unknown and is not found.
    """
    map_points, folder = load_map_points(real_root / MAP_PATH, MAP_SHAPE), Path(out, session.name)
    contrast = end_to_end.measure_contrast(real_root, network, map_points)
    how = {"report": report, "bf16": has_bf16()}
    raw = end_to_end.keep_points(session, network, folder / "points" / "raw", **how)
    odometry = end_to_end.estimate_odometry(raw, session.stamps_us, report)
    compensated = end_to_end.keep_points(
        session, network, folder / "points" / "compensated", odometry.twists, **how
    )
    robust = end_to_end.run_robust(session, odometry, compensated, map_points, seed, contrast, report)
    first = 0
    if session.truth is None:
        first = end_to_end.find_start(robust)
        seconds = (session.stamps_us[first] - session.stamps_us[0]) / 1e6
        report(f"start found at scan {first + 1}, {seconds:.0f} s")
        session = end_to_end.with_fitted_truth(session, robust, first)
    paper = end_to_end.run_paper(session, odometry, raw, map_points, seed, report)
    rows = []
    for method, run, clouds, begin in (("paper", paper, raw, 0), ("robust", robust, compensated, first)):
        metrics = _write_run(folder / method, session, run, begin, {"method": method, "seed": seed})
        rows.append(metrics | _measure_points(clouds, session.truth, map_points))
    table = pd.DataFrame(rows)
    write_text(folder / "results.csv", table.to_csv(index=False))
    return table


def _write_run(folder: Path, session: RadarSession, run: FilterRun, first: int, about: dict) -> dict:
    """Write trajectory, ground truth and metrics of a run from its first scan that counts."""
    stamps, truth, poses = (values[first:] for values in (session.stamps_us, session.truth, run.poses))
    failures = len(run.failures or find_failures(stamps, poses, truth))
    update_ms = float(np.median(run.update_ms))
    about = about | {"session": session.name, "failures": failures, "update_ms_median": update_ms}
    metrics = summarize(poses, truth, **about)
    write_tum(folder / "trajectory.tum", stamps, poses)
    write_tum(folder / "truth.tum", stamps, truth)
    write_metrics(folder / "metrics.json", metrics)
    return metrics


def _measure_points(clouds: end_to_end.KeptClouds, truth: np.ndarray, map_points: np.ndarray) -> dict:
    """Compute the mean fractions of points within 1 m and 2 m of the map, over some of the scans."""
    tree = cKDTree(map_points)
    found = pd.DataFrame([evaluate_on_map(clouds[k], truth[k], tree) for k in range(0, len(clouds), EVERY)])
    return found.mean().add_prefix("points_").to_dict()


def published_row(sequence: str = "seq01", folder: Path = PAPER) -> pd.DataFrame:
    """Read what the paper's Tables II and III state of a sequence, a table of one row."""
    parts = [pd.read_csv(folder / name).set_index("sequence").loc[[sequence]] for name in TABLES]
    return pd.concat(parts, axis=1).reset_index(drop=True).assign(method="published")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : list of str or None
        Command line without the program's name; None takes the real one.

    Returns
    -------
    status : int
        0 on success, 1 after a fault, which is reported on stderr.
    """
    parser = argparse.ArgumentParser(prog="python -m rol_study.seq01", description=__doc__.splitlines()[0])
    parser.add_argument("--real-root", default="", help="folder of the real data; data/real if not given")
    parser.add_argument(
        "--session", default="", help="folder of raw scans with official odometry instead of Seq01"
    )
    parser.add_argument("--out", default="build/seq01", help="where points and results go")
    parser.add_argument("--network", default="data/weights/unet.safetensors", help="file of the network")
    parser.add_argument("--seed", type=int, default=1, help="of the particles")
    parser.add_argument(
        "--max-scans", type=int, default=0, help="only the first scans; 0, the default, for all"
    )
    given = parser.parse_args(arguments)

    def report(line: str) -> None:
        print(line, flush=True)

    try:
        root = find_real_root(given.real_root)
        if root is None:
            raise RallError(f"{MAP_PATH} is not in the folder of the real data; run `make real` first")
        if given.session:
            session = end_to_end.open_oxford(given.session, given.max_scans)
        else:
            session = end_to_end.open_images(root, max_scans=given.max_scans)
        table = run_session(session, load_network(given.network), root, Path(given.out), given.seed, report)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"error: {error}\nThe points written so far stay; the same command goes on.", file=sys.stderr)
        return 1
    if not given.session:
        table = pd.concat([published_row(), table])
    print(table.set_index("method").drop(columns=["session", "seed"]).T.round(3).to_string())
    return 0


if __name__ == "__main__":
    sys.exit(main())
