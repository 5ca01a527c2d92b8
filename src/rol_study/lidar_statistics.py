"""Compute statistics of HDL-32E sweeps, real or simulated: beams, returns, ranges, heights, noise,
intensities.

Sweeps are points in the frame of the left lidar as `rol.oxford.load_sweep` returns them, shape (n, 4): x, y,
z [m] and intensity. Laser and angle of a point are recovered from its place, since a .bin stores neither.
Statistics of the sensor and the car (beams, noise, losses, view past the car) hold anywhere; those of ranges,
heights and intensities depend on the scene as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from rol.lidar import relate_sensors, sweep_to_radar
from rol.oxford import (
    ELEVATIONS_DOWN,
    EXTRINSICS,
    FIRE_HEIGHT,
    OxfordError,
    Session,
    load_sweep,
    load_timestamps,
    load_velodyne_binary,
)
from rol.pairs import usable_sweeps
from rol_study.radar_statistics import hellinger_distance
from rol_study.real_submap import SWEEPS_PATH

SENSOR = "velodyne_left"
REAL, HALVES = "real: one street", ("its first half", "its second half")
AZIMUTH_CELLS = 72  # of 5 deg
SEAM_CELL = AZIMUTH_CELLS // 2  # sweeps begin and end at 180 to 184 deg
NEAR_M = 1.9  # real returns nearer than this lie on the own car
GROUND_M = -1.5  # points below this height in the radar frame count as ground, as in chapter 3
CLEAR_DEG = (190.0, 250.0)  # where all lasers of the left lidar see past the car; no sweep begins there
STEEP_LASERS = slice(27, 32)  # they look down on the road within 5 m
MAX_ERROR_DEG = 0.1  # of a point's elevation from that of its laser
MAX_STEP_DEG = 0.45  # neighbours in angle are not farther apart
EDGES = {
    "ranges": np.concatenate([np.arange(1.0, 20.0, 1.0), np.arange(20.0, 106.0, 5.0)]),
    "heights": np.arange(-3.0, 12.1, 0.25),
    "intensities": np.concatenate([np.arange(0.0, 20.0, 2.0), np.arange(20.0, 110.0, 10.0), [256.0]]),
}


def load_real_sweeps(real_root: Path | str, count: int) -> list[np.ndarray]:
    """Read real sweeps of the left lidar, evenly chosen from the listed ones.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    count : int
        Number of sweeps; all of them if there are fewer.

    Returns
    -------
    sweeps : list of array, shape (n, 4), float32
        In order of time; files that are not listed are left out.

    Raises
    ------
    rol.oxford.OxfordError
        If the list or a listed file is missing or at fault, or no sweep is listed as valid.
    """
    folder = Path(real_root) / SWEEPS_PATH
    stamps, valid = load_timestamps(folder / f"{SENSOR}.timestamps")
    if not valid.any():
        raise OxfordError(f"{folder / f'{SENSOR}.timestamps'}: no sweep is valid")
    chosen = _choose_evenly(stamps[valid], count)
    return [load_velodyne_binary(folder / "binaries" / f"{us}.bin") for us in chosen]


def load_left_sweeps(session: Session, count: int) -> list[np.ndarray]:
    """Read sweeps of a session's left lidar, evenly chosen from the usable ones.

    Parameters
    ----------
    session : Session
        The session.
    count : int
        Number of sweeps; all of them if there are fewer.

    Returns
    -------
    sweeps : list of array, shape (n, 4), float32
        In order of time; empty for a session without a left lidar, or with one that is no HDL-32E.

    Raises
    ------
    rol.oxford.OxfordError
        If a file is at fault.
    """
    stamps = usable_sweeps(session).get("left", np.zeros(0, dtype=np.int64))
    sweeps = [load_sweep(session, SENSOR, int(us))[0] for us in _choose_evenly(stamps, count)]
    return sweeps if all(_elevation_error(points) < MAX_ERROR_DEG for points in sweeps) else []


def recover_beams(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Recover laser, angle and range of every point.

    Parameters
    ----------
    points : array, shape (n, 3) or more columns
        Points in the lidar frame, not compensated for motion [m].

    Returns
    -------
    lasers : array, shape (n,), int64
        0 (looks highest) .. 31.
    angles_deg : array, shape (n,)
        Clockwise seen from above, 0 to the lidar's left [0, 360).
    ranges_m : array, shape (n,)
        From the lasers' centre [m].

    Raises
    ------
    ValueError
        If a point is farther than 0.1 deg from the elevation of every laser: another frame or another lidar.
    """
    xyz, ranges, elevations = _view_from_lasers(points)
    error_deg = _elevation_error(points)
    if error_deg > MAX_ERROR_DEG:
        raise ValueError(
            f"points: not in the frame of an HDL-32E: one is {error_deg:.2f} deg off every laser"
        )
    angles_deg = np.rad2deg(np.arctan2(xyz[:, 0], xyz[:, 1])) % 360.0
    return _nearest_lasers(elevations), angles_deg, ranges


