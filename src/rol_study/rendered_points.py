"""Render points on the real route: simulated radar scans at the true poses of a real session,
through a network.

The public data hold map, poses and odometry of the paper's sessions, but no scans. So the scans are simulated
in a world that is built from the real map.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rol.geometry import relative_pose
from rol.oxford import RadarOdometry
from rol.pairs import estimate_twists
from rol.pix2pix import TrainedNetwork
from rol_beyond.front_ends import generate_points
from rol_data import rall
from rol_sim.session.settings import parse_settings
from rol_sim.session.simulation import SimulatedSession, build_session, make_scan

STREET = {"parked_share": 0.15, "vehicles": 10, "people": 6}  # as for the simulated twins of the real scans


def build_segment(
    real_root: Path | str, number: str, first_scan: int, n_scans: int, seed: int, **changes: Any
) -> SimulatedSession:
    """Build a simulated session along a segment of a real session's trajectory.

    The map and the poses are real, and with them speed and stops. The radar, the heights and materials of the
    world, the changes since the map was made and the traffic are simulated.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `rol_data.rall.find_real_root`.
    number : str
        Number of the session, such as "02".
    first_scan, n_scans : int
        First scan in ``pose_xy_<number>.txt``, and number of scans: at least 3, or 0 for all that follow.
    seed : int
        Draws all that is simulated: the same seed gives the same world for all sessions, each on a day of its
        own.
    **changes
        Settings of `SessionSettings` other than `STREET`, such as ``changed_share``.

    Returns
    -------
    session : SimulatedSession
        Ready for `make_scan`. It has no sweeps.

    Raises
    ------
    SettingsError
        If the file holds no such scans, a setting is invalid, or there are no real data.
    rol_data.rall.RallError
        If there is no such session, or its file or the map is at fault.

    Notes
    -----
    The public poses have no times: scans are assumed to be a quarter of a second apart, with the radar's own
    spread of 1.5 ms. In memory are the map and the world within 180 m of the segment. Changes since the map
    was made are drawn for a segment: another ``first_scan`` or ``n_scans`` is another day.
    """
    name, path = f"sim-rendered-{number}", Path(real_root) / rall.POSES_PATH / f"pose_xy_{number}.txt"
    own = {
        "start": "2019-01-10T12:00:00",
        "seed": zlib.crc32(str(number).encode()),
        "sweeps": "none",
        **STREET,
        **changes,
        "poses": number,
        "first_scan": int(first_scan),
        "scans": int(n_scans),
    }
    section = {"world": "route", "seed": int(seed), "real_root": str(real_root), "sessions": {name: own}}
    return build_session(parse_settings(section, str(path)), name)


def render_points(
    session: SimulatedSession,
    network: TrainedNetwork,
    *,
    bf16: bool = False,
    tta_rotations: int | None = None,
) -> Iterator[np.ndarray]:
    """Generate the lidar points of a simulated session, scan by scan: radar scan, motion compensation,
    network.

    Parameters
    ----------
    session : SimulatedSession
        From `build_segment`.
    network : TrainedNetwork
        From `rol.pix2pix.load_network`, with its threshold and thinning.
    bf16, tta_rotations
        As in `rol_beyond.front_ends.generate_points`.

    Yields
    ------
    points : array, shape (k, 2)
        Points in the radar frame at mid-scan, the time of the pose; x forward, y left [m].

    Notes
    -----
    Motion is compensated as in the pipeline, but by the velocity of the true poses, one-sided at the ends of
    the segment: errors of an odometry do not enter.

    The network `unet` was trained on this route, in such a world of seed 21: on scans 0 to 4999 of session 02
    but for the surroundings of the eleven real scans and of one more place (``sets`` in its card). Its points
    there are too good.
    """
    how = {"bf16": bf16, "tta_rotations": tta_rotations}
    for index, twist in enumerate(true_twists(session)):
        scan = make_scan(session, index)
        yield generate_points(network, scan.power, scan.azimuths, tuple(twist), **how)[0]


def true_twists(session: SimulatedSession) -> np.ndarray:
    """Compute the body velocity at every scan from the true poses,
    as `rol.pairs.estimate_twists` does from an odometry.

    Parameters
    ----------
    session : SimulatedSession
        The session.

    Returns
    -------
    twists : array, shape (n, 3)
        vx, vy, yaw rate [m/s, m/s, rad/s].
    """
    first, middles = session.scans_us, session.scans_us + session.turns_us // 2
    poses = session.trajectory.pose(middles)
    steps = np.zeros((len(poses) - 1, 6))
    steps[:, [0, 1, 5]] = relative_pose(poses[:-1], poses[1:])
    return estimate_twists(RadarOdometry(middles[1:], middles[:-1], first[1:], first[:-1], steps))
