"""Clouds for the real route: the simulated radar at the true poses of a real session, through a network.

The public data hold map, poses and odometry of the paper's sessions, but no scans. Here the scans are made: the world is
grown from the real map, the simulated car drives through the real poses, and what its radar sees goes through the network.
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

STREET = {"parked_share": 0.15, "vehicles": 10, "people": 6}  # as for the twins of the real scans


def render_points(
    real_root: Path | str,
    number: str,
    first_scan: int,
    n_scans: int,
    network: TrainedNetwork,
    seed: int,
    *,
    bf16: bool = False,
    tta_rotations: int | None = None,
    **changes: Any,
) -> Iterator[np.ndarray]:
    """Generate the lidar points of a segment of a real session, scan by scan, as its radar might have led to them.

    Real are the map and the poses, and with them the speed and the stops. Simulated are the radar, the heights and materials
    of the world, what the map does not show or shows no more, and who is met.

    Parameters
    ----------
    real_root : path
        Folder of the real data, see `rol_data.rall.find_real_root`.
    number : str
        Of the session, such as "02".
    first_scan, n_scans : int
        Where in ``pose_xy_<number>.txt`` the segment begins, and how many scans it has: at least 3, or 0 for all that follow.
    network : TrainedNetwork
        From `rol.pix2pix.load_network`; threshold and thinning are its own.
    seed : int
        Draws all that is simulated: the same seed, the same world for all sessions, each on a day of its own.
    bf16, tta_rotations
        Of `rol_beyond.front_ends.generate_points`.
    **changes
        Settings of `SessionSettings` other than those of the twins in chapter 1, such as ``changed_share``.

    Yields
    ------
    cloud : array, shape (k, 2)
        Points in the radar frame at mid-scan, the time of the pose; x forward, y left [m].

    Raises
    ------
    SettingsError
        If the file holds no such scans, a setting is at fault, or there are no real data.
    rol_data.rall.RallError
        If there is no such session, or its file or the map is at fault. All of these before the first cloud is asked for.

    Notes
    -----
    The public poses have no times: scans are taken to be a quarter of a second apart, give or take the radar's own 1.5 ms.
    The car moves while its radar turns. This is taken out as in the live chain, but by a velocity from the true poses, at
    the ends of the segment from one side only; errors of an odometry do not enter.

    In memory are the map, one scan, and the world within 180 m of the segment. What has changed since the map was made is
    drawn for a segment: another ``first_scan`` or ``n_scans`` is another day.

    The network `unet` was trained on this route, in such a world of seed 21: from scans 0 to 4999 of session 02 but for the
    surroundings of the eleven real scans and of one more place (``sets`` in its card). Clouds from there flatter it.
    """
    session = build_segment(real_root, number, first_scan, n_scans, seed, **changes)
    return _generate(session, network, bf16=bf16, tta_rotations=tta_rotations)


def build_segment(
    real_root: Path | str, number: str, first_scan: int, n_scans: int, seed: int, **changes: Any
) -> SimulatedSession:
    """Prepare the trajectory along a segment of a real session, see `render_points`.

    Returns
    -------
    session : SimulatedSession
        Ready for `make_scan`. It has no sweeps.
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


def _generate(session: SimulatedSession, network: TrainedNetwork, **how: Any) -> Iterator[np.ndarray]:
    for index, twist in enumerate(true_twists(session)):
        scan = make_scan(session, index)
        yield generate_points(network, scan.power, scan.azimuths, tuple(twist), **how)[0]


def true_twists(session: SimulatedSession) -> np.ndarray:
    """Compute the body velocity at every scan from the true poses, as `rol.pairs.estimate_twists` does from an odometry.

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
