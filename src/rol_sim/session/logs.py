"""Simulate the slow logs of a session: times of scans, rows and sweeps, odometry with drift, GPS and INS.

Everything here is drawn from given generators and the true trajectory; nothing is written.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.signal import lfilter

from rol.geometry import relative_pose
from rol.oxford import N_AZIMUTHS
from rol_sim.drive.town_loop import Trajectory

SWEEP_US = 50_000
# Where the town lies in UTM zone 30U; x is east, y is north.
NORTHING, EASTING, ALTITUDE = 5_736_000.0, 619_890.0, 65.0
LATITUDE, LONGITUDE = 51.762041, -1.262753  # of that place [deg]
_CONVERGENCE = np.deg2rad(1.365)  # angle between grid north and true north there


def schedule_scans(
    first_stamp_us: int, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of the radar's turns, as measured: 0.24999 s, spread 1.5 ms, neighbours alike.

    Parameters
    ----------
    first_stamp_us : int
        Begin of the first turn [us].
    count : int
        Number of turns.
    rng : numpy.random.Generator
        Draws the durations.

    Returns
    -------
    stamps_us : array, shape (count,), int64
        Begin of each turn [us].
    turns_us : array, shape (count,), int64
        Duration of each turn [us]; the next begins at its end.
    """
    noise = rng.normal(0.0, 1.0, count)
    deviation = np.empty(count)
    last = noise[0]
    for i in range(count):
        last = 0.72 * last + np.sqrt(1.0 - 0.72**2) * noise[i]
        deviation[i] = last
    turns = np.rint(249_990.0 + 1_500.0 * np.clip(deviation, -3.0, 3.0)).astype(np.int64)
    return first_stamp_us + np.concatenate([[0], np.cumsum(turns[:-1])]), turns


def draw_row_stamps(stamp_us: int, turn_us: int, rng: np.random.Generator) -> np.ndarray:
    """Return the times stored in a scan's rows, in bursts of 16, as measured.

    Parameters
    ----------
    stamp_us : int
        Time of the first row [us].
    turn_us : int
        Duration of the turn [us].
    rng : numpy.random.Generator
        Draws the jitter.

    Returns
    -------
    row_stamps_us : array, shape (400,), int64
        Times as in the file. The beams themselves turn evenly.
    """
    row = np.arange(N_AZIMUTHS)
    burst = (row + 2) // 16  # the first burst has lost its first two rows
    begin = np.where(burst > 0, 10_000.0 * burst - 240.0, 0.0) * turn_us / 250_000.0
    begin = begin + rng.normal(0.0, 40.0, burst[-1] + 1)[burst] * (burst > 0)
    gaps = rng.choice([8.0, 115.0, 133.0, 150.0, 255.0], N_AZIMUTHS, p=[0.2, 0.15, 0.35, 0.15, 0.15])
    gaps = gaps + rng.normal(0.0, 4.0, N_AZIMUTHS) * (gaps > 10.0)
    within = np.cumsum(gaps)
    first = np.searchsorted(burst, burst)  # row in which each row's burst begins
    return stamp_us + np.rint(begin + within - within[first]).astype(np.int64)


def scan_row_times(stamp_us: int, turn_us: int) -> np.ndarray:
    """Return the true times at which the beam looks along each row, shape (400,), evenly spread [us]."""
    return stamp_us + (np.arange(N_AZIMUTHS) + 0.5) * turn_us / N_AZIMUTHS


def schedule_sweeps(begin_us: int, end_us: int, rng: np.random.Generator) -> np.ndarray:
    """Return the begins of a lidar's turns, 20 a second with a phase of their own.

    Parameters
    ----------
    begin_us, end_us : int
        Span of time to cover [us].
    rng : numpy.random.Generator
        Draws phase, rate and jitter.

    Returns
    -------
    stamps_us : array, shape (n,), int64
        Begin of each turn [us].
    """
    period = SWEEP_US * (1.0 + float(rng.normal(0.0, 2e-4)))
    begin = begin_us + float(rng.uniform(0.0, period))
    count = int((end_us - begin) / period) + 1
    return np.rint(begin + period * np.arange(count) + rng.normal(0.0, 25.0, count)).astype(np.int64)


