"""The simulated town: rays against bodies worked out by hand, rules that every town keeps, the trajectory, the lidar."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

pytest.importorskip("open3d")
from rol.geometry import compose
from rol.oxford import EXTRINSICS, VelodyneRaw, velodyne_raw_to_points
from rol_sim.drive import traffic
from rol_sim.drive.town_loop import Route, build_route, plan_trajectory
from rol_sim.sensors import lidar as lidar_sensor
from rol_sim.sensors.lidar import LidarSettings, schedule_firings, simulate_sweep
from rol_sim.world import town as world
from rol_sim.world.houses import overlaps
from rol_sim.world.mesh import GROUND_MATERIALS, Material, make_mesh, merge_meshes, move_mesh
from rol_sim.world.scene import Scene
from rol_sim.world.shapes import build_block, build_box, build_tree, lay_facade
from rol_sim.world.streets import build_plan
from rol_sim.world.vehicles import build_furniture, build_vehicle

pytestmark = pytest.mark.open3d
STAMP = 1_547_120_781_000_000


@pytest.fixture(scope="module")
def town() -> world.Town:
    return world.build_town(np.random.default_rng(3))


@pytest.fixture(scope="module")
def trajectory(town: world.Town):
    return plan_trajectory(build_route(town.plan), STAMP, 40.0, np.random.default_rng(5))


def wall(x: float, material: int, number: int):
    """Two triangles that stand across the x axis, 2 m wide and high."""
    corners = [[x, -1, -1], [x, 1, -1], [x, 1, 1], [x, -1, 1]]
    return make_mesh(corners, [[0, 1, 2], [0, 2, 3]], material, number)


def area(corners: np.ndarray) -> np.ndarray:
    """Area of flat quadrangles (n, 4, 3)."""
    across = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    return 0.5 * np.linalg.norm(across, axis=1)


# ---- meshes and rays ----


def test_mesh_refuses_a_corner_that_is_not_there() -> None:
    with pytest.raises(ValueError, match="names corner 3 of 3"):
        make_mesh(np.zeros((3, 3)), [[0, 1, 3]], Material.WALL)


def test_meshes_are_merged_and_moved() -> None:
    merged = merge_meshes([wall(5.0, Material.FACADE, 1), wall(9.0, Material.WALL, 2)])
    assert merged.triangles.max() == 7
    assert merged.objects.tolist() == [1, 1, 2, 2]
    moved = move_mesh(merged, (10.0, 20.0, np.pi / 2), z=1.0, object_id=7)
    np.testing.assert_allclose(moved.vertices[0], [10.0 + 1.0, 20.0 + 5.0, 0.0], atol=1e-5)
    assert set(moved.objects) == {7}
    assert len(merge_meshes([]).triangles) == 0


def test_first_hits() -> None:
    scene = Scene([wall(5.0, Material.FACADE, 1), wall(9.0, Material.WALL, 2)])
    rays = np.array([[0, 0.2, 0.1, 1, 0, 0], [0, 3.0, 0, 1, 0, 0], [7, 0.2, 0, -0.6, 0, 0.8]])
    hits = scene.cast(rays)
    np.testing.assert_allclose(hits.t[0], 5.0, rtol=1e-6)
    assert np.isinf(hits.t[1]) and np.isinf(hits.t[2])  # beside the walls; over the top of the first
    assert hits.material.tolist() == [Material.FACADE, Material.NONE, Material.NONE]
    assert hits.object_id.tolist() == [1, -1, -1]
    np.testing.assert_allclose(hits.normals[0], [-1, 0, 0], atol=1e-6)  # towards the ray's origin
    np.testing.assert_allclose(hits.cos_incidence, [1, 0, 0], atol=1e-6)


def test_moving_bodies_share_the_standing_scene() -> None:
    scene = Scene(wall(5.0, Material.FACADE, 1))
    ray = np.array([[0, 0.2, 0.1, 1, 0, 0]])
    moving = scene.with_moving([wall(3.0, Material.VEHICLE, 7)])
    assert moving.cast(ray).material[0] == Material.VEHICLE
    assert moving.cast(ray).object_id[0] == 7
    assert scene.cast(ray).material[0] == Material.FACADE
    assert moving.with_moving([]).cast(ray).material[0] == Material.FACADE
    behind = scene.with_moving([wall(8.0, Material.VEHICLE, 7)])
    assert behind.cast(ray).material[0] == Material.FACADE


def test_first_hits_of_standing_and_moving_walls() -> None:
    scene = Scene([wall(9.0, Material.WALL, 2), wall(5.0, Material.FACADE, 1)])
    scene = scene.with_moving(wall(7.0, Material.VEHICLE, 3))
    slanted = np.array([0.8, 0.0, 0.6])
    rays = np.array([[5.5, 0.3, 0.1, 1, 0, 0], [0, 9, 0, 1, 0, 0], [4.2, 0.3, -0.5, *slanted]])
    found = scene.cast(rays)
    np.testing.assert_allclose(found.t, [1.5, np.inf, 1.0], rtol=1e-6)
    assert found.material.tolist() == [Material.VEHICLE, Material.NONE, Material.FACADE]
    np.testing.assert_allclose(found.cos_incidence, [1, 0, 0.8], atol=1e-6)


def test_scene_refuses_nonsense() -> None:
    with pytest.raises(ValueError, match="no triangle"):
        Scene([])
    with pytest.raises(ValueError, match=r"expected shape \(n, 6\)"):
        Scene(wall(5.0, Material.FACADE, 1)).cast(np.zeros((2, 5)))


# ---- bodies ----


def test_facade_has_windows_set_back() -> None:
    # 6 m long, 3 m high: one row of two windows of 1.1 m x 1.4 m, a pane 0.12 m behind the face.
    corners, materials = lay_facade(np.zeros(2), np.array([6.0, 0.0]), 0.0, 3.0, windows=2)
    is_glass = materials == Material.GLASS
    assert is_glass.sum() == 2
    np.testing.assert_allclose(area(corners[is_glass]), 1.1 * 1.4)
    np.testing.assert_allclose(corners[is_glass][..., 1], 0.12)  # the outside lies at negative y
    reveals = 2 * 2 * (1.1 + 1.4) * 0.12
    np.testing.assert_allclose(area(corners[~is_glass]).sum(), 6 * 3 - 2 * 1.1 * 1.4 + reveals)


def test_block_is_closed_to_rays() -> None:
    scene = Scene(build_block(-4.0, 4.0, -3.0, 3.0, 6.0, 2.0))
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(500, 3)).astype(np.float32)
    direction[:, 2] = np.abs(direction[:, 2]) * 0.5
    start = np.tile([0.3, 0.1, 0.4], (500, 1))
    assert np.isfinite(scene.cast(np.hstack([start, direction])).t).all()  # from inside there is no way out


def test_tree_lets_part_of_the_rays_pass() -> None:
    tree = build_tree(0.2, 1.0, 2.0, 5.0, 1.0, np.random.default_rng(2))
    y, z = np.random.default_rng(3).uniform([-0.5, 2.5], [0.5, 3.5], (4000, 2)).T
    rays = np.column_stack([np.full(4000, -9.0), y, z, np.ones(4000), np.zeros((4000, 2))])
    only_crown = make_mesh(tree.vertices, tree.triangles[tree.materials == Material.TREE_CROWN], 12)
    passed = np.isinf(Scene(only_crown).cast(rays).t).mean()
    assert 0.15 < passed < 0.6  # exp(-1) = 0.37 for flakes spread evenly


@pytest.mark.parametrize("kind", ["car", "estate", "van", "lorry", "bus"])
def test_vehicles_stand_on_the_ground(kind: str) -> None:
    body = build_vehicle(kind, np.random.default_rng(4)).vertices
    size = body.max(axis=0) - body.min(axis=0)
    assert body[:, 2].min() == 0.0
    assert 3.3 < size[0] < 12.0 and 1.4 < size[1] < 3.0 and 1.2 < size[2] < 3.7


def test_unknown_furniture_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown kind of street furniture: 'sofa'"):
        build_furniture("sofa", np.random.default_rng(0))


# ---- the town ----


def test_rectangles_overlap() -> None:
    one = np.array([0.0, 0.0, 0.0, 2.0, 1.0])
    others = np.array(
        [
            [3.9, 0.0, 0.0, 2.0, 1.0],  # 0.1 m shared
            [4.0, 0.0, 0.0, 2.0, 1.0],  # touching
            [0.0, 2.9, np.pi / 2, 2.0, 1.0],  # turned: reaches down to 0.9
            [0.0, 3.1, np.pi / 2, 2.0, 1.0],
            [3.0, 2.0, np.pi / 4, 1.0, 1.0],  # its corner lies at (3, 0.59), its edge clears (2, 1)
            [2.4, 1.4, np.pi / 4, 1.0, 1.0],
            [50.0, 0.0, 0.3, 2.0, 1.0],
        ]
    )
    assert overlaps(one, others).tolist() == [True, False, True, False, False, True, False]
    assert overlaps(one, np.zeros((0, 5))).shape == (0,)


def test_clearance_against_brute_force(town: world.Town) -> None:
    points = np.random.default_rng(6).uniform(-150.0, 150.0, (300, 2))
    slow = np.full(300, np.inf)
    for street in town.plan.streets:
        gaps = np.linalg.norm(points[:, None] - street.centre, axis=2).min(axis=1) - street.half_width
        slow = np.minimum(slow, gaps)
    fast = town.plan.clearance(points)
    near = slow < 24.0
    assert near.sum() > 100
    np.testing.assert_allclose(fast[near], slow[near], atol=1e-9)
    assert (fast[~near] > 24.0).all()


def test_same_generator_same_town(town: world.Town) -> None:
    again = world.build_town(np.random.default_rng(3))
    for name in ("vertices", "triangles", "materials", "objects"):
        np.testing.assert_array_equal(getattr(again.mesh, name), getattr(town.mesh, name))
    np.testing.assert_array_equal(again.trees, town.trees)
    assert not np.array_equal(build_plan(np.random.default_rng(4)).loop[:50], town.plan.loop[:50])


def test_town_keeps_its_rules(town: world.Town) -> None:
    loop = np.vstack([town.plan.loop, town.plan.loop[:1]])
    np.testing.assert_allclose(np.linalg.norm(np.diff(loop, axis=0), axis=1).sum(), 600.0, rtol=1e-3)
    assert len(town.footprints) > 250 and len(town.trees) > 100 and len(town.slots) > 100
    for i, footprint in enumerate(town.footprints):
        assert not overlaps(footprint, town.footprints[:i]).any()
        corners = np.array([[a, b] for a in (-1, 1) for b in (-1, 1)]) * footprint[3:]
        places = [compose(footprint[:3], np.array([x, y, 0.0]))[:2] for x, y in corners]
        assert town.plan.clearance(np.array(places)).min() > 2.0  # no house on a pavement
    assert town.plan.clearance(town.trees[:, :2]).min() > 0.3
    assert town.plan.clearance(np.array([pose[:2] for _, pose in town.furniture])).min() > 0.1
    assert np.abs(town.plan.ground(town.plan.loop)).max() < 0.1  # level where the sessions drive
    assert np.abs(town.plan.ground(town.trees[:, :2])).max() > 0.5  # but not everywhere
    assert {int(m) for m in np.unique(town.mesh.materials)} >= {m.value for m in GROUND_MATERIALS}


def test_no_direction_is_empty(town: world.Town) -> None:
    """Everywhere on the route walls stand on both sides and not all the same way: places can be told apart."""
    scene = Scene(town.mesh)
    route = build_route(town.plan)
    poses = route.place(np.arange(0.0, route.length, 20.0), 0.0)
    angles = np.linspace(-np.pi, np.pi, 180, endpoint=False)
    for x, y, yaw in poses:
        rays = np.column_stack(
            [np.full((180, 3), (x, y, 2.5)), np.cos(yaw + angles), np.sin(yaw + angles), np.zeros(180)]
        )
        hits = scene.cast(rays)
        t, is_wall = np.where(np.isfinite(hits.t), hits.t, 1e3), hits.t < 64.0
        assert is_wall[angles > 0].mean() > 0.3 and is_wall[angles < 0].mean() > 0.3
        normals = hits.normals[is_wall, :2]
        spread = np.linalg.eigvalsh(normals.T @ normals / len(normals))
        assert spread[0] > 0.02, f"only parallel walls at {x:.0f}, {y:.0f}"
        assert np.median(t) < 64.0


def test_sessions_dress_the_town_differently(town: world.Town) -> None:
    first, other = (world.add_session_objects(town, np.random.default_rng(k)) for k in (1, 2))
    assert len(first.triangles) != len(other.triangles)
    assert first.objects.min() == town.mesh.objects.max() + 1
    found = {Material(number) for number in np.unique(first.materials)}
    assert found >= {
        Material.VEHICLE,
        Material.HEDGE,
        Material.TREE_CROWN,
        Material.TREE_TRUNK,
        Material.METAL,
    }
    bare = world.add_session_objects(town, np.random.default_rng(1), parked_share=0.0, leaf_density=0.5)
    assert not (bare.materials == Material.VEHICLE).any()
    ratio = (bare.materials == Material.TREE_CROWN).sum() / (first.materials == Material.TREE_CROWN).sum()
    assert 0.45 < ratio < 0.55


# ---- the trajectory ----


def test_route_is_closed_and_smooth(town: world.Town) -> None:
    route = build_route(town.plan)
    assert 540.0 < route.length < 600.0  # rounded corners are shorter
    ends = route.place(np.array([0.0, route.length, 5.0 - route.length]), 0.0)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)
    np.testing.assert_allclose(ends[2, :2], route.place(np.array([5.0]), 0.0)[0, :2], atol=1e-9)
    s = np.arange(0.0, route.length, 0.5)
    yaw = np.unwrap(route.place(s, 0.0)[:, 2])
    assert np.abs(np.diff(yaw) / 0.5).max() < 1.0 / 5.0  # no bend tighter than 5 m
    left = route.place(s, 2.0)
    np.testing.assert_allclose(np.linalg.norm(left[:, :2] - route.place(s, 0.0)[:, :2], axis=1), 2.0)


def test_drive_obeys_physics(town: world.Town, trajectory) -> None:
    dt = 0.005
    assert trajectory.stamps_us[0] == STAMP - 1_000_000 and trajectory.stamps_us[-1] >= STAMP + 41_000_000
    assert (
        trajectory.speeds[0] == 0.0 and np.abs(trajectory.speeds[: int(1.5 / dt)]).max() < 0.05
    )  # stands at the start
    assert trajectory.speeds.min() > -1e-6 and 7.0 < trajectory.speeds.max() < 10.0
    acceleration = np.gradient(trajectory.speeds, dt)
    assert acceleration.min() > -1.9 and acceleration.max() < 1.5
    step = np.diff(trajectory.poses, axis=0)
    forward = np.hypot(step[:, 0], step[:, 1])
    np.testing.assert_allclose(forward.sum(), np.sum(trajectory.speeds[:-1] * dt), rtol=1e-3)
    moving = forward > 0.01
    direction = np.arctan2(step[moving, 1], step[moving, 0])
    slip = (direction - trajectory.poses[:-1][moving, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(slip).max() < 0.02  # the car goes where it points
    assert np.abs(trajectory.speeds[:-1][moving] * step[moving, 2] / dt).max() < 2.6  # lateral acceleration
    assert (
        town.plan.clearance(trajectory.poses[:, :2]).max() < -1.5
    )  # half a car's width and more from the kerb


def test_drive_stops_on_the_way(town: world.Town) -> None:
    route = build_route(town.plan)
    for stops in (0, 1, 2):
        d = plan_trajectory(route, STAMP, 60.0, np.random.default_rng(2), n_stops=stops, stand_s=1.0)
        is_standing = d.speeds < 0.02
        begins = np.flatnonzero(is_standing[1:] & ~is_standing[:-1])
        assert len(begins) == stops


def test_sessions_start_a_few_metres_apart(town: world.Town) -> None:
    route = build_route(town.plan)
    starts = [
        plan_trajectory(route, STAMP, 5.0, np.random.default_rng(k), start_m=20.0).progress[0]
        for k in range(12)
    ]
    offsets = np.abs(np.array(starts) - 20.0)
    assert offsets.min() >= 1.0 and offsets.max() <= 4.0


def test_drive_interpolates_and_refuses_times_outside(trajectory) -> None:
    middle = trajectory.pose(np.array([trajectory.stamps_us[4000] + 2_500]))[0]
    np.testing.assert_allclose(middle[:2], trajectory.poses[4000:4002, :2].mean(axis=0), atol=1e-9)
    velocity = trajectory.velocity(trajectory.stamps_us[4000:4001])[0]
    np.testing.assert_allclose(np.hypot(*velocity), trajectory.speeds[4000])
    with pytest.raises(ValueError, match="lies outside the trajectory"):
        trajectory.pose(np.array([trajectory.stamps_us[-1] + 1]))
    route = Route(np.zeros((4, 2)), 1.0, np.zeros(0))
    with pytest.raises(ValueError, match="must be positive"):
        plan_trajectory(route, STAMP, -1.0, np.random.default_rng(0))


def test_nobody_drives_through_the_car(town: world.Town, trajectory) -> None:
    cars = traffic.plan_traffic(
        town.plan, build_route(town.plan), trajectory, np.random.default_rng(8), n_vehicles=14, n_people=5
    )
    assert len(cars.meshes) == 19
    for stamp in range(STAMP, STAMP + 40_000_000, 200_000):
        own = trajectory.pose(np.array([stamp]))[0]
        numbers, poses, _ = cars.bodies_at(stamp, own)
        assert len(numbers) == 19
        for mesh, pose in zip(cars.meshes, poses, strict=True):
            if np.hypot(*(pose[:2] - own[:2])) < 15.0:
                size = np.abs(mesh.vertices[:, :2]).max(axis=0)
                assert not overlaps(np.array([*own, 2.2, 0.9]), np.array([[*pose, *size]])).any()
    velocities = cars.bodies_at(STAMP + 20e6, np.zeros(2))[2]
    assert np.hypot(*velocities.T).max() < 15.0 and np.hypot(*velocities.T).max() > 3.0
    near = cars.meshes_at(town.plan.ground, STAMP, 1000, np.zeros(2), radius=60.0)
    everyone = cars.meshes_at(town.plan.ground, STAMP, 1000, np.zeros(2), radius=1e4)
    assert set(near.objects) < set(everyone.objects) == set(range(1000, 1019))
    nobody = traffic.plan_traffic(
        town.plan, build_route(town.plan), trajectory, np.random.default_rng(8), n_vehicles=0, n_people=0
    )
    assert len(nobody.meshes_at(town.plan.ground, STAMP, 0, np.zeros(2)).triangles) == 0


# ---- the lidar ----

CLEAN = LidarSettings(range_noise_m=0.0, lost_fraction=0.0)


def room() -> Scene:
    """Four walls at x, y = -20, 30 and a floor at z = 0, all of brick."""
    return Scene(build_box(-20.0, 30.0, -20.0, 30.0, 0.0, 40.0, Material.WALL))


def to_room(points: np.ndarray, T_radar_lidar: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Points of a sweep in the room, each by the pose at its own time."""
    in_radar = points @ T_radar_lidar[:3, :3].T + T_radar_lidar[:3, 3]
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + c * in_radar[:, 0] - s * in_radar[:, 1]
    y = poses[:, 1] + s * in_radar[:, 0] + c * in_radar[:, 1]
    return np.column_stack([x, y, in_radar[:, 2] + 2.0])


