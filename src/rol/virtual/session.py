"""A virtual session before it is a folder: the town as it finds it, drive, traffic, times, scans, sweeps.

Every scan and sweep has a generator of its own, so each can be made alone and in any order; `writer` puts
them on disk.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ..oxford import RadarScan
    from .drive import Drive
    from .lidar_sensor import LidarSettings, Sweep
    from .radar_sensor import RadarSettings
    from .scene import Scene
    from .settings import VirtualSettings
    from .traffic import Traffic
    from .world import Town

LIDARS = ("velodyne_left", "velodyne_right")
FIRST_COUNT, COUNT_STEP = 13, 14  # encoder counts of the radar's rows: 13, 27, ... 5599 of 5600
# Parts of a session that draw from generators of their own.
DRESS, DRIVE, TRAFFIC, SCANS, SWEEPS, ODOMETRY, GPS, INS, SCAN, SWEEP = range(10)


@dataclass(frozen=True)
class VirtualSession:
    """A session before it is written: the town as it finds it, its drive, its traffic and its times.

    Attributes
    ----------
    settings : VirtualSettings
        The settings of all sessions.
    name : str
        The session.
    town : Town
        The town.
    scene : Scene
        The town as this session finds it, without what moves.
    drive : Drive
        Where the radar is at any time.
    traffic : Traffic
        Who else is on the move.
    scans_us, turns_us : array, shape (n,), int64
        Begin and duration of every radar turn [us].
    sweeps_us : dict of str to array, shape (m,), int64
        Begin of every turn of each lidar [us].
    chosen : dict of str to array, shape (k,)
        Which of these turns are written.
    """

    settings: VirtualSettings
    name: str
    town: Town
    scene: Scene
    drive: Drive
    traffic: Traffic
    scans_us: np.ndarray
    turns_us: np.ndarray
    sweeps_us: dict[str, np.ndarray]
    chosen: dict[str, np.ndarray]

    @property
    def first_mover(self) -> int:
        """Object number of the first moving body."""
        return int(self.scene.static_mesh.objects.max()) + 1

    def generator(self, part: int, index: int = 0) -> np.random.Generator:
        """Give the generator of one part of the session, such as one scan."""
        return np.random.default_rng(
            [self.settings.seed, self.settings.sessions[self.name].seed, part, index]
        )

    def scene_at(self, stamp_us: float, radius: float = 170.0) -> Scene:
        """Give the town with everything that moves within a radius [m] where it is at one time [us]."""
        middle = self.drive.pose(np.array([stamp_us]))[0]
        return self.scene.with_moving(
            self.traffic.meshes_at(self.town.plan, stamp_us, self.first_mover, middle, radius)
        )


def build_session(settings: VirtualSettings, name: str) -> VirtualSession:
    """Build the town as one session finds it, and plan its drive.

    Parameters
    ----------
    settings : VirtualSettings
        The settings.
    name : str
        The session.

    Returns
    -------
    session : VirtualSession
        Ready for `make_scan` and `make_sweep`.

    Raises
    ------
    SettingsError
        If there is no such session.
    """
    from . import logs
    from .drive import build_route, plan_drive
    from .mesh import merge_meshes
    from .scene import Scene
    from .settings import describe
    from .traffic import plan_traffic
    from .world import dress

    describe(settings, name)  # a clear error if there is no such session
    own = settings.sessions[name]

    def rng(part: int, index: int = 0) -> np.random.Generator:
        return np.random.default_rng([settings.seed, own.seed, part, index])

    town = _build_town(settings.seed, settings.loop_m, settings.relief_m)
    standing = dress(
        town,
        rng(DRESS),
        parked_share=own.parked_share,
        leaf_density=own.leaf_density,
        changed_share=own.changed_share,
    )
    route = build_route(town.plan)
    scans, turns = logs.schedule_scans(own.first_stamp_us, own.scans, rng(SCANS))
    duration_s = float(scans[-1] + turns[-1] - scans[0]) * 1e-6
    drive = plan_drive(
        route, int(scans[0]), duration_s, rng(DRIVE),
        start_m=settings.start_m, cruise_mps=own.cruise_mps, n_stops=own.stops, stand_s=own.stand_s,
    )  # fmt: skip
    traffic = plan_traffic(
        town.plan, route, drive, rng(TRAFFIC), n_vehicles=own.vehicles, n_people=own.people
    )
    span = int(scans[0]) - 100_000, int(scans[-1] + turns[-1]) + 100_000
    sweeps = {sensor: logs.schedule_sweeps(*span, rng(SWEEPS, k)) for k, sensor in enumerate(LIDARS)}
    chosen = {
        sensor: logs.choose_sweeps(us, scans, turns) if settings.sweeps == "nearest" else np.arange(len(us))
        for sensor, us in sweeps.items()
    }
    scene = Scene(merge_meshes([town.mesh, standing]))
    return VirtualSession(settings, name, town, scene, drive, traffic, scans, turns, sweeps, chosen)


@lru_cache(maxsize=1)
def _build_town(seed: int, loop_m: float, relief_m: float) -> Town:
    from .world import build_town

    return build_town(np.random.default_rng([seed, 0, 99]), loop_length=loop_m, relief=relief_m)


def make_scan(session: VirtualSession, index: int) -> RadarScan:
    """Make one radar scan.

    Parameters
    ----------
    session : VirtualSession
        The session.
    index : int
        Which scan.

    Returns
    -------
    scan : oxford.RadarScan
        As `oxford.save_radar` takes it.
    """
    from ..oxford import RadarScan
    from . import logs
    from .radar_sensor import simulate_scan

    stamp, turn, rng = (
        int(session.scans_us[index]),
        int(session.turns_us[index]),
        session.generator(SCAN, index),
    )
    _, settings = sensor_settings(session.settings)
    times = logs.scan_row_times(stamp, turn)
    middle = stamp + 0.5 * turn
    moves = {
        session.first_mover + i: tuple(v)
        for i, v in enumerate(session.traffic.velocities_at(middle).tolist())
    }
    codes = simulate_scan(
        session.scene_at(middle),
        session.drive.pose(times),
        session.drive.velocity(times),
        rng,
        settings,
        moves,
    )
    counters = (FIRST_COUNT + COUNT_STEP * np.arange(logs.N_ROWS)).astype(np.uint16)
    return RadarScan(
        logs.draw_row_stamps(stamp, turn, rng), counters, np.full(logs.N_ROWS, 255, np.uint8), codes
    )


def make_sweep(session: VirtualSession, sensor: str, index: int) -> Sweep:
    """Make one lidar sweep.

    Parameters
    ----------
    session : VirtualSession
        The session.
    sensor : str
        "velodyne_left" or "velodyne_right".
    index : int
        Which of the lidar's turns (a place in `sweeps_us`).

    Returns
    -------
    sweep : Sweep
        The raw file's content, and the true materials.
    """
    from ..oxford import EXTRINSICS
    from .lidar_sensor import schedule_firings, simulate_sweep

    rng = session.generator(SWEEP + LIDARS.index(sensor), index)
    stamps, angles = schedule_firings(
        int(session.sweeps_us[sensor][index]), rng, first_angle=float(rng.uniform(0.0, 0.006))
    )
    poses = session.drive.pose(stamps)
    height = session.settings.radar_height_m + session.town.plan.ground(poses[:1, :2])[0]
    T_radar_lidar = np.linalg.inv(EXTRINSICS["radar"]) @ EXTRINSICS[sensor]
    settings, _ = sensor_settings(session.settings)
    scene = session.scene_at(float(stamps[len(stamps) // 2]), settings.max_range_m + 10.0)
    return simulate_sweep(scene, stamps, angles, T_radar_lidar, poses, float(height), rng, settings)


def label_sweep(folder: Path | str, sensor: str, stamp_us: int) -> tuple[np.ndarray, np.ndarray]:
    """Give the points of a sweep and what each one hit, for the sweeps whose truth was written.

    Parameters
    ----------
    folder : path
        Folder of a virtual session.
    sensor : str
        "velodyne_left" or "velodyne_right".
    stamp_us : int
        The sweep's name [us].

    Returns
    -------
    points : array, shape (n, 4), float32
        As `oxford.velodyne_raw_to_points` gives them: x, y, z [m] in the lidar frame, intensity.
    materials : array, shape (n,), uint8
        `Material` of every point.

    Raises
    ------
    ValueError
        If the sweep has no labels or they do not fit; the message names the file.
    """
    import cv2

    from ..oxford import RANGE_UNIT, load_velodyne_raw, velodyne_raw_to_points

    path = Path(folder) / "labels" / sensor / f"{stamp_us}.png"
    labels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.exists() else None
    if labels is None:
        raise ValueError(
            f"{path}: missing or not an image; labels are there for some sweeps only, see list_labels"
        )
    raw = load_velodyne_raw(Path(folder) / sensor / f"{stamp_us}.png")
    if labels.shape != raw.ranges.shape:
        raise ValueError(f"{path}: shape {labels.shape} for a sweep of {raw.ranges.shape}")
    points, _ = velodyne_raw_to_points(raw)
    return points, labels.T[raw.ranges.T * RANGE_UNIT > 1.0]


def list_labels(folder: Path | str, sensor: str) -> np.ndarray:
    """List the sweeps of a virtual session whose true materials were written, shape (n,), int64 [us]."""
    return np.array(
        sorted(int(path.stem) for path in (Path(folder) / "labels" / sensor).glob("*.png")), dtype=np.int64
    )


def sensor_settings(settings: VirtualSettings) -> tuple[LidarSettings, RadarSettings]:
    """Give the settings of both sensors, the usual ones where nothing else is asked for.

    Parameters
    ----------
    settings : VirtualSettings
        The settings of all sessions.

    Returns
    -------
    lidar : LidarSettings
        Of both lidars.
    radar : RadarSettings
        Of the radar, its height included.

    Raises
    ------
    SettingsError
        If a sensor has no such setting.
    """
    from .lidar_sensor import LidarSettings
    from .radar_sensor import RadarSettings

    radar = {"height": settings.radar_height_m, **settings.radar}
    return _fill(LidarSettings, settings.lidar, "lidar"), _fill(RadarSettings, radar, "radar")


def _fill(kind: type, values: dict[str, Any], name: str) -> Any:
    from .settings import SettingsError

    known = [f.name for f in fields(kind)]
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise SettingsError(f"virtual: {name}: unknown key {unknown[0]!r}; known are: {', '.join(known)}")
    return kind(**{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()})
