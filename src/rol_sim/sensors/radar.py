"""Simulate scans of a CTS350-X, a spinning 77 GHz radar, in a scene of triangles.

A fan of rays, a few per azimuth and height layer, is cast once per turn; each ray starts where the radar is
at that moment. Surfaces scatter by material, angle and a fixed texture of the world; leaves transmit part of
the power; smooth surfaces mirror rays, so that ghosts appear behind them.
`rol_sim.sensors.radar_signal` turns the echoes into bytes.

World frame as in `rol_sim.world.scene`; poses (x, y, yaw) in the plane, yaw counter-clockwise. The antenna
turns clockwise, row 0 looks 0.836 deg to the right of forward.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from rol.geometry import check_fields, check_poses
from rol.oxford import COUNTS_PER_TURN, N_AZIMUTHS
from rol_sim.sensors.radar_signal import echoes_to_codes, range_to_bins
from rol_sim.sensors.radar_surfaces import Surface, SurfaceHits, scatter, surface_table
from rol_sim.world.scene import Scene

# Encoder counts of the rows: 13, 27, ... 5599 of 5600.
FIRST_COUNT, COUNT_STEP = 13, 14
ROW_ANGLE = 2.0 * np.pi * COUNT_STEP / COUNTS_PER_TURN
MARGIN_ROWS = 5  # the beam's flanks reach this far before the first and after the last row
WEAKEST_ONWARD = 3.0  # a ray is followed on while a perfect scatterer would return more power than this


@dataclass(frozen=True)
class RadarSettings:
    """Settings of the simulated radar.

    Attributes
    ----------
    height : float
        Height of the antenna above the plane of the poses [m].
    rays_per_row : int
        Rays per azimuth row and layer.
    layers_deg, layer_widths_deg, layer_gains_db : tuple of float
        Elevations of the ray layers, what part of the elevation each stands for [deg], and two-way gain [dB]:
        a main beam of 1.8 deg and a fill below.
    gain_code : float
        Code of a perfect scatterer that fills the beam 10 m away.
    range_exponent : float
        Such a scatterer's power falls with range to this power.
    clutter_tail_db, clutter_tail_m : float
        Clutter tail: every surface is followed by echoes of longer paths (through windows, between cars and
        walls). Their mean power relative to the surface's [dB], and their mean delay [m].
    bounces : int
        How often a ray is mirrored on.
    transmission_layers : int
        Number of leaves that a ray may pass.
    doppler_seconds : float
        Range shift per closing speed [s].
    max_range : float
        Longest path looked at [m].
    noise_scale, streak_scale, interference_rate : float
        See `rol_sim.sensors.radar_signal.echoes_to_codes`.
    surfaces : dict
        Name of a material -> `Surface`, in place of the usual ones.

    Raises
    ------
    ValueError
        If a value is out of its range; the message names it.
    """

    height: float = 2.0
    rays_per_row: int = 3
    layers_deg: tuple[float, ...] = (1.2, 0.4, -0.4, -1.2, -2.5, -4.6, -8.5, -15.0)
    layer_widths_deg: tuple[float, ...] = (0.8, 0.8, 0.8, 0.8, 1.8, 2.4, 5.0, 8.0)
    layer_gains_db: tuple[float, ...] = (-9.0, -1.0, -1.0, -9.0, -16.0, -19.0, -23.0, -27.0)
    gain_code: float = 109.5
    range_exponent: float = 0.0
    clutter_tail_db: float = -17.0
    clutter_tail_m: float = 4.0
    bounces: int = 3
    transmission_layers: int = 4
    doppler_seconds: float = 0.049
    max_range: float = 168.0
    noise_scale: float = 1.0
    streak_scale: float = 1.0
    interference_rate: float = 0.3
    surfaces: dict[str, Surface] = field(default_factory=dict)

    def __post_init__(self) -> None:
        allowed = {
            "(0, inf)": "height layer_widths_deg clutter_tail_m max_range",
            "[1, inf)": "rays_per_row",
            "[-90, 90]": "layers_deg",
            "(-inf, inf)": "layer_gains_db range_exponent clutter_tail_db doppler_seconds",
            "[0, 255]": "gain_code",
            "[0, inf)": "bounces transmission_layers noise_scale streak_scale interference_rate",
        }
        check_fields(self, allowed)


@dataclass
class Rays:
    """Rays in flight.

    Attributes
    ----------
    origin, direction : array, shape (n, 3), float32
        Where this leg of the path starts [m], and its unit direction.
    heading : array, shape (n, 3), float32
        Direction in which the ray left the radar: there its echoes are seen, wherever it went then.
    row : array, shape (n,), float32
        Azimuth row, fractional.
    length, weight : array, shape (n,), float32
        Path so far [m]; power that a perfect scatterer 10 m away would return.
    bounced : array, shape (n,), int32
        How often it was mirrored.
    """

    origin: np.ndarray
    direction: np.ndarray
    heading: np.ndarray
    row: np.ndarray
    length: np.ndarray
    weight: np.ndarray
    bounced: np.ndarray

    def take(self, index: np.ndarray) -> Rays:
        """Select rays by index."""
        return Rays(*(getattr(self, part.name)[index] for part in fields(self)))


def beam_azimuths() -> np.ndarray:
    """Return the direction of every row in the radar's frame.

    Returns
    -------
    azimuths : array, shape (400,)
        Counter-clockwise from forward, falling from -0.015 to -6.28 [rad]; the sensor's counters are 13, 27,
        ... 5599.
    """
    return -2.0 * np.pi * (FIRST_COUNT + COUNT_STEP * np.arange(N_AZIMUTHS)) / COUNTS_PER_TURN


def simulate_scan(
    scene: Scene,
    row_poses: np.ndarray,
    row_velocities: np.ndarray,
    rng: np.random.Generator,
    settings: RadarSettings | None = None,
    object_velocities: dict[int, tuple[float, float]] | None = None,
) -> np.ndarray:
    """Simulate one turn of the radar.

    Parameters
    ----------
    scene : Scene
        What stands around.
    row_poses : array, shape (400, 3)
        Pose of the radar in the world at the time of each row (x, y, yaw) [m, m, rad].
    row_velocities : array, shape (400, 2)
        Its velocity in the world then [m/s].
    rng : np.random.Generator
        Source of ray jitter, speckle, noise and interference.
    settings : RadarSettings or None
        None takes the usual settings.
    object_velocities : dict or None
        Object number -> velocity (x, y) in the world [m/s] of what moves, for its Doppler shift.

    Returns
    -------
    codes : array, shape (400, 3768), uint8
        Half-dB power codes, as `rol_sim.session.oxford_files.save_radar` takes them.

    Raises
    ------
    ValueError
        If poses or velocities do not have 400 rows of finite numbers.
    """
    settings = settings or RadarSettings()
    row_poses, velocities = check_poses(row_poses, "row_poses"), np.asarray(row_velocities, dtype=np.float64)
    if row_poses.shape != (N_AZIMUTHS, 3):
        raise ValueError(f"row_poses: expected shape (400, 3), got {row_poses.shape}")
    if velocities.shape != (N_AZIMUTHS, 2) or not np.isfinite(velocities).all():
        raise ValueError(f"row_velocities: expected 400 finite rows (x, y), got shape {velocities.shape}")
    echoes = trace_echoes(scene, emit_rays(row_poses, rng, settings), settings)
    rows, ranges, powers, headings, objects = echoes
    closing = velocities[np.clip(np.rint(rows), 0, N_AZIMUTHS - 1).astype(int)]
    if object_velocities:
        closing = closing - _look_up_velocities(objects, object_velocities)
    ranges = ranges - settings.doppler_seconds * np.einsum("ij,ij->i", closing, headings)
    return echoes_to_codes(
        rows,
        range_to_bins(ranges),
        powers,
        rng,
        noise_scale=settings.noise_scale,
        streak_scale=settings.streak_scale,
        interference_rate=settings.interference_rate,
    )


def emit_rays(row_poses: np.ndarray, rng: np.random.Generator, settings: RadarSettings) -> Rays:
    """Generate the rays of one turn: rows x rays per row x layers, with jitter.

    Parameters
    ----------
    row_poses : array, shape (400, 3)
        Poses of the radar [m, m, rad].
    rng : np.random.Generator
        Source of the jitter.
    settings : RadarSettings
        Layers and gains.

    Returns
    -------
    rays : Rays
        Their weights add up so that a perfect scatterer 10 m away gets the code `gain_code`.
    """
    per_row, n_layers = settings.rays_per_row, len(settings.layers_deg)
    n = (N_AZIMUTHS + 2 * MARGIN_ROWS) * per_row
    jitter = rng.random((2, n, n_layers))
    rows = (np.arange(n)[:, None] + jitter[0]) / per_row - MARGIN_ROWS - 0.5
    elevations = np.deg2rad(np.array(settings.layers_deg) + (jitter[1] - 0.5) * settings.layer_widths_deg)
    at, knots = np.clip(rows, 0.0, N_AZIMUTHS - 1.0), np.arange(N_AZIMUTHS)
    x, y, yaw = (np.interp(at, knots, values) for values in (*row_poses[:, :2].T, np.unwrap(row_poses[:, 2])))
    angle = yaw - (FIRST_COUNT + COUNT_STEP * rows) * 2.0 * np.pi / COUNTS_PER_TURN
    flat = np.cos(elevations)
    direction = np.stack([flat * np.cos(angle), flat * np.sin(angle), np.sin(elevations)], axis=-1)
    gains = 10.0 ** (np.array(settings.layer_gains_db) / 10.0) * settings.layer_widths_deg
    # 1.7 rows: the area under the two-way pattern in azimuth; 1.6 deg: that of the main beam in elevation.
    weight = 10.0 ** (settings.gain_code / 20.0) * gains / (1.7 * per_row * 1.6)
    origin = np.stack([x, y, np.full_like(x, settings.height)], axis=-1)
    return Rays(
        origin=origin.reshape(-1, 3).astype(np.float32),
        direction=direction.reshape(-1, 3).astype(np.float32),
        heading=direction.reshape(-1, 3).astype(np.float32),
        row=rows.ravel().astype(np.float32),
        length=np.zeros(n * n_layers, dtype=np.float32),
        weight=np.broadcast_to(weight, rows.shape).ravel().astype(np.float32),
        bounced=np.zeros(n * n_layers, dtype=np.int32),
    )


def trace_echoes(scene: Scene, rays: Rays, settings: RadarSettings) -> tuple[np.ndarray, ...]:
    """Trace rays through leaves and off mirrors, and collect the echoes.

    Parameters
    ----------
    scene : Scene
        What stands around.
    rays : Rays
        Rays as emitted.
    settings : RadarSettings
        Surfaces, limits.

    Returns
    -------
    rows, ranges, powers : array, shape (n,)
        Place (row, range [m]) and power of every echo.
    headings : array, shape (n, 2)
        Unit vector in the plane, in which the radar sees it.
    objects : array, shape (n,)
        Object number.
    """
    table, found = surface_table(settings.surfaces), []
    ray_spacing = ROW_ANGLE / settings.rays_per_row
    tail_fraction = 10.0 ** (settings.clutter_tail_db / 10.0)
    for _ in range(settings.transmission_layers + settings.bounces):
        rays, hits = _hit_surfaces(scene, rays, table, settings)
        echoes = scatter(hits, ray_spacing, tail_fraction, settings.clutter_tail_m)
        source = echoes.sources
        rows = rays.row[source] - echoes.turns / np.float32(ROW_ANGLE)
        found.append((rows, echoes.ranges, echoes.powers, rays.heading[source, :2], hits.objects[source]))
        rays = _follow_rays(rays, hits, settings.bounces)
        if len(rays.row) == 0:
            break
    rows, ranges, powers, headings, objects = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return rows, ranges, powers, headings / np.linalg.norm(headings, axis=1, keepdims=True), objects


def _hit_surfaces(
    scene: Scene, rays: Rays, table: np.ndarray, settings: RadarSettings
) -> tuple[Rays, SurfaceHits]:
    """Cast rays; returns those that hit something within range, and their hits."""
    found = scene.cast(np.concatenate([rays.origin, rays.direction], axis=1))
    near = np.flatnonzero(rays.length + found.t < settings.max_range)
    rays, t = rays.take(near), found.t[near]
    ranges = rays.length + t
    return rays, SurfaceHits(
        points=rays.origin + t[:, None] * rays.direction,
        directions=rays.direction,
        normals=found.normals[near],
        cosines=found.cos_incidence[near],
        objects=found.object_id[near],
        surfaces=table[found.material[near]],
        headings=rays.heading,
        ranges=ranges,
        weights=rays.weight * (ranges / 10.0) ** np.float32(-settings.range_exponent),
        is_direct=rays.bounced == 0,
    )


def _follow_rays(rays: Rays, hits: SurfaceHits, bounces: int) -> Rays:
    """Continue rays behind leaves and glass, and mirrored ones; the rest ends."""
    mirror, passes, strong = hits.surfaces[:, 6], hits.surfaces[:, 7], hits.weights > WEAKEST_ONWARD
    is_upright = np.abs(hits.normals[:, 2]) < 0.3
    through = np.flatnonzero((passes > 0.0) & strong)
    back = np.flatnonzero((mirror > 0.0) & strong & (rays.bounced < bounces) & is_upright)
    along = np.einsum("ij,ij->i", rays.direction[back], hits.normals[back])
    mirrored = rays.direction[back] - 2.0 * along[:, None] * hits.normals[back]
    both = np.concatenate([through, back])
    onward = rays.take(both)
    onward.direction = np.concatenate([rays.direction[through], mirrored])
    onward.origin = hits.points[both] + np.float32(0.02) * onward.direction
    onward.length = hits.ranges[both]
    # Power is lost on the way out and on the way back.
    onward.weight *= np.concatenate([passes[through], mirror[back]]) ** 2
    onward.bounced[len(through) :] += 1
    return onward


def _look_up_velocities(objects: np.ndarray, object_velocities: dict[int, tuple[float, float]]) -> np.ndarray:
    velocities = np.zeros((len(objects), 2))
    for number, velocity in object_velocities.items():
        velocities[objects == number] = velocity
    return velocities