@pytest.mark.parametrize("sensor", ["velodyne_left", "velodyne_right"])
def test_sweep_reads_back_as_the_true_hits(sensor: str) -> None:
    """A car that drives and turns; the reader's points, each moved by its own pose, lie on the walls."""
    T_radar_lidar = np.linalg.inv(EXTRINSICS["radar"]) @ EXTRINSICS[sensor]
    stamps, angles = schedule_firings(STAMP, np.random.default_rng(1), past_seam=0.05)
    t = (stamps - STAMP) * 1e-6
    poses = np.column_stack([2.0 + 9.0 * t, -1.0 + 3.0 * t, 0.4 + 1.5 * t])
    sweep = simulate_sweep(
        room(), (stamps, angles), T_radar_lidar, poses, 2.0, np.random.default_rng(2), CLEAN
    )
    raw = VelodyneRaw(sweep.intensities, sweep.ranges, sweep.angles, sweep.stamps_us)
    points, point_stamps = velodyne_raw_to_points(raw)
    assert len(points) > 0.8 * 32 * len(stamps)
    pose_of_point = poses[np.searchsorted(stamps, point_stamps)]
    at = to_room(points[:, :3].astype(float), T_radar_lidar, pose_of_point)
    gap = np.min(np.abs([at[:, 0] + 20, at[:, 0] - 30, at[:, 1] + 20, at[:, 1] - 30, at[:, 2]]), axis=0)
    assert gap.max() < 0.002  # a range is rounded to 2 mm, so to 1 mm at most
    still = to_room(
        points[:, :3].astype(float), T_radar_lidar, np.broadcast_to(poses[0], pose_of_point.shape)
    )
    assert np.abs(still - at).max() > 0.4  # the motion within a sweep is there


