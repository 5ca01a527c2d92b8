"""Read CFEAR-3 radar odometry of two of the paper's sessions (Adolfsson et al., T-RO 2023).

CFEAR registers oriented surface points to keyframes and is the most accurate published radar odometry of
these sessions. Its files hold one pose per radar scan, as the first three rows of a 4 x 4 matrix (KITTI),
with y to the right and yaw clockwise; here y is left and yaw counter-clockwise. The files lie below
`real_root`, see `rol_data.rall`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rol.files import read_text
from rol.geometry import relative_pose

RESULTS_PATH = Path("CFEAR_Radarodometry_evaluation_public/1_baseline_eval/data/traj_and_results")
VARIANTS = {  # CFEAR-3 compares a scan with the last four keyframes, CFEAR-3-s50 with the last fifty
    "cfear-3": RESULTS_PATH / "oxford_baseline-cfear-3_2022-04-28_1708",
    "cfear-3-s50": RESULTS_PATH / "oxford_baseline-cfear-3-s50_2022-04-28_1804",
}
FILES = {"01": "job_7/est/00.txt", "02": "job_1/est/01.txt"}  # by the session's number in RaLL's files


class CfearError(ValueError):
    """Raised for a file of CFEAR's results that is missing or not what it should be; names file and fault."""


def find_cfear(real_root: Path | str, number: str, variant: str = "cfear-3") -> Path:
    """Find the file of a session.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `rol_data.rall.find_real_root`.
    number : str
        Number of the Oxford session in RaLL's files, "01" or "02".
    variant : str
        "cfear-3" or "cfear-3-s50".

    Returns
    -------
    path : Path
        The file, which need not exist.

    Raises
    ------
    CfearError
        If CFEAR's results of the session are not published, or the variant is unknown.
    """
    if variant not in VARIANTS:
        raise CfearError(f"variant: {variant!r} is unknown; there are {', '.join(VARIANTS)}")
    if number not in FILES:
        raise CfearError(
            f"CFEAR's odometry of session {number} is not published; of sessions {', '.join(FILES)} it is"
        )
    return Path(real_root) / VARIANTS[variant] / FILES[number]


def load_cfear_poses(path: Path | str) -> np.ndarray:
    """Read the poses of a file.

    Parameters
    ----------
    path : path
        Rows of twelve numbers, a 3 x 4 matrix each: rotation and translation of a scan in the frame of the
        first.

    Returns
    -------
    poses : array, shape (n, 3)
        y left, yaw counter-clockwise [m, m, rad].

    Raises
    ------
    CfearError
        If the file is missing, or a row is no motion in the plane; names file and row.
    """
    path = Path(path)
    if not path.is_file():
        raise CfearError(f"{path}: missing")
    try:
        rows = np.loadtxt(read_text(path).splitlines(), ndmin=2)
    except ValueError as error:
        raise CfearError(f"{path}: not a table of numbers: {error}") from error
    if rows.ndim != 2 or rows.shape[1:] != (12,) or len(rows) == 0:
        raise CfearError(f"{path}: expected rows of twelve numbers, got shape {rows.shape}")
    matrices = rows.reshape(-1, 3, 4)
    _check(path, np.isfinite(rows).all(axis=1), "is not finite")
    turns = matrices[:, :2, :2]
    is_turn = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(2)).max(axis=(1, 2)) < 1e-3
    _check(path, is_turn & (np.linalg.det(turns) > 0.0), "holds no rotation in the plane")
    is_flat = (np.abs(matrices[:, 2] - (0.0, 0.0, 1.0, 0.0)) < 1e-3).all(axis=1)
    _check(path, is_flat & (np.abs(matrices[:, :2, 2]) < 1e-3).all(axis=1), "leaves the plane")
    yaws = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    return np.column_stack([matrices[:, 0, 3], -matrices[:, 1, 3], -yaws])


def load_cfear_increments(path: Path | str, n_scans: int) -> np.ndarray:
    """Read the odometry increments of a session.

    Pose i belongs to scan i, the row i of RaLL's ground truth. The published files lack the pose of the last
    scan, so the increment to it is missing. A pose beyond the last scan, as of a session whose first or last
    stamp has no ground truth, is left out.

    Parameters
    ----------
    path : path
        From `find_cfear`.
    n_scans : int
        Scans of the session.

    Returns
    -------
    increments : array, shape (n_scans - 1, 3) or (n_scans - 2, 3)
        Pose of each scan in the one before; the shorter where the file lacks the last pose [m, m, rad].

    Raises
    ------
    CfearError
        If the file is faulty, see `load_cfear_poses`, or its number of poses differs from ``n_scans`` by more
        than one.
    """
    poses = load_cfear_poses(path)
    if abs(len(poses) - n_scans) > 1:
        raise CfearError(f"{path}: {len(poses)} poses for {n_scans} scans; they may differ by one at most")
    poses = poses[:n_scans]
    return relative_pose(poses[:-1], poses[1:])


def _check(path: Path, is_right: np.ndarray, fault: str) -> None:
    """Raise for the first row at fault."""
    if not is_right.all():
        raise CfearError(f"{path}: row {int(np.argmin(is_right)) + 1} {fault}")