def angle_step(angles_deg: np.ndarray) -> float:
    """Estimate the angle between two firings [deg] from the distinct angles, rounded to 0.01 deg,
    of a sweep."""
    steps = np.diff(np.unique(np.rint(100.0 * np.asarray(angles_deg)).astype(int))) / 100.0
    steps = (
        steps[np.abs(steps - np.median(steps)) < 0.03] if len(steps) else steps
    )  # no gaps, not the overlap
    return float(steps.mean()) if len(steps) else float("nan")


def first_angle(lasers: np.ndarray, angles_deg: np.ndarray) -> float:
    """Return the angle of a sweep's first return of the laser with most returns [deg]."""
    return float(angles_deg[np.argmax(lasers == np.bincount(lasers).argmax())])


def return_fractions(sweeps: Sequence[np.ndarray], min_range_m: float = NEAR_M) -> np.ndarray:
    """Compute which fraction of the beams returns from beyond a range.

    Parameters
    ----------
    sweeps : sequence of array, shape (n, 4)
        Sweeps.
    min_range_m : float
        Nearer returns are left out, such as those from the own car [m].

    Returns
    -------
    fractions : array, shape (32, 72)
        By laser and 5 deg of angle. Firings are counted where a sweep begins and ends, since two sweeps
        differ by a packet there, and follow from the step elsewhere, since firings without a return leave no
        trace.
    """
    counts, firings = np.zeros((len(ELEVATIONS_DOWN), AZIMUTH_CELLS)), np.zeros(AZIMUTH_CELLS)
    for points in sweeps:
        lasers, angles, ranges = recover_beams(points)
        cells = (angles * AZIMUTH_CELLS / 360.0).astype(int)
        is_far = ranges > min_range_m
        np.add.at(counts, (lasers[is_far], cells[is_far]), 1.0)
        own = np.full(AZIMUTH_CELLS, 360.0 / AZIMUTH_CELLS / angle_step(angles))
        own[SEAM_CELL] = len(np.unique(np.rint(100.0 * angles[cells == SEAM_CELL])))
        firings += own
    return counts / np.maximum(firings, 1.0)


def range_noise(points: np.ndarray, range_limits_m: tuple[float, float] = (2.0, 20.0)) -> float:
    """Estimate the noise of a range from second differences along the scan lines.

    On a smooth surface r[i-1] - 2 r[i] + r[i+1] is noise with six times the variance of a single range. The
    median absolute deviation ignores edges. Offsets between lasers cancel.

    Parameters
    ----------
    points : array, shape (n, 3) or more columns
        One sweep.
    range_limits_m : tuple of float
        Ranges to use [m].

    Returns
    -------
    noise_m : float
        Standard deviation [m]; NaN without three neighbours in a row.
    """
    lasers, angles, ranges = recover_beams(points)
    order = np.lexsort((angles, lasers))
    lasers, angles, ranges = lasers[order], angles[order], ranges[order]
    is_next = (np.diff(lasers) == 0) & (np.diff(angles) < MAX_STEP_DEG)
    is_used = (
        is_next[:-1] & is_next[1:] & (ranges[1:-1] > range_limits_m[0]) & (ranges[1:-1] < range_limits_m[1])
    )
    second = np.diff(ranges, 2)[is_used]
    return float(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0)) if len(second) else float("nan")


