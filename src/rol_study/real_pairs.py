"""Compare real radar scans with the lidar sweeps of the same moment: alignment, ground, similarity.

Everything is in the radar frame, x forward, y left [m], and refers to a scan and its sweeps as
`rol_data.oxford_pairs.find_pairs` finds them. "Compensated" means that radar and lidar are brought to
mid-scan by the velocity of the official odometry and that the radar's Doppler shift is removed; "none" leaves
both as recorded.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter, minimum_filter1d, uniform_filter1d
from scipy.spatial import cKDTree

from rol.bev import image_to_points, points_to_image
from rol.geometry import relative_pose, transform_points
from rol.lidar import crop_range, remove_ground
from rol.oxford import (
    RadarScan,
    compose_odometry,
    load_radar,
    load_radar_odometry,
)
from rol.pairs import PairSettings, radar_to_image
from rol.radar import MEASURED, SCAN_SECONDS, RangeCalibration, deskew_points
from rol.similarity import fraction_within, nn_distances
from rol_beyond.front_ends import DETECTORS, detect_points, evaluate_on_map, generate_points
from rol_data.oxford_pairs import PairedScan, RealPairs, Sweep, load_sweep_points
from rol_study.misalignment import measure_misalignment

if TYPE_CHECKING:
    from rol.pix2pix import TrainedNetwork

MOTIONS = ("none", "compensated")
REFERENCES = ("nearest", "turn")  # sweeps that the lidar points come from
AS_IN_PAPER, BEST = ("none", "nearest"), ("compensated", "turn")  # motion and reference of the main results
Pairs = Mapping[tuple[str, str], "Pair"]  # of one scan: (motion, sweeps) -> pair
COLUMNS = ["timestamp_us", "front_end", "motion", "sweeps", "n_points", "n_lidar_points", "precision_1m"]
COLUMNS += ["precision_2m", "recall_1m", "recall_2m", "misalignment_forward_m", "misalignment_left_m"]
PIXEL_M = 0.25
ROAD_M = 4.0  # half the width of the corridor along the path that counts as road [m]
POINTS, OFF = "points, by m from path", "over 2 m off"  # columns of `tabulate_kinds`
OWN_VEHICLE_M = 4.0  # nearer lidar points may be on the vehicle itself [m]


# ---- one scan and its sweeps ----


@dataclass(frozen=True, eq=False)
class Pair:
    """A scan with its sweeps, motion-compensated or as recorded.

    Attributes
    ----------
    scan : PairedScan
        The scan's file.
    radar : RadarScan
        Its content.
    motion, sweeps : str
        One of `MOTIONS` and of `REFERENCES`.
    cloud : array, shape (n, 4)
        x, y, z [m], intensity of the sweeps, ground included.
    min_height, max_range : float
        Lowest height and largest range of the lidar points that are compared [m].
    """

    scan: PairedScan
    radar: RadarScan
    motion: str
    sweeps: str
    cloud: np.ndarray
    min_height: float = -1.5
    max_range: float = 64.0

    @property
    def twist(self) -> tuple[float, float, float] | None:
        """Velocity to compensate; None with motion "none"."""
        return self.scan.twist if self.motion == "compensated" else None

    @cached_property
    def objects(self) -> np.ndarray:
        """Points of the cloud without ground and within range, shape (n, 4)."""
        return crop_range(remove_ground(self.cloud, self.min_height), self.max_range)

    @cached_property
    def lidar_image(self) -> np.ndarray:
        """Occupancy image of the objects, shape (512, 512), uint8."""
        return points_to_image(self.objects, max_range=self.max_range)

    @cached_property
    def lidar_points(self) -> np.ndarray:
        """Centres of the occupied pixels, shape (m, 2) [m]."""
        return image_to_points(self.lidar_image, max_range=self.max_range)

    @cached_property
    def tops(self) -> np.ndarray:
        """Height above the ground of the highest point in the pixel of each of the lidar points,
        shape (m,) [m]."""
        height, forward, left = np.nan_to_num(fit_ground(self.cloud))
        around = np.clip(self.objects[:, :2], -15.0, 15.0)  # farther away the slope is not known
        ground = (height or -2.0) + around @ (forward, left)
        _, pixel = cKDTree(self.lidar_points).query(self.objects[:, :2])
        tops = np.full(len(self.lidar_points), -np.inf)
        np.maximum.at(tops, pixel, self.objects[:, 2] - ground)
        return tops

    @cached_property
    def radar_image(self) -> np.ndarray:
        """Radar image, shape (512, 512), uint8."""
        return self.image_with(MEASURED)

    def image_with(self, calibration: RangeCalibration) -> np.ndarray:
        """Compute the radar image with another calibration of range, shape (512, 512), uint8."""
        motion = "none" if self.twist is None else "corrected"
        ranges = {"range_resolution": calibration.resolution_m, "range_offset": calibration.offset_m}
        settings = PairSettings(motion, **ranges)
        return radar_to_image(self.radar.power, self.radar.azimuths, self.twist, settings)

    @cached_property
    def sharpened(self) -> np.ndarray:
        """Power of the scan less its mean over 8 m of range, smoothed by about the radar's own point spread;
        rows repeated at both ends, shape (a + 2, b), float32."""
        values = self.radar.power.astype(np.float32)
        values -= uniform_filter1d(values, 183, axis=1)
        values = gaussian_filter(values, (0.7, 3.0), mode=("wrap", "nearest"))
        return np.concatenate([values[-1:], values, values[:1]])

    @cached_property
    def misalignment(self) -> tuple[float, float]:
        """Shift of the radar image against the lidar image, forward and left [m]; nan if not measurable."""
        rows, columns = measure_misalignment(self.radar_image, self.lidar_image, max_shift_px=16)
        return -PIXEL_M * rows, -PIXEL_M * columns


def load_scan_pairs(
    found: RealPairs, scan: PairedScan, min_height: float = -1.5, max_range: float = 64.0
) -> dict[tuple[str, str], Pair]:
    """Load a scan with its sweeps, in each form that is compared.

    Parameters
    ----------
    found : RealPairs
        What was found.
    scan : PairedScan
        One of its scans.
    min_height, max_range : float
        Lowest height and largest range of the lidar points that are compared [m].

    Returns
    -------
    pairs : dict
        (motion, sweeps) -> `Pair`. Motion "compensated" is left out where the velocity is unknown. Sweeps
        "nearest" are of each lidar the sweep nearest to the scan's stamp (the paper's rule), with
        compensation the one nearest to mid-scan; left out if none is within 50 ms. Sweeps "turn" are all with
        a stamp inside the scan's turn.

    Raises
    ------
    rol.oxford.OxfordError
        If a file is damaged; the message names file and fault.
    """
    radar, pairs = load_radar(scan.path), {}
    for motion in MOTIONS if scan.twist is not None else MOTIONS[:1]:
        twist = scan.twist if motion == "compensated" else None
        nearest = found.nearest(scan.stamp_us if twist is None else scan.mid_us)
        for sweeps, chosen in zip(REFERENCES, (nearest, found.turn(scan)), strict=True):
            if chosen:
                cloud = np.concatenate([load_cloud(sweep, scan, twist) for sweep in chosen])
                pairs[motion, sweeps] = Pair(scan, radar, motion, sweeps, cloud, min_height, max_range)
    return pairs


def load_cloud(sweep: Sweep, scan: PairedScan, twist: Sequence[float] | None = None) -> np.ndarray:
    """Load a sweep into the radar frame; with a velocity, each point is moved from its own time to mid-scan.

    Parameters
    ----------
    sweep, scan : Sweep, PairedScan
        The files.
    twist : sequence of float, optional
        Body velocity [m/s, m/s, rad/s]; without it the points stay as recorded.

    Returns
    -------
    points : array, shape (n, 4)
        x, y, z [m] and intensity.
    """
    points, seconds = load_sweep_points(sweep)
    if twist is not None:
        seconds = seconds + (sweep.stamp_us - scan.mid_us) / 1e6
        points[:, :3] = deskew_points(points[:, :3], seconds, twist)
    return points


def load_path(scan: PairedScan) -> np.ndarray | None:
    """Load the path of the odometry that a scan belongs to, shape (m, 3) [m, m, rad];
    None without odometry."""
    if scan.odometry_path is None:
        return None
    return compose_odometry(load_radar_odometry(scan.odometry_path))[2]


def describe_scans(found: RealPairs) -> dict[str, float]:
    """Count what was found: ``n_scans``, ``n_sweeps``, ``seconds``, ``distance`` [m], ``speed_min``,
    ``speed_max`` [m/s]; NaN where there is no scan or no velocity."""
    stamps = pd.Series([scan.stamp_us for scan in found.scans], dtype=float) / 1e6
    speeds = pd.Series([scan.twist[0] if scan.twist else np.nan for scan in found.scans], dtype=float)
    return {
        "n_scans": len(found.scans),
        "n_sweeps": len(found.sweeps),
        "seconds": stamps.max() - stamps.min() + SCAN_SECONDS,
        "distance": (speeds * -stamps.diff(-1)).sum(),
        "speed_min": speeds.min(),
        "speed_max": speeds.max(),
    }


def tabulate_misalignment(scans: Iterable[Pairs]) -> pd.DataFrame:
    """Measure the shift of radar images against lidar images.

    Parameters
    ----------
    scans : iterable of mapping
        Of each scan: what `load_scan_pairs` returns.

    Returns
    -------
    table : pandas.DataFrame
        One row per pair: ``motion``, ``sweeps``, ``speed_mps`` (NaN if unknown), ``forward_m``, ``left_m``.
    """
    rows = []
    for pairs in scans:
        for (motion, sweeps), pair in pairs.items():
            speed = np.nan if pair.scan.twist is None else pair.scan.twist[0]
            rows.append((motion, sweeps, speed, *pair.misalignment))
    return pd.DataFrame(rows, columns=["motion", "sweeps", "speed_mps", "forward_m", "left_m"])


def describe_misalignment(table: pd.DataFrame) -> dict[str, float]:
    """Summarize `tabulate_misalignment` for the nearest sweeps.

    Parameters
    ----------
    table : pandas.DataFrame
        The table; it may be empty.

    Returns
    -------
    numbers : dict
        ``lag_none`` (mean distance of the radar behind the lidar as recorded) and ``lag_compensated`` (ahead
        of it when compensated) [m]; NaN without pairs.
    """
    nearest = table[table.sweeps == "nearest"].astype({"forward_m": float})
    means = nearest.groupby("motion").forward_m.mean().reindex(MOTIONS)
    return {"lag_none": -means["none"], "lag_compensated": means["compensated"]}


def compare_points(points: np.ndarray, lidar: np.ndarray) -> dict[str, float | int]:
    """Compute precision and recall of points against lidar points.

    Parameters
    ----------
    points, lidar : array, shape (n, 2), (m, 2)
        Points in one frame [m].

    Returns
    -------
    scores : dict
        ``n_points``, ``n_lidar_points``, ``precision_1m``, ``precision_2m``, ``recall_1m``, ``recall_2m``.
    """
    to_lidar, to_points = nn_distances(points, lidar), nn_distances(lidar, points)
    scores: dict[str, float | int] = {"n_points": len(points), "n_lidar_points": len(lidar)}
    for name, distances in (("precision", to_lidar), ("recall", to_points)):
        scores |= {f"{name}_{r}m": fraction_within(distances, float(r)) for r in (1, 2)}
    return scores


def chance_level(points: np.ndarray, lidar: np.ndarray, n_turns: int = 8) -> float:
    """Compute the precision at 1 m of points that are turned to wrong headings.

    Parameters
    ----------
    points, lidar : array, shape (n, 2), (m, 2)
        Points in one frame [m].
    n_turns : int
        The circle is divided into so many headings; the right one is left out.

    Returns
    -------
    precision : float
        Mean over the wrong headings, 0..1.
    """
    tree, turns = cKDTree(lidar), 2.0 * np.pi * np.arange(1, n_turns) / n_turns
    turned = [transform_points((0.0, 0.0, turn), points) for turn in turns]
    return float(np.mean([fraction_within(tree.query(cloud)[0], 1.0) for cloud in turned]))


# ---- ground ----


def fit_ground(cloud: np.ndarray, radius_m: float = 25.0, near: float = 0.5) -> tuple[float, float, float]:
    """Fit a plane to the ground around the vehicle.

    Parameters
    ----------
    cloud : array, shape (n, 3) or more columns
        Points in the radar frame [m].
    radius_m : float
        Points farther away are left out [m].
    near : float
        The first plane is level, at the most frequent height below -1 m; points within this distance of a
        plane count for the next one, which then shrinks to 0.15 m [m].

    Returns
    -------
    height, forward, left : float
        Height below the radar [m] and slopes, rise per metre forward and to the left; nan with fewer than 100
        points.
    """
    points = crop_range(cloud, radius_m, 3.0)[:, :3]
    points = points[(points[:, 2] < -1.0) & (points[:, 2] > -3.5)]
    if len(points) < 100:
        return float("nan"), float("nan"), float("nan")
    counts, edges = np.histogram(points[:, 2], np.arange(-3.5, -0.95, 0.1))
    plane = np.array([edges[np.argmax(counts)] + 0.05, 0.0, 0.0])
    columns = np.column_stack([np.ones(len(points)), points[:, :2]])
    for limit in (near, 0.3, 0.15, 0.15):
        kept = np.abs(points[:, 2] - columns @ plane) < limit
        plane, *_ = np.linalg.lstsq(columns[kept], points[kept, 2], rcond=None)
    return tuple(float(value) for value in plane)


@dataclass(frozen=True, eq=False)
class Ground:
    """Ground of real sweeps, see `measure_ground`.

    Attributes
    ----------
    near_m, far_m : array, shape (n,) and (m,)
        Heights of the points within 20 m, and of the others [m].
    levels_m, kept : array, shape (k,)
        Thresholds [m] and fraction of the points above them, mean over pairs.
    numbers : dict
        ``ground`` (height of the radar above the plane) and ``ground_sd`` [m], ``slope`` and ``slope_left``
        [%], ``margin`` of the threshold above the plane [m], ``max_slope`` that uses it up over 30 m [%], and
        percentages: ``kept`` of the points, and ``low`` of the occupied pixels without a point 0.3 m above
        the plane. NaN without pairs.
    """

    near_m: np.ndarray
    far_m: np.ndarray
    levels_m: np.ndarray
    kept: np.ndarray
    numbers: dict[str, float]


def measure_ground(pairs: Sequence[Pair], min_height: float) -> Ground:
    """Measure the ground of real sweeps and what a threshold on the height keeps.

    Parameters
    ----------
    pairs : sequence of Pair
        The pairs; their clouds hold the ground.
    min_height : float
        Threshold in use [m].

    Returns
    -------
    ground : Ground
    """
    levels = np.arange(-2.4, 0.05, 0.1)
    clouds = [crop_range(pair.cloud, pair.max_range) for pair in pairs]
    columns = ["height", "forward", "left"]
    planes = pd.DataFrame([fit_ground(cloud) for cloud in clouds], columns=columns, dtype=float)
    points = np.concatenate([np.zeros((0, 4)), *clouds])
    is_far = np.hypot(points[:, 0], points[:, 1]) >= 20.0
    above = pd.DataFrame([[(cloud[:, 2] >= level).mean() for level in levels] for cloud in clouds])
    lowest = pd.Series([(pair.tops < 0.3).mean() for pair in pairs], dtype=float)
    height, forward, left = planes.mean()
    margin = min_height - height
    numbers = {
        "ground": -height,
        "ground_sd": planes.height.std(ddof=0),
        "slope": 100 * forward,
        "slope_left": 100 * left,
        "margin": margin,
        "max_slope": 100 * margin / 30.0,
        "kept": 100 * pd.Series(points[:, 2] >= min_height).mean(),
        "low": 100 * lowest.mean(),
    }
    return Ground(points[~is_far, 2], points[is_far, 2], levels, above.mean().to_numpy(), numbers)


# ---- kinds of points ----


def distance_from_path(points: np.ndarray, scan: PairedScan, path: np.ndarray | None) -> np.ndarray:
    """Compute the distance of points from the path of the vehicle.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points in the radar frame of a scan [m].
    scan : PairedScan
        The scan.
    path : array, shape (m, 3), or None
        Poses in the frame of ``scan.pose`` [m, m, rad], continued straight on for 80 m at both ends; without
        it the path is a straight line through the radar.

    Returns
    -------
    distances : array, shape (n,)
        Distances [m].
    """
    own = np.zeros((1, 3))
    if path is not None and scan.pose is not None:
        own = relative_pose(np.broadcast_to(scan.pose, path.shape), path)
    ahead = np.arange(0.25, 80.0, 0.25)
    ends = [
        pose[:2] + sign * ahead[:, None] * (np.cos(pose[2]), np.sin(pose[2]))
        for pose, sign in ((own[0], -1.0), (own[-1], 1.0))
    ]
    return cKDTree(np.vstack([*ends, own[:, :2]])).query(points)[0]


def describe_points(points: np.ndarray, pair: Pair, path: np.ndarray | None = None) -> pd.DataFrame:
    """Describe each point of a front end by what the lidar has around it.

    Parameters
    ----------
    points : array, shape (n, 2)
        Points of the pair's scan [m].
    pair : Pair
        The scan with its sweeps.
    path : array, shape (m, 3), optional
        Path of the vehicle, see `distance_from_path`.

    Returns
    -------
    table : pandas.DataFrame
        One row per point: ``distance_m`` to the nearest lidar point, ``top_m`` (highest lidar point in that
        pixel, above the ground), ``from_path_m``, and ``is_hidden``: more than 1 m farther than the first
        lidar point in its direction, where the lidar cannot confirm or refute it.
    """
    distances, nearest = cKDTree(pair.lidar_points).query(points)
    others = crop_range(pair.lidar_points, min_range=OWN_VEHICLE_M)
    tops = np.append(pair.tops, np.nan)  # the last one for points without any lidar point
    return pd.DataFrame(
        {
            "distance_m": distances,
            "top_m": tops[nearest],
            "from_path_m": distance_from_path(points, pair.scan, path),
            "is_hidden": np.hypot(*points.T) > _first_ranges(points, others) + 1.0,
        }
    )


def _first_ranges(points: np.ndarray, lidar: np.ndarray, n_sectors: int = 360) -> np.ndarray:
    """Find the range of the nearest lidar point within 1.5 sectors of each point's direction;
    infinite without one [m]."""
    sector, own = (
        (np.mod(np.arctan2(p[:, 1], p[:, 0]), 2.0 * np.pi) / (2.0 * np.pi) * n_sectors).astype(int)
        % n_sectors
        for p in (lidar, points)
    )
    first = np.full(n_sectors, np.inf)
    np.minimum.at(first, sector, np.hypot(*lidar.T))
    return minimum_filter1d(first, 3, mode="wrap")[own]


def tabulate_kinds(
    pairs: Sequence[Pair], points: Sequence[Mapping[str, np.ndarray]], path: np.ndarray | None = None
) -> pd.DataFrame:
    """Tabulate where the points of front ends lie, which are right,
    and what the lidar has where they are wrong.

    Parameters
    ----------
    pairs : sequence of Pair
        The pairs.
    points : sequence of mapping
        Of each pair: front end -> points, shape (n, 2) [m].
    path : array, shape (m, 3), optional
        Path of the vehicle, see `distance_from_path`.

    Returns
    -------
    table : pandas.DataFrame
        One row per front end, percentages over all pairs: of ``points`` by distance from the path; of these
        ``within 1 m`` of a lidar point; of the ``lidar points reached`` within 1 m, by the height of the
        highest in the pixel; and of points ``over 2 m off``, all, those in view, see `describe_points`, and
        those within 4 m of the path. Empty without pairs.
    """
    if not pairs:
        return pd.DataFrame()
    found, lidar = [], []
    for pair, clouds in zip(pairs, points, strict=True):
        for name, cloud in clouds.items():
            found.append(describe_points(cloud, pair, path).assign(front_end=name))
            near = nn_distances(pair.lidar_points, cloud) < 1.0
            lidar.append(pd.DataFrame({"front_end": name, "top_m": pair.tops, "near": near}))
    kinds, reach = pd.concat(found), pd.concat(lidar)
    zones, heights = ["0‑4", "4‑10", "over 10"], ["0‑1", "1‑2.5", "over 2.5"]  # no line break at the hyphen
    zone = pd.cut(kinds.from_path_m, [0, ROAD_M, 10, np.inf], labels=zones, include_lowest=True)
    height = pd.cut(reach.top_m, [-np.inf, 1.0, 2.5, np.inf], labels=heights)
    is_off = kinds.distance_m >= 2.0
    off = {"all": is_off, "in view": is_off & ~kinds.is_hidden, "on road": is_off & (zone == zones[0])}
    kinds = kinds.assign(zone=zone, right=kinds.distance_m < 1.0, **off)
    own = kinds.groupby("front_end", sort=False)
    by_zone = kinds.groupby(["front_end", "zone"], sort=False, observed=False)
    by_height = reach.assign(height=height).groupby(["front_end", "height"], sort=False, observed=False)
    parts = {
        POINTS: by_zone.size().unstack().div(own.size(), axis=0),
        "within 1 m, by m from path": by_zone.right.mean().unstack(),
        "lidar points reached, by height [m]": by_height.near.mean().unstack(),
        OFF: own[list(off)].mean(),
    }
    return 100.0 * pd.concat(parts, axis=1)


def describe_kinds(table: pd.DataFrame, network: str) -> dict[str, float]:
    """Name percentages of `tabulate_kinds` for a text; NaN for a network that is not in the table.

    ``on_road`` (within 4 m of the path), ``wrong`` (more than 2 m off), of these ``in_view``, ``hidden`` and
    ``wrong_on_road``, all of a network's points; ``road_of_wrong``, the wrong ones on the road of all wrong.
    """
    if network not in table.index:
        names = ("on_road", "wrong", "in_view", "hidden", "wrong_on_road", "road_of_wrong")
        return dict.fromkeys(names, np.nan)
    wrong, in_view, wrong_on_road = table.loc[network, OFF]
    return {
        "on_road": table.loc[network, POINTS].iloc[0],
        "wrong": wrong,
        "in_view": in_view,
        "hidden": wrong - in_view,
        "wrong_on_road": wrong_on_road,
        "road_of_wrong": 100.0 * wrong_on_road / wrong if wrong else np.nan,
    }


def tabulate_corrected(
    pairs: Sequence[Pair], points: Sequence[Mapping[str, np.ndarray]], rotation_deg: float, beyond_m: float
) -> pd.DataFrame:
    """Compare points as they are, and with a rotation and a range error removed,
    with the lidar points of pairs.

    Parameters
    ----------
    pairs : sequence of Pair
        The pairs.
    points : sequence of mapping
        Of each pair: front end -> points, shape (n, 2) [m].
    rotation_deg : float
        Rotation of the radar against the lidar, counter-clockwise [deg].
    beyond_m : float
        Distance by which the radar shows things too far away [m].

    Returns
    -------
    table : pandas.DataFrame
        One row per front end; of "as is" and "corrected" the percentages within 0.25, 0.5 and 1 m, means over
        pairs. Empty without pairs.
    """
    if not pairs:
        return pd.DataFrame()
    rows = []
    for pair, clouds in zip(pairs, points, strict=True):
        for name, cloud in clouds.items():
            ranges = np.hypot(*cloud.T)
            nearer = cloud * (1.0 - beyond_m / np.maximum(ranges, 1.0))[:, None]
            turned = transform_points((0.0, 0.0, -np.deg2rad(rotation_deg)), nearer)
            for words, some in (("as is", cloud), ("corrected", turned)):
                away = nn_distances(some, pair.lidar_points)
                fractions = {f"{r:g} m": 100.0 * fraction_within(away, r) for r in (0.25, 0.5, 1.0)}
                rows.append({"front_end": name, "points": words} | fractions)
    table = pd.DataFrame(rows).groupby(["front_end", "points"], sort=False).mean().unstack()
    return table.swaplevel(axis=1)[["as is", "corrected"]]


def describe_corrected(table: pd.DataFrame, network: str) -> dict[str, float]:
    """Name percentages of `tabulate_corrected` within 0.25 m for a text: ``fine_as_is`` and
    ``fine_corrected`` of a network; NaN with an empty table."""
    kinds = {"fine_as_is": "as is", "fine_corrected": "corrected"}
    return {
        key: np.nan if table.empty else table.loc[network, (kind, "0.25 m")] for key, kind in kinds.items()
    }


def tabulate_on_map(
    pairs: Sequence[Mapping[tuple[str, str], Pair]],
    points: Sequence[Mapping[str, np.ndarray]],
    poses: Mapping[int, np.ndarray],
    map_tree: cKDTree,
) -> pd.DataFrame:
    """Compute the precision of lidar points and of front ends on a map.

    Parameters
    ----------
    pairs : sequence of mapping
        Of each scan: what `load_scan_pairs` returns.
    points : sequence of mapping
        Of each scan: front end -> motion-compensated points, shape (n, 2) [m].
    poses : mapping
        Stamp of a scan [us] -> its pose on the map; scans without one are left out.
    map_tree : scipy.spatial.cKDTree
        Tree of the map's points [m].

    Returns
    -------
    table : pandas.DataFrame
        Rows "lidar, nearest", "lidar, turn" and the front ends: ``share_1m`` and ``share_2m`` (0..1) and
        ``n`` points, means over scans. Empty without a scan on the map.
    """
    rows = []
    for of_scan, clouds in zip(pairs, points, strict=True):
        own = {sweeps: of_scan[motion, sweeps] for motion, sweeps in of_scan if motion == "compensated"}
        stamps = {pair.scan.stamp_us for pair in own.values()} & set(poses)
        of_lidar = {f"lidar, {sweeps}": pair.lidar_points for sweeps, pair in own.items()}
        for stamp in stamps:
            for name, cloud in {**of_lidar, **clouds}.items():
                rows.append({"points": name, **evaluate_on_map(cloud, poses[stamp], map_tree)})
    table = pd.DataFrame(rows, columns=["points", "share_1m", "share_2m", "n"])
    return table.groupby("points", sort=False).mean()


def describe_ceiling(table: pd.DataFrame) -> dict[str, float]:
    """Summarize the precision on the map beside that near real sweeps.

    Parameters
    ----------
    table : pandas.DataFrame
        Rows as of `tabulate_on_map`: ``share_1m``, and ``sweep_1m``, the precision at 1 m near one sweep as
        recorded (0..1), NaN for the rows of the lidar; it may be empty.

    Returns
    -------
    numbers : dict
        Percentages: ``ceiling_1m`` of the lidar points of the nearest sweep; ``gain_min`` and ``gain_max``,
        by which the fraction near the map exceeds that near one sweep; ``paper_min`` and ``paper_max``, the
        paper's 40 % with these added. NaN without a row.
    """
    gain = 100 * (table.share_1m - table.sweep_1m)
    return {
        "ceiling_1m": 100 * table.share_1m.get("lidar, nearest", np.nan),
        "gain_min": gain.min(),
        "gain_max": gain.max(),
        "paper_min": 40 + gain.min(),
        "paper_max": 40 + gain.max(),
    }


# ---- front ends ----


def front_end_points(
    pair: Pair, networks: Mapping[str, TrainedNetwork], bf16: bool = False
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Compute the points of every front end from the scan of a pair.

    Parameters
    ----------
    pair : Pair
        The scan; its motion applies.
    networks : mapping
        Name -> network.
    bf16 : bool
        Compute in bfloat16.

    Returns
    -------
    points : dict of array, shape (n, 2)
        "k-strongest", "cfar" and the networks -> points [m].
    images : dict of array, shape (512, 512), uint8
        Network -> generated image.
    """
    scan = pair.radar
    points = {d: detect_points(scan.power, scan.azimuths, pair.twist, detector=d) for d in DETECTORS}
    images = {}
    for name, network in networks.items():
        points[name], _, images[name] = generate_points(
            network, scan.power, scan.azimuths, pair.twist, bf16=bf16
        )
    return points, images


