"""How fast and how good the odometry is: ours and the paper's beside Open3D and small_gicp, in one run.

python benchmarks/odometry.py [--results build/demo] [--sessions data/sessions/demo] [--real-root DIR]
                                                        prints a table and writes data/performance/odometry.json

All get the same fake clouds of the simulated sessions that `make book` left, and one thread. The paper's ICP and the
peers align each cloud to the one before and guess that the car goes on as it went; ours aligns it to the clouds of the
last metres. Ways take turns scan by scan, so that a busy machine hurts all alike; medians. All that a way makes of a
cloud is timed with it: trees, normals, corrections, copies into its own types. Drift is that of the KITTI benchmark,
over the lengths for which the sessions are long enough. Errors are told twice, for the correction of motion and Doppler
is no merit of a registration: on clouds as they were read off scans, which "ours" corrects by itself, and on clouds
that were corrected before with the velocities it found.

"paper, k-d tree" is the paper's ICP with SciPy's k-d tree instead of the compiled grid; its steps are the same where no
two neighbours are equally near.

Beside them stands what is published of the real route: the authors' own odometry there, as it is and with its steps as
much longer as a range bin is measured longer than the data set's SDK has it; and CFEAR-3, a method for raw radar. Where
small_gicp is not installed (it has no wheels for some kinds of macOS), its rows are left out; without the real data,
the authors'.
"""

from __future__ import annotations

import os

# Before OpenMP is loaded: one thread for all, and none that spins while another way has its turn.
os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import argparse
import importlib.metadata
import json
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from time import perf_counter

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree
from translator import ROOT, describe_machine

from rol.bev import image_to_points
from rol.evaluation import KITTI_LENGTHS_M, drift_by_length, pose_errors, read_tum, rmse
from rol.files import write_text
from rol.geometry import accumulate_increments, compose, relative_pose, transform_points
from rol.odometry import fit_rigid, icp_2d, scan_to_scan_icp
from rol.pairs import generated_folder, read_image
from rol.radar import MEASURED, SDK
from rol_beyond.local_map_odometry import deskew_cloud, local_map_odometry
from rol_beyond.scan_matching import correlative_scan_match
from rol_data import rall

try:
    import small_gicp
except ImportError:
    small_gicp = None

CFEAR_PCT = (
    1.3  # drift of CFEAR-3 from Oxford's raw radar, sessions of its authors' choice (Adolfsson et al. 2023)
)
LONGER = MEASURED.resolution_m / SDK.resolution_m  # length of a range bin as measured over the SDK's
REAL_SESSIONS = {"01": "2019-01-10-11-46-21", "02": "2019-01-10-12-32-52", "07": "2019-01-11-12-26-55"}
MAX_DISTANCE_M = 1.0  # of a pair, for the peers: our ICP's last limit; with 2 or 3 m they drift more
ITERATIONS = 30  # at most, for all
# GICP sees the walls only in points that stand in space; with all in one plane it is ICP.
PEER_HEIGHTS_M = {"ICP": (0.0,), "GICP": (-0.25, 0.25)}
Clouds = list[np.ndarray]
Steps = Iterator[np.ndarray]
Way = Callable[[Clouds, np.ndarray], Steps]
Align = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def to_matrix(step: np.ndarray) -> np.ndarray:
    """A planar pose as the 4 x 4 matrix that the peers want."""
    x, y, yaw = step
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def to_step(matrix: np.ndarray) -> np.ndarray:
    """A 4 x 4 matrix as a planar pose."""
    return np.array([matrix[0, 3], matrix[1, 3], np.arctan2(matrix[1, 0], matrix[0, 0])])


def chain_peer(
    align: Align, clouds: Clouds, stamps_us: np.ndarray, heights: tuple[float, ...] = (0.0,)
) -> Steps:
    """Register each cloud to the one before with a peer, as `rol.odometry.scan_to_scan_icp` does."""
    step, target = np.zeros(3), to_space(clouds[0], heights)
    for cloud in clouds[1:]:
        source = to_space(cloud, heights)
        step = to_step(align(source, target, to_matrix(step)))
        yield step
        target = source