def plane_noise(
    points: np.ndarray, rng: np.random.Generator, *, count: int = 600, radius_m: float = 0.35
) -> dict[str, float]:
    """Measure how far points lie from planes through their neighbours, along the beam.

    Roughness of the surface and offsets between lasers count as well.

    Parameters
    ----------
    points : array, shape (n, 3) or more columns
        One sweep.
    rng : numpy.random.Generator
        Draws the places.
    count : int
        Number of places, at ranges of 2 to 20 m.
    radius_m : float
        Radius of a neighbourhood [m]; it needs 12 points of three lasers and a flat shape.

    Returns
    -------
    noise_m : dict
        "ground" (normal within 26 deg of the vertical) and "walls" (within 17 deg of the horizontal): median
        of the residuals' root mean square, divided by the cosine of incidence [m]; NaN without a plane.
    """
    lasers, _, ranges = recover_beams(points)
    is_used = (ranges > 2.0) & (ranges < 20.0)
    xyz, lasers = np.asarray(points)[is_used, :3].astype(np.float64), lasers[is_used]
    places = rng.permutation(len(xyz))[:count]
    found: dict[str, list[float]] = {"ground": [], "walls": []}
    for i, near in zip(places, cKDTree(xyz).query_ball_point(xyz[places], radius_m), strict=True):
        if len(near) < 12 or len(np.unique(lasers[near])) < 3:
            continue
        _, sizes, axes = np.linalg.svd(xyz[near] - xyz[near].mean(axis=0), full_matrices=False)
        cosine = abs(axes[2] @ xyz[i]) / np.linalg.norm(xyz[i])
        upright = abs(axes[2, 2])
        if sizes[1] > 3.0 * sizes[2] and cosine > 0.1 and not 0.3 <= upright <= 0.9:
            kind = "ground" if upright > 0.9 else "walls"
            found[kind].append(sizes[2] / np.sqrt(len(near) - 3) / cosine)
    return {kind: float(np.median(values)) if values else float("nan") for kind, values in found.items()}