def tabulate(pair: Pair, points: Mapping[str, np.ndarray]) -> list[dict[str, object]]:
    """Compare the points of every front end with the lidar points of a pair.

    Parameters
    ----------
    pair : Pair
        The pair.
    points : mapping
        Front end -> points, shape (n, 2) [m].

    Returns
    -------
    rows : list of dict
        One row per front end with the keys `COLUMNS`.
    """
    forward, left = pair.misalignment
    rows = []
    for name, cloud in points.items():
        row = {
            "timestamp_us": pair.scan.stamp_us,
            "front_end": name,
            "motion": pair.motion,
            "sweeps": pair.sweeps,
        }
        row |= compare_points(cloud, pair.lidar_points)
        rows.append(row | {"misalignment_forward_m": forward, "misalignment_left_m": left})
    return rows


@dataclass(frozen=True, eq=False)
class Comparison:
    """Points of front ends against lidar points, see `compare_front_ends`.

    Attributes
    ----------
    rows : pandas.DataFrame
        One row per scan, motion, reference and front end, with the columns `COLUMNS`.
    chance_1m : float
        Mean of `chance_level` over scans, front ends, `AS_IN_PAPER` and `BEST` (0..1).
    points, images : dict
        (stamp of a scan [us], motion) -> what `front_end_points` returns; of the scans asked for.
    """

    rows: pd.DataFrame
    chance_1m: float
    points: dict[tuple[int, str], dict[str, np.ndarray]]
    images: dict[tuple[int, str], dict[str, np.ndarray]]

    def average(self, way: tuple[str, str]) -> pd.DataFrame:
        """Average the percentages over the scans for a motion and a reference.

        Parameters
        ----------
        way : tuple of str
            One of `MOTIONS` and one of `REFERENCES`.

        Returns
        -------
        table : pandas.DataFrame
            One row per front end: ``precision_1m``, ``precision_2m``, ``recall_1m`` and their standard
            deviations ``<name>_sd`` [%].
        """
        motion, sweeps = way
        rows = self.rows[(self.rows.motion == motion) & (self.rows.sweeps == sweeps)]
        names = ["precision_1m", "precision_2m", "recall_1m"]
        groups = rows.groupby("front_end", sort=False)[names]
        return 100 * groups.mean().join(groups.std().add_suffix("_sd"))


