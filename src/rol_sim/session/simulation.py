"""Build simulated sessions in memory: world, trajectory, traffic, times, scans and sweeps.

Every scan and sweep has a generator of its own, so each can be made alone and in any order;
`rol_sim.session.writer` writes them to disk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from rol.maps import thin_points
from rol.oxford import (
    EXTRINSICS,
    LIDARS,
    N_AZIMUTHS,
    RadarScan,
)
from rol_data import rall
from rol_sim.drive.recorded_poses import interpolate_trajectory, park_vehicles, plan_encounters
from rol_sim.drive.town_loop import Trajectory, build_route, plan_trajectory
from rol_sim.drive.traffic import Traffic, plan_traffic
from rol_sim.sensors.lidar import PACKET_RAD, Sweep, hide_behind_car, schedule_firings, simulate_sweep
from rol_sim.sensors.radar import COUNT_STEP, FIRST_COUNT, simulate_scan
from rol_sim.session import logs
from rol_sim.session.settings import (
    SessionSettings,
    SettingsError,
    SimulationSettings,
    describe,
    sensor_settings,
)
from rol_sim.world import mapped
from rol_sim.world.mapped import Cells, classify_cells, draw_unmapped
from rol_sim.world.mesh import Mesh, merge_meshes
from rol_sim.world.scene import Scene
from rol_sim.world.town import Town, add_session_objects, build_town

WORLD_RADIUS_M = 180.0  # how far from the trajectory a world grown from a map reaches
CAR_M = 1.8  # so near to where the car drives stands nothing, whatever the map says
CLEAR_M = 3.0  # what the map does not show stays so far from there
# Parts of a session that draw from generators of their own.
OBJECTS, TRAJECTORY, TRAFFIC, SCANS, SWEEPS, ODOMETRY, GPS, INS, SCAN, SWEEP = range(10)


@dataclass(frozen=True)
class SimulatedSession:
    """A session in memory: its world, trajectory, traffic and times.

    Attributes
    ----------
    settings : SimulationSettings
        The settings of all sessions.
    name : str
        The session.
    town : Town or None
        The town; None where the world is grown from a map.
    ground : callable
        Gives the height of the land at places, shape (n, 2) -> (n,) [m].
    scene : Scene
        The world as this session finds it, without what moves.
    trajectory : Trajectory
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

    settings: SimulationSettings
    name: str
    town: Town | None
    ground: Callable[[np.ndarray], np.ndarray]
    scene: Scene
    trajectory: Trajectory
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
        """Return the random generator of one part of the session, such as one scan."""
        return _generator(self.settings, self.name, part, index)

    def scene_at(self, stamp_us: float, radius: float = 170.0) -> Scene:
        """Return the town with everything that moves within a radius [m] where it is at one time [us]."""
        middle = self.trajectory.pose(np.array([stamp_us]))[0]
        return self.scene.with_moving(
            self.traffic.meshes_at(self.ground, stamp_us, self.first_mover, middle, radius)
        )


def _generator(settings: SimulationSettings, name: str, part: int, index: int = 0) -> np.random.Generator:
    return np.random.default_rng([settings.seed, settings.sessions[name].seed, part, index])