def to_space(cloud: np.ndarray, heights: tuple[float, ...]) -> np.ndarray:
    """Points in the plane as points in space, once at each height [m]."""
    return np.concatenate([np.column_stack([cloud, np.full(len(cloud), z)]) for z in heights])


def align_open3d(source: np.ndarray, target: np.ndarray, init: np.ndarray) -> np.ndarray:
    """Open3D's point-to-point ICP."""
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (source, target)]
    icp = o3d.pipelines.registration
    found = icp.registration_icp(
        *clouds, MAX_DISTANCE_M, init, icp.TransformationEstimationPointToPoint(),
        icp.ICPConvergenceCriteria(max_iteration=ITERATIONS),
    )  # fmt: skip
    return found.transformation


def align_small_gicp(kind: str, source: np.ndarray, target: np.ndarray, init: np.ndarray) -> np.ndarray:
    """ICP or GICP of small_gicp; cells so small that no point of the images' raster is lost."""
    found = small_gicp.align(
        target, source, init, registration_type=kind, downsampling_resolution=0.1,
        max_correspondence_distance=MAX_DISTANCE_M, max_iterations=ITERATIONS, num_threads=1,
    )  # fmt: skip
    return found.T_target_source


def ours(clouds: Clouds, stamps_us: np.ndarray, **changes: object) -> Steps:
    """Steps of the book's own odometry."""
    return (r.T_target_source for r in local_map_odometry(clouds, stamps_us, **changes))


def paper(clouds: Clouds, stamps_us: np.ndarray, search: bool = False) -> Steps:
    """Steps of the paper's ICP, with or without a searched first guess."""
    refine = correlative_scan_match if search else None
    return (r.T_target_source for r in scan_to_scan_icp(clouds, refine_guess=refine))


def paper_by_tree(clouds: Clouds, stamps_us: np.ndarray) -> Steps:
    """Compute the steps of the paper's ICP with NumPy and SciPy's k-d tree."""
    step = np.zeros(3)
    for target, source in pairwise(clouds):
        step = align_by_tree(source, target, step)
        yield step