def choose_sweeps(
    sweeps_us: np.ndarray, scans_us: np.ndarray, turns_us: np.ndarray, kind: str = "nearest"
) -> np.ndarray:
    """Pick the sweeps that are written.

    Parameters
    ----------
    sweeps_us : array, shape (m,)
        All sweeps [us].
    scans_us, turns_us : array, shape (n,)
        Begin and duration of the scans [us].
    kind : str
        "nearest": those nearest to the scans' stamps and to their middles; "all"; "none".

    Returns
    -------
    index : array, shape (k,)
        Places of the picked sweeps, in order, each once.
    """
    if kind != "nearest":
        return np.arange(len(sweeps_us) if kind == "all" else 0)
    wanted = np.concatenate([scans_us, scans_us + turns_us // 2])
    after = np.clip(np.searchsorted(sweeps_us, wanted), 1, len(sweeps_us) - 1)
    is_before = wanted - sweeps_us[after - 1] <= sweeps_us[after] - wanted
    return np.unique(after - is_before)


def drift_odometry(
    poses: np.ndarray,
    rng: np.random.Generator,
    *,
    scale_spread: float = 0.0015,
    yaw_spread_rad: float = 2.0e-4,
) -> np.ndarray:
    """Simulate odometry increments between true poses: scale error, heading drift, noise.

    Parameters
    ----------
    poses : array, shape (n, 3)
        True poses (x, y, yaw).
    rng : numpy.random.Generator
        Draws the errors.
    scale_spread : float
        Spread of the forward scale error, drawn once.
    yaw_spread_rad : float
        Spread of the heading error of every increment [rad].

    Returns
    -------
    steps : array, shape (n - 1, 3)
        Pose of the later frame in the earlier one (x, y, yaw) [m, m, rad].
    """
    steps = relative_pose(poses[:-1], poses[1:])
    moving = np.minimum(np.hypot(steps[:, 0], steps[:, 1]) / 0.5, 1.0)  # a stationary vehicle hardly drifts
    steps[:, 0] *= 1.0 + float(np.clip(rng.normal(0.0, 1.0), -2.0, 2.0)) * scale_spread
    noise = rng.normal(0.0, 1.0, steps.shape) * (0.004, 0.003, yaw_spread_rad)
    return steps + noise * (0.1 + 0.9 * moving)[:, None]


def draw_gps(trajectory: Trajectory, rng: np.random.Generator) -> pd.DataFrame:
    """Return what a 5 Hz GPS receiver logs on a trajectory, errors of about a metre that change slowly.

    Parameters
    ----------
    trajectory : Trajectory
        The true trajectory.
    rng : numpy.random.Generator
        Draws the errors.

    Returns
    -------
    table : pandas.DataFrame
        Columns of Oxford's gps.csv.
    """
    stamps = np.arange(trajectory.stamps_us[0], trajectory.stamps_us[-1], 200_010, dtype=np.int64)
    error = _slow_error(len(stamps), 0.985, rng) * (0.7, 0.7, 1.0)
    east, north, up = (_place(trajectory, stamps) + error).T
    count = len(stamps)
    return pd.DataFrame(
        {
            "timestamp": stamps,
            "num_satellites": rng.integers(6, 10, count),
            **_geographic(east, north, up),
            "latitude_sigma": rng.uniform(0.6, 0.9, count),
            "longitude_sigma": rng.uniform(0.5, 0.8, count),
            "altitude_sigma": rng.uniform(0.8, 1.1, count),
            **_projected(east, north, up),
        }
    )


def draw_ins(trajectory: Trajectory, rng: np.random.Generator) -> pd.DataFrame:
    """Return what a 50 Hz inertial navigation system logs on a trajectory.

    Parameters
    ----------
    trajectory : Trajectory
        The true trajectory.
    rng : numpy.random.Generator
        Draws the errors.

    Returns
    -------
    table : pandas.DataFrame
        Columns of Oxford's ins.csv; the vehicle frame is pitched by 0.05 rad against the level radar.
    """
    stamps = np.arange(trajectory.stamps_us[0], trajectory.stamps_us[-1], 20_000, dtype=np.int64)
    count = len(stamps)
    error = _slow_error(count, 0.9995, rng) * (0.5, 0.5, 0.6)
    east, north, up = (_place(trajectory, stamps) + error).T
    velocity = trajectory.velocity(stamps) + rng.normal(0.0, 0.02, (count, 2))
    heading = 0.5 * np.pi - trajectory.pose(stamps)[:, 2] + 0.01 * _slow_error(count, 0.9995, rng)[:, 0]
    return pd.DataFrame(
        {
            "timestamp": stamps,
            "ins_status": "INS_SOLUTION_GOOD",
            **_geographic(east, north, up),
            **_projected(east, north, up),
            "velocity_north": velocity[:, 1],
            "velocity_east": velocity[:, 0],
            "velocity_down": rng.normal(0.0, 0.02, count),
            "roll": rng.normal(0.0, 0.003, count),
            "pitch": -0.05 + rng.normal(0.0, 0.003, count),
            "yaw": (heading + np.pi) % (2.0 * np.pi) - np.pi,
        }
    )[_INS_ORDER]


_INS_ORDER = [
    "timestamp",
    "ins_status",
    "latitude",
    "longitude",
    "altitude",
    "northing",
    "easting",
    "down",
    "utm_zone",
    "velocity_north",
    "velocity_east",
    "velocity_down",
    "roll",
    "pitch",
    "yaw",
]


def _place(trajectory: Trajectory, stamps_us: np.ndarray) -> np.ndarray:
    return trajectory.pose(stamps_us) * (1.0, 1.0, 0.0)


def _slow_error(count: int, memory: float, rng: np.random.Generator) -> np.ndarray:
    """Three errors of spread 1 that change slowly, shape (count, 3)."""
    noise = rng.normal(0.0, 1.0, (count, 3)) * np.sqrt(1.0 - memory**2)
    noise[0] /= np.sqrt(1.0 - memory**2)
    return lfilter([1.0], [1.0, -memory], noise, axis=0)


def _geographic(east: np.ndarray, north: np.ndarray, up: np.ndarray) -> dict[str, np.ndarray]:
    """Latitude, longitude and altitude near the town, to a few centimetres."""
    c, s = np.cos(_CONVERGENCE), np.sin(_CONVERGENCE)
    to_north, to_east = c * north + s * east, c * east - s * north
    return {
        "latitude": LATITUDE + to_north / 111_257.0,
        "longitude": LONGITUDE + to_east / (111_416.0 * np.cos(np.deg2rad(LATITUDE))),
        "altitude": ALTITUDE + up,
    }


def _projected(east: np.ndarray, north: np.ndarray, up: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "northing": NORTHING + north,
        "easting": EASTING + east,
        "down": -ALTITUDE - up,
        "utm_zone": "30U",
    }