def compare_front_ends(
    scans: Iterable[Pairs],
    networks: Mapping[str, TrainedNetwork],
    kept: Collection[int] = (),
    *,
    bf16: bool = False,
) -> Comparison:
    """Compare the points of every front end with the lidar points of real pairs.

    Parameters
    ----------
    scans : iterable of mapping
        Of each scan: what `load_scan_pairs` returns; read one by one.
    networks : mapping
        Name -> network.
    kept : collection of int
        Stamps of the scans whose points and images are kept [us].
    bf16 : bool
        Compute in bfloat16.

    Returns
    -------
    comparison : Comparison
        Without rows where there is no scan.
    """
    rows, chance, points, images = [], [], {}, {}
    for pairs in scans:
        for motion in MOTIONS:
            if (motion, "turn") not in pairs:
                continue
            stamp = pairs[motion, "turn"].scan.stamp_us
            clouds, drawn = front_end_points(pairs[motion, "turn"], networks, bf16)
            if stamp in kept:
                points[stamp, motion], images[stamp, motion] = clouds, drawn
            own = {way: pair for way, pair in pairs.items() if way[0] == motion}
            rows += [row for pair in own.values() for row in tabulate(pair, clouds)]
            for way in {AS_IN_PAPER, BEST} & set(own):
                chance += [chance_level(cloud, own[way].lidar_points) for cloud in clouds.values()]
    chance_1m = pd.Series(chance, dtype=float).mean()
    return Comparison(pd.DataFrame(rows, columns=COLUMNS), chance_1m, points, images)