def histograms(sweeps: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Compute the histograms of ranges, heights and intensities of points beyond the own car,
    each of sum one.

    Parameters
    ----------
    sweeps : sequence of array, shape (n, 4)
        Sweeps.

    Returns
    -------
    fractions : dict
        "ranges" [m], "heights" in the radar frame [m], "intensities", in the bins of `EDGES`; points outside
        count in the first or last bin.
    """
    points = np.concatenate(sweeps)
    ranges = recover_beams(points)[2]
    is_far = ranges > NEAR_M
    values = {"ranges": ranges, "heights": _heights(points), "intensities": points[:, 3]}
    counts = {
        name: np.histogram(np.clip(x[is_far], EDGES[name][0], EDGES[name][-1]), EDGES[name])[0]
        for name, x in values.items()
    }
    return {name: n / max(n.sum(), 1) for name, n in counts.items()}


def sweep_statistics(sweeps: Sequence[np.ndarray], rng: np.random.Generator, *, n_noise: int = 6) -> dict:
    """Compute all statistics of several sweeps of the left lidar.

    Parameters
    ----------
    sweeps : sequence of array, shape (n, 4)
        Sweeps, not compensated for motion.
    rng : numpy.random.Generator
        Draws the places at which planes are fitted.
    n_noise : int
        Number of sweeps, evenly chosen, of which the noise is measured.

    Returns
    -------
    statistics : dict
        "sweeps", "points": array, shape (n_sweeps,); "laser_counts": array, shape (32,), mean points of each
        laser; "step_deg"; "first_angles_deg": array, shape (n_sweeps,); "return_fractions": array, shape
        (32, 72); "no_return": fraction of all beams without a point beyond the car; "blocked": fraction of
        the cells of laser and angle in which less than 2 % of the beams return; "steep_returns": fraction of
        beams of the five steepest lasers that return beside the car; "near": fraction of points within 1.9 m;
        "ground": fraction of the other points that are ground; "range_noise_m", "ground_noise_m",
        "wall_noise_m" [m]; "reach_m": range below which 99.9 % of the points lie; "histograms" and their
        "edges".

    Raises
    ------
    ValueError
        If there is no sweep, or a sweep is empty or none of the HDL-32E's.
    """
    if not len(sweeps) or min(map(len, sweeps)) == 0:
        raise ValueError("sweeps: none, or an empty one among them")
    beams = [recover_beams(points) for points in sweeps]
    lasers, _, ranges = (np.concatenate(parts) for parts in zip(*beams, strict=True))
    points, is_far, fractions = np.concatenate(sweeps), ranges > NEAR_M, return_fractions(sweeps)
    is_ground = _heights(points) < GROUND_M
    beside = slice(*(round(angle * AZIMUTH_CELLS / 360.0) for angle in CLEAR_DEG))
    return {
        "sweeps": len(sweeps),
        "points": np.array([len(sweep) for sweep in sweeps]),
        "laser_counts": np.bincount(lasers, minlength=len(ELEVATIONS_DOWN)) / len(sweeps),
        "step_deg": float(np.mean([angle_step(angles) for _, angles, _ in beams])),
        "first_angles_deg": np.array([first_angle(laser, angles) for laser, angles, _ in beams]),
        "return_fractions": fractions,
        "no_return": float(1.0 - fractions.mean()),
        "blocked": float((fractions < 0.02).mean()),
        "steep_returns": float(return_fractions(sweeps, 0.0)[STEEP_LASERS, beside].mean()),
        "near": float(1.0 - is_far.mean()),
        "ground": float(is_ground[is_far].mean()),
        **_mean_noise([sweeps[i] for i in _choose_evenly(np.arange(len(sweeps)), n_noise)], rng),
        "reach_m": float(np.percentile(ranges, 99.9)),
        "histograms": histograms(sweeps),
        "edges": EDGES,
    }


def _mean_noise(sweeps: Sequence[np.ndarray], rng: np.random.Generator) -> dict[str, float]:
    """Mean noise of several sweeps [m]: of a range, and to planes on the ground and on walls."""
    rows = [{"range": range_noise(sweep), **plane_noise(sweep, rng)} for sweep in sweeps]
    names = {"range": "range_noise_m", "ground": "ground_noise_m", "walls": "wall_noise_m"}
    values = {name: [row[kind] for row in rows if np.isfinite(row[kind])] for kind, name in names.items()}
    return {name: float(np.mean(found)) if found else float("nan") for name, found in values.items()}


def compare_sweeps(
    real: Sequence[np.ndarray], others: Mapping[str, Sequence[np.ndarray]], rng: np.random.Generator
) -> dict[str, dict]:
    """Compute the statistics of real sweeps, of both their halves in time, and of other sets of sweeps.

    Parameters
    ----------
    real : sequence of array, shape (n, 4)
        Real sweeps in order of time; may be empty.
    others : mapping
        Name of a set -> its sweeps; empty sets are left out.
    rng : numpy.random.Generator
        Draws the places at which planes are fitted.

    Returns
    -------
    statistics : dict
        Name -> result of `sweep_statistics` with two more keys. "is_part": True for the halves. "distances":
        Hellinger distances of the histograms, by name: of a half to the other half, of another set to the
        real sweeps; NaN without a reference.
    """
    middle = (len(real) + 1) // 2
    halves = dict(zip(HALVES, (real[:middle], real[-middle:]), strict=True)) if len(real) > 1 else {}
    sets = (
        ({REAL: real} if len(real) else {})
        | halves
        | {name: sweeps for name, sweeps in others.items() if sweeps}
    )
    found = {name: sweep_statistics(sweeps, rng) for name, sweeps in sets.items()}
    references = dict.fromkeys(found, REAL) | dict(zip(HALVES, reversed(HALVES), strict=True)) | {REAL: ""}
    for name, statistics in found.items():
        statistics["is_part"] = name in halves
        statistics["distances"] = _histogram_distances(statistics, found.get(references[name]))
    return found


def _histogram_distances(statistics: dict, reference: dict | None) -> dict[str, float]:
    """Compute the Hellinger distances of the histograms, NaN without a reference."""
    if reference is None:
        return dict.fromkeys(EDGES, float("nan"))
    pairs = {name: (statistics["histograms"][name], reference["histograms"][name]) for name in EDGES}
    return {name: hellinger_distance(*pair) for name, pair in pairs.items()}


def summarize_sweeps(statistics: dict) -> dict[str, float]:
    """Select the statistics of sweeps that are one number each, for a table.

    Parameters
    ----------
    statistics : dict
        One set of `compare_sweeps`.

    Returns
    -------
    rows : dict
        What it is -> number.
    """
    return {
        "sweeps": statistics["sweeps"],
        "points per sweep, median": np.median(statistics["points"]),
        "angle between firings [deg]": statistics["step_deg"],
        "beams without a return [%]": 100.0 * statistics["no_return"],
        "directions that never return [%]": 100.0 * statistics["blocked"],
        "beams beside the vehicle that return [%]": 100.0 * statistics["steep_returns"],
        "noise of a range [mm]": 1e3 * statistics["range_noise_m"],
        "residual to planes, ground [mm]": 1e3 * statistics["ground_noise_m"],
        "residual to planes, walls [mm]": 1e3 * statistics["wall_noise_m"],
        f"points within {NEAR_M} m [%]": 100.0 * statistics["near"],
        "ground, of the other points [%]": 100.0 * statistics["ground"],
        "range not exceeded by 99.9 % [m]": statistics["reach_m"],
        **{f"Hellinger distance of {name}": distance for name, distance in statistics["distances"].items()},
    }


def _choose_evenly(items: np.ndarray, count: int) -> np.ndarray:
    """Choose at most so many items, evenly spaced from the first to the last."""
    return items[np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).astype(int))]


def _view_from_lasers(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, ranges [m] and elevations (down) [rad] of points as seen from the lasers' centre."""
    xyz = np.asarray(points)[:, :3].astype(np.float64) - [0.0, 0.0, FIRE_HEIGHT]
    ranges = np.linalg.norm(xyz, axis=1)
    return xyz, ranges, np.arcsin(-xyz[:, 2] / np.maximum(ranges, 1e-9))


def _nearest_lasers(elevations: np.ndarray) -> np.ndarray:
    """Number of the laser nearest to each elevation."""
    after = np.clip(np.searchsorted(ELEVATIONS_DOWN, elevations), 1, len(ELEVATIONS_DOWN) - 1)
    return after - (elevations - ELEVATIONS_DOWN[after - 1] < ELEVATIONS_DOWN[after] - elevations)


def _elevation_error(points: np.ndarray) -> float:
    """Greatest difference between a point's elevation and that of the nearest laser [deg]."""
    elevations = _view_from_lasers(points)[2]
    return float(
        np.rad2deg(np.abs(elevations - ELEVATIONS_DOWN[_nearest_lasers(elevations)]).max(initial=0.0))
    )


def _heights(points: np.ndarray) -> np.ndarray:
    """Heights of points of the left lidar in the radar frame [m]."""
    return sweep_to_radar(points, relate_sensors(EXTRINSICS["radar"], EXTRINSICS[SENSOR]))[:, 2]