def build_session(settings: SimulationSettings, name: str) -> SimulatedSession:
    """Build the town as one session finds it, and plan its trajectory.

    Parameters
    ----------
    settings : SimulationSettings
        The settings.
    name : str
        The session.

    Returns
    -------
    session : SimulatedSession
        Ready for `make_scan` and `make_sweep`.

    Raises
    ------
    SettingsError
        If there is no such session.
    """
    describe(settings, name)  # a clear error if there is no such session
    own, rng = settings.sessions[name], partial(_generator, settings, name)
    given = _load_route(settings, own) if settings.world == "route" else None
    n_scans = own.scans if given is None else len(given)
    scans, turns = logs.schedule_scans(own.first_stamp_us, n_scans, rng(SCANS))
    if given is None:
        town, ground, mesh, trajectory, traffic = _find_town(settings, own, scans, turns, rng)
    else:
        town, ground = None, _flat
        mesh, trajectory, traffic = _find_route(settings, own, given, scans + turns // 2, rng)
    span = int(scans[0]) - 100_000, int(scans[-1] + turns[-1]) + 100_000
    sweeps = {sensor: logs.schedule_sweeps(*span, rng(SWEEPS, k)) for k, sensor in enumerate(LIDARS)}
    kind = own.sweeps or settings.sweeps
    chosen = {sensor: logs.choose_sweeps(us, scans, turns, kind) for sensor, us in sweeps.items()}
    return SimulatedSession(
        settings, name, town, ground, Scene(mesh), trajectory, traffic, scans, turns, sweeps, chosen
    )


def _load_route(settings: SimulationSettings, own: SessionSettings) -> np.ndarray:
    """Read the real poses that a session of the route is driven along.

    Parameters
    ----------
    settings : SimulationSettings
        Where the real data lie.
    own : SessionSettings
        The number of the pose file, the first scan and how many.

    Returns
    -------
    poses : array, shape (n, 3)
        Poses at mid-scan in the frame of the map.

    Raises
    ------
    SettingsError
        If the real data are not there, or the file holds too few poses.
    """
    root = rall.find_real_root(settings.real_root)
    if root is None:
        raise SettingsError(
            f"simulated: world: route: no real data in {settings.real_root or 'ROL_REAL_ROOT or data/real'}; "
            "run `make real` or set ROL_REAL_ROOT"
        )
    path = root / rall.POSES_PATH / f"pose_xy_{own.poses}.txt"
    poses = rall.load_poses(path)[own.first_scan :]
    if len(poses) < max(own.scans, 3):
        raise SettingsError(
            f"{path}: {len(poses)} poses from scan {own.first_scan} on, {max(own.scans, 3)} are asked for"
        )
    return poses[: own.scans or None]


def _find_town(
    settings: SimulationSettings, own: SessionSettings, scans: np.ndarray, turns: np.ndarray, rng: Callable
) -> tuple[Town, Callable[[np.ndarray], np.ndarray], Mesh, Trajectory, Traffic]:
    """The town as one session finds it, and who is on the move."""
    town = _build_town(settings.seed, settings.loop_m, settings.relief_m)
    standing = add_session_objects(
        town,
        rng(OBJECTS),
        parked_share=own.parked_share,
        leaf_density=own.leaf_density,
        changed_share=own.changed_share,
    )
    route = build_route(town.plan)
    duration_s = float(scans[-1] + turns[-1] - scans[0]) * 1e-6
    trajectory = plan_trajectory(
        route,
        int(scans[0]),
        duration_s,
        rng(TRAJECTORY),
        start_m=settings.start_m,
        cruise_mps=own.cruise_mps,
        n_stops=own.stops,
        stand_s=own.stand_s,
    )
    traffic = plan_traffic(
        town.plan, route, trajectory, rng(TRAFFIC), n_vehicles=own.vehicles, n_people=own.people
    )
    return town, town.plan.ground, merge_meshes([town.mesh, standing]), trajectory, traffic


def _find_route(
    settings: SimulationSettings,
    own: SessionSettings,
    poses: np.ndarray,
    middles_us: np.ndarray,
    rng: Callable,
) -> tuple[Mesh, Trajectory, Traffic]:
    """The world of the map as one session finds it, and who is on the move."""
    places = thin_points(poses[:, :2], 2.0)[0]
    path = str(rall.find_real_root(settings.real_root) / rall.MAP_PATH)
    whole, unmapped = _read_map(path, settings.seed, settings.unmapped_share)
    cells = mapped.crop_cells(whole, places, WORLD_RADIUS_M)
    lane = thin_points(poses[:, :2], 0.5)[0]
    later = mapped.change_cells(cells, rng(OBJECTS), missing_fraction=own.changed_share)
    left = mapped.join_cells(
        mapped.crop_cells(later, lane, WORLD_RADIUS_M, clear_m=CAR_M),  # the map keeps traces of traffic
        mapped.crop_cells(unmapped, lane, WORLD_RADIUS_M, clear_m=CLEAR_M),
    )
    trajectory = interpolate_trajectory(middles_us, poses)
    things = [
        mapped.build_ground(places, WORLD_RADIUS_M),
        mapped.build_pieces(left, settings.seed, leaf_density=own.leaf_density),
    ]
    parked = park_vehicles(
        trajectory,
        cells.points,
        rng(TRAJECTORY),
        parked_share=own.parked_share,
        first_object=int(left.groups.max(initial=0)) + 1,
    )
    traffic = plan_encounters(
        trajectory, rng(TRAFFIC), vehicles_per_min=own.vehicles, people_per_min=own.people
    )
    return merge_meshes([*things, parked]), trajectory, traffic


def build_counterparts(real_root: Path | str, seed: int = 1, margin_s: float = 30.0) -> SimulatedSession:
    """Prepare simulated counterparts of the real scans whose poses on the real map are known.

    The world is that of the route; the car drives through the poses of the scans, before and after them it
    goes on as it went.

    Parameters
    ----------
    real_root : path
        Folder of the real data.
    seed : int
        Draws what the map does not hold: heights, changes since, vehicles, noise.
    margin_s : float
        For how long the car drives before the first and after the last scan [s].

    Returns
    -------
    session : SimulatedSession
        Ready for `make_scan`; the stamps are those of the real scans. It has no sweeps.

    Raises
    ------
    rall.RallError
        If a file of the real data is missing or at fault.
    """
    known = rall.load_scan_poses(rall.find_scan_poses(real_root))
    stamps, poses = np.array(list(known), dtype=np.int64), np.array(list(known.values()))
    turns = np.full(len(stamps), 250_000, dtype=np.int64)
    name = "sim-counterparts"
    own = SessionSettings(
        "2019-01-10T14:37:26", len(stamps), seed, parked_share=0.15, vehicles=10, people=6, sweeps="none"
    )
    settings = SimulationSettings({name: own}, seed=seed, world="route", real_root=str(real_root))
    rng = partial(_generator, settings, name)
    before, after = np.arange(-margin_s, -0.1, 0.25), np.arange(0.25, margin_s, 0.25)
    middles = stamps + turns // 2
    mean_mps = np.hypot(*(poses[-1] - poses[0])[:2]) / ((middles[-1] - middles[0]) * 1e-6)
    ends = [
        np.column_stack(
            [
                pose[0] + mean_mps * seconds * np.cos(pose[2]),
                pose[1] + mean_mps * seconds * np.sin(pose[2]),
                np.full(len(seconds), pose[2]),
            ]
        )
        for pose, seconds in ((poses[0], before), (poses[-1], after))
    ]
    way = np.concatenate([ends[0], poses, ends[1]])
    times = np.concatenate(
        [middles[0] + (before * 1e6).astype(np.int64), middles, middles[-1] + (after * 1e6).astype(np.int64)]
    )
    mesh, trajectory, traffic = _find_route(settings, own, way, times, rng)
    none: dict[str, np.ndarray] = {sensor: np.zeros(0, dtype=np.int64) for sensor in LIDARS}
    return SimulatedSession(
        settings, name, None, _flat, Scene(mesh), trajectory, traffic, stamps, turns, none, none
    )


def _flat(places: np.ndarray) -> np.ndarray:
    """Height of the land in a world grown from a map, which knows no heights."""
    return np.zeros(len(places))


@lru_cache(maxsize=1)
def _read_map(path: str, seed: int, unmapped_share: float) -> tuple[Cells, Cells]:
    """Read the map, and the objects missing on it: the same for all sessions of a world."""
    cells = classify_cells(rall.load_map_points(path))
    return cells, draw_unmapped(cells, np.random.default_rng([seed, 0, 98]), fraction=unmapped_share)


@lru_cache(maxsize=1)
def _build_town(seed: int, loop_m: float, relief_m: float) -> Town:
    return build_town(np.random.default_rng([seed, 0, 99]), loop_length=loop_m, relief=relief_m)


def make_scan(session: SimulatedSession, index: int) -> RadarScan:
    """Simulate one radar scan.

    Parameters
    ----------
    session : SimulatedSession
        The session.
    index : int
        Which scan.

    Returns
    -------
    scan : oxford.RadarScan
        As `rol_sim.session.oxford_files.save_radar` takes it.
    """
    stamp, turn, rng = (
        int(session.scans_us[index]),
        int(session.turns_us[index]),
        session.generator(SCAN, index),
    )
    _, settings = sensor_settings(session.settings)
    height = settings.height + float(session.ground(session.trajectory.pose(np.array([stamp]))[:, :2])[0])
    times = logs.scan_row_times(stamp, turn)
    middle = stamp + 0.5 * turn
    bodies, _, velocities = session.traffic.bodies_at(
        middle, session.trajectory.pose(np.array([middle]))[0], 170.0
    )
    moves = {session.first_mover + int(i): tuple(v) for i, v in zip(bodies, velocities, strict=True)}
    codes = simulate_scan(
        session.scene_at(middle),
        session.trajectory.pose(times),
        session.trajectory.velocity(times),
        rng,
        replace(settings, height=height),
        moves,
    )
    counters = (FIRST_COUNT + COUNT_STEP * np.arange(N_AZIMUTHS)).astype(np.uint16)
    return RadarScan(
        logs.draw_row_stamps(stamp, turn, rng), counters, np.full(N_AZIMUTHS, 255, np.uint8), codes
    )


def make_sweep(session: SimulatedSession, sensor: str, index: int) -> Sweep:
    """Simulate one lidar sweep.

    Parameters
    ----------
    session : SimulatedSession
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
    rng = session.generator(SWEEP + LIDARS.index(sensor), index)
    stamps, angles = schedule_firings(
        int(session.sweeps_us[sensor][index]), rng, past_seam=float(rng.uniform(0.0, PACKET_RAD))
    )
    poses = session.trajectory.pose(stamps)
    height = session.settings.radar_height_m + session.ground(poses[:1, :2])[0]
    T_radar_lidar = np.linalg.inv(EXTRINSICS["radar"]) @ EXTRINSICS[sensor]
    settings, _ = sensor_settings(session.settings)
    scene = session.scene_at(float(stamps[len(stamps) // 2]), settings.max_range_m + 10.0)
    sweep = simulate_sweep(scene, (stamps, angles), T_radar_lidar, poses, float(height), rng, settings)
    return hide_behind_car(sweep, sensor)