def describe_comparison(comparison: Comparison, front_ends: Iterable[str]) -> dict[str, float]:
    """Name the main percentages of a comparison for a text.

    Parameters
    ----------
    comparison : Comparison
        The comparison; it may be empty.
    front_ends : iterable of str
        Front ends.

    Returns
    -------
    numbers : dict
        ``<front end>_1m`` and ``<front end>_2m``, precision as in the paper, and ``<front end>_points`` per
        scan, with "_" for "-"; ``lidar_points`` per sweep; ``chance_1m``, the mean over all front ends;
        ``gain_sweeps`` and ``gain_motion``, the mean gain over the front ends at 1 m by all sweeps of the
        turn, and by compensation alone. NaN without pairs.
    """
    names = {"precision_1m": "1m", "precision_2m": "2m", "n_points": "points", "n_lidar_points": "lidar"}
    rows = comparison.rows.astype(dict.fromkeys(names, float))
    means = rows.groupby(["motion", "sweeps", "front_end"])[list(names)].mean().rename(columns=names)
    means[["1m", "2m"]] *= 100
    own, at_1m = means.reindex([(*AS_IN_PAPER, name) for name in front_ends]), means["1m"]
    numbers = {
        f"{name.replace('-', '_')}_{column}": own.loc[(*AS_IN_PAPER, name), column]
        for *_, name in own.index
        for column in ("1m", "2m", "points")
    }
    level = {
        way: at_1m[[key[:2] == way for key in at_1m.index]].mean() for way in product(MOTIONS, REFERENCES)
    }
    return {
        **numbers,
        "lidar_points": own["lidar"].mean(),
        "chance_1m": 100 * comparison.chance_1m,
        "gain_sweeps": level["none", "turn"] - level[AS_IN_PAPER],
        "gain_motion": level["compensated", "nearest"] - level[AS_IN_PAPER],
    }