def test_both_lidars_see_the_same_town(town: world.Town) -> None:
    scene, pose = Scene(town.mesh), np.array([[*build_route(town.plan).place(np.array([50.0]), 1.0)[0]]])
    clouds = []
    for sensor in ("velodyne_left", "velodyne_right"):
        T = np.linalg.inv(EXTRINSICS["radar"]) @ EXTRINSICS[sensor]
        stamps, angles = schedule_firings(STAMP, np.random.default_rng(1))
        poses = np.repeat(pose, len(stamps), axis=0)
        sweep = simulate_sweep(scene, (stamps, angles), T, poses, 2.0, np.random.default_rng(2))
        raw = VelodyneRaw(sweep.intensities, sweep.ranges, sweep.angles, sweep.stamps_us)
        points, _ = velodyne_raw_to_points(raw)
        materials = sweep.materials.T[raw.ranges.T * 0.002 > 1.0]
        in_radar = points[:, :3] @ T[:3, :3].T + T[:3, 3]
        is_road = materials == Material.GROUND
        is_close = np.hypot(in_radar[:, 0], in_radar[:, 1]) < 12.0
        assert is_road.sum() > 5_000
        np.testing.assert_allclose(np.median(in_radar[is_road & is_close, 2]), -2.0, atol=0.1)
        assert ((sweep.materials > 0) == (sweep.ranges > 0)).all()
        assert ((sweep.intensities > 0) == (sweep.ranges > 0)).all()
        clouds.append(in_radar[~np.isin(materials, GROUND_MATERIALS)])
    distance = cKDTree(clouds[0]).query(clouds[1])[0]
    assert np.median(distance) < 0.2