def align_by_tree(source: np.ndarray, target: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Register two clouds as `rol.odometry.icp_2d` does by default, with a k-d tree."""
    limit, tree = 3.0, cKDTree(target)
    source = source[np.linspace(0, len(source) - 1, min(len(source), 1000)).astype(int)]
    for _ in range(ITERATIONS):
        moved = transform_points(step, source)
        distances, neighbours = tree.query(moved, distance_upper_bound=limit)
        paired = np.flatnonzero(np.isfinite(distances))
        n = int(np.ceil(0.9 * len(paired)))
        if n < 10:
            break
        kept = paired[np.argpartition(distances[paired], n - 1)[:n]]
        change = fit_rigid(moved[kept], target[neighbours[kept]])
        step, last = compose(change, step), step
        if limit <= 1.0 and np.hypot(*(step - last)[:2]) + 30.0 * abs(change[2]) < 1e-3:
            break
        limit = max(0.8 * limit, 1.0)
    return step


def list_ways() -> dict[str, Way]:
    """All ways that this machine has, by name; each gives one step per call of `next`."""
    ways: dict[str, Way] = {
        "paper": paper,
        "paper, k-d tree": paper_by_tree,
        "paper, searched guess": partial(paper, search=True),
        "ours": ours,
        "ours, no correction": partial(ours, deskew=None),
        "Open3D point-to-point": partial(chain_peer, align_open3d),
    }
    for kind, heights in PEER_HEIGHTS_M.items() if small_gicp else ():
        ways[f"small_gicp {kind}"] = partial(chain_peer, partial(align_small_gicp, kind), heights=heights)
    return ways


def load_session(generated: Path, session: Path) -> tuple[Clouds, np.ndarray, np.ndarray]:
    """Clouds of the generated images, their stamps [us], and the true poses at mid-scan."""
    images = generated_folder(generated)
    about = images.read()
    if not (session / "truth.tum").is_file():
        raise ValueError(f"{session / 'truth.tum'}: missing; `make book` makes the session")
    stamps_us, truth = read_tum(session / "truth.tum")
    is_listed = np.isin(stamps_us, about["stamps_us"])
    stamps_us = stamps_us[is_listed]
    clouds = [image_to_points(read_image(images.path(us)), **about["points"]) for us in stamps_us.tolist()]
    return clouds, stamps_us, truth[is_listed]


def find_sessions(results: Path, sessions: Path) -> dict[str, tuple[Clouds, np.ndarray, np.ndarray]]:
    """Load every localization session that has generated images."""
    folders = sorted(path.parent for path in (results / "fake").glob("sim-*-seq*/fake.json"))
    if not folders:
        raise ValueError(
            f"{results / 'fake'}: no generated images of sessions sim-*-seq*; `make book` makes them"
        )
    return {folder.name: load_session(folder, sessions / folder.name) for folder in folders}


def take_turns(ways: dict[str, Steps], n_steps: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Let all ways take one step after the other; the steps of each, and the seconds of every step."""
    steps: dict[str, list] = {name: [] for name in ways}
    seconds: dict[str, list] = {name: [] for name in ways}
    for _ in range(n_steps):
        for name, way in ways.items():
            begin = perf_counter()
            steps[name].append(next(way))
            seconds[name].append(perf_counter() - begin)
    return {k: np.array(v) for k, v in steps.items()}, {k: np.array(v) for k, v in seconds.items()}


def judge(steps: np.ndarray, truth: np.ndarray, longest_m: float) -> dict[str, float]:
    """Drift over segments up to a length, and the errors of single steps."""
    lengths_m = tuple(length for length in KITTI_LENGTHS_M if length <= longest_m)
    report = drift_by_length(accumulate_increments(steps), truth, lengths_m)
    errors = pose_errors(steps, relative_pose(truth[:-1], truth[1:]))
    return {
        "drift [%]": report.mean_translation_pct,
        "rotation [deg/100 m]": report.mean_rotation_deg_per_100m,
        "step [m]": rmse(errors.position_m),
        "step along [m]": rmse(errors.longitudinal_m),
        "step across [m]": rmse(errors.lateral_m),
        "step heading [deg]": rmse(np.rad2deg(errors.yaw_rad)),
    }


def correct_all(clouds: Clouds, stamps_us: np.ndarray) -> Clouds:
    """Correct clouds with the velocities that ours finds."""
    twists = [found.twist for found in local_map_odometry(clouds, stamps_us)]
    return [deskew_cloud(c, twist) for c, twist in zip(clouds, [twists[0], *twists], strict=True)]


def find_longest(truths: list[np.ndarray]) -> float:
    """The longest length of the KITTI benchmark for which each of the ways is long enough [m]."""
    reports = [drift_by_length(truth, truth) for truth in truths]
    return min(float(report.lengths_m.max(initial=0.0)) for report in reports)


def run_session(
    clouds: Clouds, stamps_us: np.ndarray, truth: np.ndarray, longest_m: float
) -> dict[str, dict[str, np.ndarray]]:
    """Run all ways over one session; for each the seconds of all steps, and its errors on clouds of either kind."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for case, used in {"as read": clouds, "corrected": correct_all(clouds, stamps_us)}.items():
        taken = {name: way(used, stamps_us) for name, way in list_ways().items()}
        if case == "corrected":
            del taken["ours"]  # which corrects by itself
        steps, seconds = take_turns(taken, len(clouds) - 1)
        for name in taken:
            row = found.setdefault(name, {"seconds": seconds[name]})
            row |= {f"{key}, {case}": value for key, value in judge(steps[name], truth, longest_m).items()}
    return found


def tabulate(found: dict[str, dict[str, dict[str, np.ndarray]]]) -> dict[str, dict[str, float]]:
    """One row per way: median time, its ratio to the paper's, mean errors over sessions, for drift also the range."""
    rows: dict[str, dict[str, float]] = {}
    for name in next(iter(found.values())):
        runs = [rows_of[name] for rows_of in found.values()]
        row = rows[name] = {"step [ms]": 1e3 * float(np.median(np.concatenate([r["seconds"] for r in runs])))}
        row["times the paper's"] = row["step [ms]"] / rows["paper"]["step [ms]"]
        for key in [key for key in runs[0] if key != "seconds"]:
            values = [float(run[key]) for run in runs]
            row[key] = float(np.mean(values))
            if key.startswith("drift"):
                row |= {f"{key}, lowest": min(values), f"{key}, highest": max(values)}
    return rows


def judge_published(real_root: str, longest_m: float) -> dict[str, dict[str, float]]:
    """Drift of what others made of the real route: as it is, over the same lengths as here, with the true heading."""
    rows = {"CFEAR-3": {"drift [%]": CFEAR_PCT}}
    root = rall.find_real_root(real_root)
    for number, name in REAL_SESSIONS.items() if root else ():
        truth = rall.load_poses(root / rall.POSES_PATH / f"pose_xy_{number}.txt")
        true_steps = relative_pose(truth[:-1], truth[1:])
        told = rall.load_odometry(root / rall.ODOMETRY_PATH / f"seq{number}_odom.txt")[: len(true_steps)]
        for case, factor in {"as published": 1.0, "scale corrected": LONGER}.items():
            steps = told * (factor, factor, 1.0)
            row = rows[f"authors' ICP, {case}, {name}"] = judge(steps, truth, max(KITTI_LENGTHS_M))
            row["drift [%], same lengths"] = judge(steps, truth, longest_m)["drift [%]"]
            steps[:, 2] = true_steps[:, 2]
            row["drift [%], true heading"] = judge(steps, truth, max(KITTI_LENGTHS_M))["drift [%]"]
    return rows


def describe(sessions: list[str], n_points: float, longest_m: float) -> dict[str, object]:
    """Describe machine, clouds and versions."""
    version = importlib.metadata.version("small_gicp") if small_gicp else "left out, for it is not installed"
    return {
        **describe_machine(1),
        "open3d": o3d.__version__,
        "small_gicp": version,
        "load when begun": os.getloadavg()[0],
        "sessions": sessions,
        "points per cloud": n_points,
        "longest segment [m]": longest_m,
    }


def compile_ours(clouds: Clouds) -> None:
    """Let numba compile before anything is timed."""
    icp_2d(clouds[0], clouds[0])
    list(local_map_odometry(clouds[:3], np.arange(3) * 250_000))


def main() -> None:
    """Measure, print, and write the table."""
    parser = argparse.ArgumentParser(description="How fast and how good the odometry is, beside peers.")
    parser.add_argument(
        "--results", type=Path, default=ROOT / "build" / "demo", help="where fake/<session> lies"
    )
    parser.add_argument("--sessions", type=Path, default=ROOT / "data" / "sessions" / "demo")
    parser.add_argument("--real-root", default="", help="folder of the real data")
    given = parser.parse_args()
    try:
        sessions = find_sessions(given.results, given.sessions)
    except ValueError as error:
        parser.error(str(error))
    longest_m = find_longest([truth for _, _, truth in sessions.values()])
    n_points = float(np.mean([len(cloud) for clouds, _, _ in sessions.values() for cloud in clouds]))
    about = describe(list(sessions), n_points, longest_m)
    compile_ours(next(iter(sessions.values()))[0])
    table = tabulate({name: run_session(*session, longest_m) for name, session in sessions.items()})
    published = judge_published(given.real_root, longest_m)
    for name, row in {**table, **published}.items():
        print(name, "  ".join(f"{key} {value:.3g}" for key, value in row.items()), flush=True)
    path = ROOT / "data" / "performance" / "odometry.json"
    write_text(path, json.dumps({"about": about, "rows": table, "published": published}, indent=1) + "\n")


if __name__ == "__main__":
    main()
