"""Simulate sweeps of an HDL-32E on a moving vehicle, in the units of Oxford's raw files.

Radar frame: x forward, y left, z up, level, above the ground by the mast's height. The lidar's place in it
is its extrinsic calibration. Angles run clockwise seen from above, 0 to the lidar's left, elevations
downward.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from rol.geometry import check_fields
from rol.oxford import ELEVATIONS_DOWN, FIRE_HEIGHT, LIDARS, RANGE_UNIT
from rol_sim.world.mesh import Material
from rol_sim.world.scene import Scene

FIRING_US = 46.08  # time between two firings of the same laser
FIRINGS_PER_PACKET = 12
TURN_US = 50_000.0
PACKET_RAD = 2.0 * np.pi * FIRINGS_PER_PACKET * FIRING_US / TURN_US  # turned during one packet
SEAM_RAD = np.pi  # a sweep begins with the first packet past this angle, to the lidar's right
# How many of the 32 lasers, from the top, see past the own car, per 10 deg of angle, left lidar; below is the
# roof, at 0 to 40 deg stand the mast of the radar and the other lidar. Constants of Oxford's car, measured on
# 257 real sweeps.
CLEAR_LASERS = np.array(
    [0, 0, 0, 0, 18, 17, 17, 18, 19, 23, 27, 26, 25, 28, 31, 32, 32, 32]
    + [32, 32, 32, 32, 32, 32, 32, 31, 27, 26, 26, 25, 22, 21, 21, 20, 19, 19]
)

# Material -> fraction of light sent back by a head-on surface, fraction of rays lost without a trace,
# softness [m].
SURFACES = {
    "GROUND": (0.12, 0.01, 0.0),
    "PAVEMENT": (0.22, 0.01, 0.0),
    "GRASS": (0.25, 0.03, 0.03),
    "KERB": (0.25, 0.01, 0.0),
    "FACADE": (0.35, 0.01, 0.0),
    "GLASS": (0.10, 0.55, 0.0),
    "ROOF": (0.20, 0.01, 0.0),
    "WALL": (0.30, 0.01, 0.0),
    "METAL": (0.30, 0.05, 0.0),
    "VEHICLE": (0.25, 0.10, 0.0),
    "HEDGE": (0.35, 0.05, 0.10),
    "TREE_CROWN": (0.30, 0.20, 0.05),
    "TREE_TRUNK": (0.25, 0.01, 0.0),
    "PERSON": (0.30, 0.02, 0.0),
}


@dataclass(frozen=True)
class LidarSettings:
    """Settings of the simulated lidar.

    Attributes
    ----------
    range_noise_m : float
        Standard deviation of a range [m].
    lost_fraction : float
        Fraction of returns lost at random, besides those that the surface swallows.
    max_range_m : float
        Farthest range [m].
    reach_m : float
        Range at which a head-on surface that sends back a tenth of the light is seen half of the time [m].

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    range_noise_m: float = 0.005
    lost_fraction: float = 0.0
    max_range_m: float = 100.0
    reach_m: float = 75.0

    def __post_init__(self) -> None:
        allowed = {"[0, inf)": "range_noise_m", "[0, 1]": "lost_fraction", "(0, inf)": "max_range_m reach_m"}
        check_fields(self, allowed)


@dataclass(frozen=True)
class Sweep:
    """One turn in the units of the raw file, with the true materials.

    Attributes
    ----------
    intensities : array, shape (32, n), uint8
        Intensity of each return.
    ranges : array, shape (32, n), uint16
        Range in units of 2 mm, 0 where nothing came back.
    angles : array, shape (n,), uint16
        Angle of each firing in hundredths of a degree.
    stamps_us : array, shape (n,), int64
        Time of each firing [us].
    materials : array, shape (32, n), uint8
        `Material` that sent each return back; 0 where nothing came back.
    """

    intensities: np.ndarray
    ranges: np.ndarray
    angles: np.ndarray
    stamps_us: np.ndarray
    materials: np.ndarray