@pytest.mark.parametrize(("past_seam", "count"), [(0.0, 1092), (0.02, 1092), (0.05, 1080)])
def test_firings_follow_the_packets(past_seam: float, count: int) -> None:
    stamps, angles = schedule_firings(STAMP, np.random.default_rng(0), past_seam=past_seam)
    assert len(stamps) == count and stamps[0] == STAMP  # whole packets, as in real sweeps
    assert 49_600 < stamps[-1] - STAMP < 50_400
    assert angles.dtype == np.uint16 and angles.max() < 36_000
    assert angles[0] == round(18_000 + 100 * np.rad2deg(past_seam))
    turned = np.cumsum(np.diff(angles.astype(int)) % 36_000)
    np.testing.assert_allclose(np.diff(turned).mean(), 33.2, atol=0.1)  # clockwise seen from above
    assert (
        0 <= turned[-1] + 34 - (36_000 - 100 * np.rad2deg(past_seam)) < 400
    )  # it ends where the next one begins
    for start in range(0, count - 12, 12):  # between two packets times are interpolated
        line = np.linspace(stamps[start], stamps[start + 12], 13)
        assert np.abs(stamps[start : start + 13] - line).max() <= 1.0


def test_the_own_car_hides_the_same_on_both_sides() -> None:
    """The lowest laser sees the road beside the car only: on the left by the left lidar, on the right by the right one."""
    angles = np.arange(0, 36_000, 100, dtype=np.uint16)
    ones = np.ones((32, len(angles)))
    full = lidar_sensor.Sweep(
        ones.astype(np.uint8), ones.astype(np.uint16), angles, angles.astype(np.int64), ones.astype(np.uint8)
    )
    seen = {
        sensor: lidar_sensor.hide_behind_car(full, sensor) for sensor in ("velodyne_left", "velodyne_right")
    }
    assert (seen["velodyne_left"].ranges[31, 160:250] > 0).all()  # 180 deg is the vehicle's left
    assert (seen["velodyne_left"].ranges[31, 0:90] == 0).all() and (
        seen["velodyne_left"].ranges[:, :40] == 0
    ).all()
    assert (seen["velodyne_right"].ranges[31, 0:20] > 0).all() and (
        seen["velodyne_right"].ranges[31, 290:] > 0
    ).all()
    mirror = (540 - 1 - np.arange(360)) % 360
    np.testing.assert_array_equal(seen["velodyne_right"].ranges, seen["velodyne_left"].ranges[:, mirror])
    for sweep in seen.values():
        for values, kind in (
            (sweep.ranges, np.uint16),
            (sweep.intensities, np.uint8),
            (sweep.materials, np.uint8),
        ):
            np.testing.assert_array_equal(values > 0, sweep.ranges > 0)
            assert values.dtype == kind
    with pytest.raises(ValueError, match="expected one of velodyne_left, velodyne_right, got 'top'"):
        lidar_sensor.hide_behind_car(full, "top")


def test_what_a_lidar_loses() -> None:
    """Beyond the greatest range nothing comes back; leaves and glass swallow their share; noise is as asked for."""
    stamps, angles = schedule_firings(STAMP, np.random.default_rng(1))
    poses = np.zeros((len(stamps), 3))

    def level_ranges(material: int, distance: float, settings: LidarSettings) -> np.ndarray:
        far = Scene(build_box(-distance, distance, -distance, distance, -300.0, 300.0, material))
        sweep = simulate_sweep(
            far, (stamps, angles), np.eye(4), poses, 2.0, np.random.default_rng(3), settings
        )
        return sweep.ranges[8, :40] * 0.002  # the level laser, within 13 deg of the wall's normal

    assert (level_ranges(Material.FACADE, 101.0, CLEAN) == 0).all()
    np.testing.assert_allclose(level_ranges(Material.FACADE, 50.0, CLEAN)[0], 50.0, atol=0.002)
    noisy = level_ranges(Material.FACADE, 30.0, LidarSettings(range_noise_m=0.02, lost_fraction=0.0))
    true = level_ranges(Material.FACADE, 30.0, CLEAN)
    kept = (noisy > 0) & (true > 0)
    assert 0.012 < np.std(noisy[kept] - true[kept]) < 0.03
    glass = (level_ranges(Material.GLASS, 10.0, CLEAN) > 0).mean()
    assert 0.2 < glass < 0.7
    assert set(lidar_sensor.SURFACES) == {m.name for m in Material} - {"NONE"}