@lru_cache
def surface_table() -> np.ndarray:
    """Return the rows of `SURFACES` in the order of `Material`, shape (n_materials, 3)."""
    return np.array([SURFACES.get(m.name, (0.0, 1.0, 0.0)) for m in Material], dtype=np.float32)


def schedule_firings(
    start_us: int, rng: np.random.Generator, *, turn_us: float = TURN_US, past_seam: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return times and angles of the firings of one turn, in whole packets: 1080 or 1092 as in real sweeps.

    Parameters
    ----------
    start_us : int
        Time of the first firing [us].
    rng : numpy.random.Generator
        Draws the jitter of the packets' times.
    turn_us : float
        Duration of the turn [us].
    past_seam : float
        How far past `SEAM_RAD` the first packet begins [rad]. The sweep ends with the packet that reaches it
        again.

    Returns
    -------
    stamps_us : array, shape (n,), int64
        Time of each firing: packets' own in every 12th place, interpolated between.
    angles : array, shape (n,), uint16
        Angle in hundredths of a degree, 0 .. 35999.
    """
    per_firing = 2.0 * np.pi * FIRING_US / turn_us
    n = FIRINGS_PER_PACKET * int(np.ceil((2.0 * np.pi - past_seam) / (FIRINGS_PER_PACKET * per_firing)))
    firing = np.arange(n)
    packets = np.arange(0, n + FIRINGS_PER_PACKET, FIRINGS_PER_PACKET)
    jitter = np.append(0.0, rng.normal(0.0, 3.0, len(packets) - 1))
    stamps = start_us + np.rint(np.interp(firing, packets, packets * FIRING_US + jitter)).astype(np.int64)
    angles = np.rad2deg(SEAM_RAD + past_seam + per_firing * firing) * 100.0
    return stamps, (np.rint(angles).astype(np.int64) % 36_000).astype(np.uint16)


def _sweep_rays(
    angles: np.ndarray, T_radar_lidar: np.ndarray, poses: np.ndarray, height: float
) -> np.ndarray:
    """Return the rays of one turn in the town's frame.

    Parameters
    ----------
    angles : array, shape (n,)
        Angle of each firing [0.01 deg].
    T_radar_lidar : array, shape (4, 4)
        Place of the lidar in the radar frame.
    poses : array, shape (n, 3)
        Pose of the radar in the town at each firing (x, y, yaw).
    height : float or array, shape (n,)
        Height of the radar in the town's frame [m].

    Returns
    -------
    rays : array, shape (32 n, 6), float32
        Origin and unit direction, laser after laser.
    """
    a, e = np.deg2rad(0.01 * np.asarray(angles, dtype=float)), ELEVATIONS_DOWN[:, None]
    level = np.stack([np.sin(a), np.cos(a), np.zeros_like(a)]).astype(np.float32)  # (3, n) in the lidar frame
    R, lift = T_radar_lidar[:3, :3], np.array([0.0, 0.0, FIRE_HEIGHT])
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])

    def to_town(v: np.ndarray) -> np.ndarray:  # (3, ...) in the radar frame, turned by the yaw of each firing
        return np.stack([c * v[0] - s * v[1], s * v[0] + c * v[1], np.broadcast_to(v[2], c.shape)])

    origin = to_town((R @ lift + T_radar_lidar[:3, 3])[:, None]) + np.stack(
        [poses[:, 0], poses[:, 1], 0 * c + height]
    )
    flat, down = to_town(R @ level), to_town((R @ [0.0, 0.0, -1.0])[:, None])  # (3, n) each
    rays = np.empty((len(ELEVATIONS_DOWN), len(a), 6), dtype=np.float32)
    rays[..., :3] = origin.T
    rays[..., 3:] = np.cos(e)[..., None] * flat.T + np.sin(e)[..., None] * down.T
    return rays.reshape(-1, 6)


def simulate_sweep(
    scene: Scene,
    firings: tuple[np.ndarray, np.ndarray],
    T_radar_lidar: np.ndarray,
    poses: np.ndarray,
    height: float,
    rng: np.random.Generator,
    settings: LidarSettings | None = None,
) -> Sweep:
    """Simulate one sweep while the car moves.

    Parameters
    ----------
    scene : Scene
        The world at the middle of the turn.
    firings : tuple of two arrays, shape (n,)
        Times [us] and angles [0.01 deg], from `schedule_firings`.
    T_radar_lidar : array, shape (4, 4)
        Place of the lidar in the radar frame.
    poses : array, shape (n, 3)
        Pose of the radar in the town at each firing (x, y, yaw).
    height : float or array, shape (n,)
        Height of the radar in the town's frame [m].
    rng : numpy.random.Generator
        Draws noise and losses.
    settings : LidarSettings or None
        Settings; None for the defaults.

    Returns
    -------
    sweep : Sweep
        The turn in the units of the raw file.
    """
    (stamps_us, angles), settings = firings, settings or LidarSettings()
    hits = scene.cast(_sweep_rays(angles, T_radar_lidar, poses, height))
    reached = np.flatnonzero(hits.t < settings.max_range_m)
    r, cosine, material = hits.t[reached], hits.cos_incidence[reached], hits.material[reached]
    reflectivity, lost_fraction, softness = surface_table()[material].T
    draws = rng.standard_normal((4, len(reached)), dtype=np.float32)
    # The weakest return that is noticed varies, so that surfaces fade out without a sharp edge.
    faintest = 0.1 / settings.reach_m**2 * np.exp(0.35 * draws[0])
    is_lost = rng.random(len(reached), dtype=np.float32) > (1.0 - lost_fraction) * (
        1.0 - settings.lost_fraction
    )
    is_seen = (reflectivity * cosine > faintest * np.maximum(r, 1.0) ** 2) & ~is_lost
    r = r + settings.range_noise_m * draws[1] + np.abs(draws[2]) * softness
    is_seen &= (r > 0.9) & (r < settings.max_range_m)
    shade = 100.0 * reflectivity * cosine * np.exp(0.3 * draws[3])
    seen = reached[is_seen]
    intensities, ranges, materials = (
        np.zeros(len(hits.t), dtype=kind) for kind in (np.uint8, np.uint16, np.uint8)
    )
    intensities[seen] = np.clip(shade[is_seen], 1.0, 255.0)
    ranges[seen] = np.rint(r[is_seen] / RANGE_UNIT)
    materials[seen] = material[is_seen]
    shape = (len(ELEVATIONS_DOWN), len(angles))
    return Sweep(
        intensities.reshape(shape), ranges.reshape(shape), angles, stamps_us, materials.reshape(shape)
    )


def hide_behind_car(sweep: Sweep, sensor: str) -> Sweep:
    """Remove the returns of the beams that end on the own car.

    Parameters
    ----------
    sweep : Sweep
        A turn as it would be without the car.
    sensor : str
        "velodyne_left" or "velodyne_right"; the right lidar's view is the mirror image of the left one's.

    Returns
    -------
    sweep : Sweep
        The turn with 0 in place of the returns below `CLEAR_LASERS`. Returns from the car itself are left
        out.

    Raises
    ------
    ValueError
        If there is no such lidar.
    """
    if sensor not in LIDARS:
        raise ValueError(f"sensor: expected one of {', '.join(LIDARS)}, got {sensor!r}")
    angles = sweep.angles.astype(np.int64)
    mirrored = angles if sensor == LIDARS[0] else (53_999 - angles) % 36_000
    is_clear = np.arange(len(ELEVATIONS_DOWN))[:, None] < CLEAR_LASERS[mirrored // 1000]
    return replace(
        sweep,
        intensities=sweep.intensities * is_clear,
        ranges=sweep.ranges * is_clear,
        materials=sweep.materials * is_clear,
    )
