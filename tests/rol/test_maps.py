"""Maps worked out by hand, and registrations with a known answer."""

import io

import numpy as np
import pytest

from rol import maps
from rol.geometry import compose, invert, transform_points
from rol.maps import (
    MapError,
    accumulate_map,
    load_map,
    register_maps,
    residuals_along,
    save_map,
    thin_points,
    to_first_map,
)

add_points = maps._add_points


def street_map(rng: np.random.Generator) -> np.ndarray:
    """Points (n, 2) of house fronts along a street with a bend, seen from its start [m]."""
    fronts = []
    for side in (-9.0, 8.0):
        for x in np.arange(-40.0, 260.0, 14.0):
            front, depth = np.arange(x, x + rng.uniform(8.0, 12.0), 0.25), side * rng.uniform(1.0, 1.3)
            y = depth + 0.002 * np.maximum(front - 100.0, 0.0) ** 2
            flank = np.arange(0.0, 6.0, 0.25) * np.sign(side)
            fronts += [np.stack([front, y], 1), np.stack([np.full_like(flank, x), y[0] + flank], 1)]
    return np.concatenate(fronts)


def test_thin_points_by_hand():
    points = np.array([[0.1, 0.1], [0.3, 0.5], [-0.2, 0.9], [1.9, -0.1]])
    means, cells = thin_points(points, 1.0)
    assert cells.tolist() == [[-1, 0], [0, 0], [1, -1]]
    np.testing.assert_allclose(means, [[-0.2, 0.9], [0.2, 0.3], [1.9, -0.1]])
    assert thin_points(np.zeros((0, 2)), 1.0)[0].shape == (0, 2)


def test_accumulate_map_counts_clouds_and_not_points():
    # three clouds: a wall point at (5.1, 0.1) in all, a lorry's three points in one cell of one cloud
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, np.pi / 2]])
    lorry = np.array([[2.1, 2.1], [2.15, 2.1], [2.1, 2.15]])
    wall = [np.array([[5.1, 0.1]]), np.array([[4.1, 0.1]]), np.array([[0.1, -3.1]])]
    clouds = [np.concatenate([wall[0], lorry]), wall[1], wall[2]]
    points = accumulate_map(clouds, poses, cell=0.5, min_hits=2)
    np.testing.assert_allclose(points, [[5.1, 0.1]], atol=1e-9)
    assert len(accumulate_map(clouds, poses, cell=0.5, min_hits=1)) == 2


def test_accumulate_map_in_parts_gives_the_same_bits(monkeypatch):
    rng = np.random.default_rng(5)
    poses = np.column_stack([rng.uniform(-50, 50, (40, 2)), rng.uniform(-3, 3, 40)])
    clouds = [rng.uniform(-20.0, 20.0, (rng.integers(0, 300), 2)) for _ in poses]
    at_once = accumulate_map(clouds, poses, cell=0.5, min_hits=2)
    monkeypatch.setattr(maps, "_WAITING_POINTS", 50)
    added = []
    monkeypatch.setattr(maps, "_add_points", lambda *given: added.append(1) or add_points(*given))
    np.testing.assert_array_equal(accumulate_map(iter(clouds), poses, cell=0.5, min_hits=2), at_once)
    assert len(added) > 3 and len(at_once) > 50


def test_accumulate_map_takes_empty_clouds_and_refuses_an_empty_map():
    one = np.array([[1.0, 1.0]])
    assert len(accumulate_map([one, np.zeros((0, 2)), one], np.zeros((3, 3)))) == 1
    with pytest.raises(MapError, match="the map is empty: no cell is hit by 2 of 2 clouds"):
        accumulate_map([one, np.zeros((0, 2))], np.zeros((2, 3)))
    with pytest.raises(MapError, match="the map is empty"):
        accumulate_map([], np.zeros((0, 3)))


def test_accumulate_map_wants_one_cloud_per_pose():
    one = np.array([[1.0, 1.0]])
    with pytest.raises(MapError, match="1 clouds for 2 poses"):
        accumulate_map([one], np.zeros((2, 3)))
    with pytest.raises(MapError, match="more clouds than the 1 poses"):
        accumulate_map([one, one], np.zeros((1, 3)))
    with pytest.raises(MapError, match="cloud 0: point [0-9]+ is not finite"):
        accumulate_map([one * np.nan], np.zeros((1, 3)))


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (6.0, -2.0, 0.03), (-3.0, 1.5, -0.06)])
def test_register_maps_finds_the_offset_from_zero(offset):
    rng = np.random.default_rng(4)
    target = street_map(rng)
    source = transform_points(invert(offset), target) + rng.normal(0.0, 0.05, target.shape)
    registration = register_maps(source, target)
    assert registration.converged and registration.fraction_1m == 1.0 and registration.median_m < 0.1
    np.testing.assert_allclose(registration.T_target_source, offset, atol=0.05)
    assert [stage[0] for stage in registration.stages] == [100.0, 200.0, np.inf, np.inf]


def test_register_maps_names_the_empty_one():
    some = np.zeros((20, 2))
    with pytest.raises(MapError, match="the source map is empty"):
        register_maps(np.zeros((0, 2)), some)
    with pytest.raises(MapError, match="the target map is empty"):
        register_maps(some, np.zeros((0, 2)))


def test_poses_go_along_with_their_map():
    T_map_session, pose, point = (
        np.array([3.0, 1.0, 0.2]),
        np.array([[5.0, 2.0, -0.1]]),
        np.array([[4.0, -1.0]]),
    )
    in_first = to_first_map(T_map_session, pose)
    np.testing.assert_allclose(in_first[0], compose(T_map_session, pose[0]))
    # a point seen from the pose lies where the registered map has it
    by_map = transform_points(T_map_session, transform_points(pose[0], point))
    np.testing.assert_allclose(transform_points(in_first[0], point), by_map)


def test_residuals_along_by_hand():
    map_points = np.array([[10.0, 0.0], [0.0, 10.0]])
    clouds = [np.array([[10.0, 0.5], [0.0, 11.5], [9.0, 0.0]]), np.zeros((0, 2)), np.array([[8.0, 0.0]])]
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(residuals_along(clouds, poses, map_points), [1.0, np.nan, 1.0])
    with pytest.raises(MapError, match="the map is empty"):
        residuals_along(clouds, poses, np.zeros((0, 2)))
    with pytest.raises(ValueError, match="zip"):
        residuals_along(clouds, poses[:2], map_points)


def test_map_file_round_trip_and_its_faults(tmp_path):
    path, points, pose = (
        tmp_path / "maps" / "s.npz",
        np.array([[1.0, 2.0], [3.0, 4.0]]),
        np.array([0.1, 0.2, 0.3]),
    )
    save_map(path, points, pose)
    for got, put in zip(load_map(path), (points, pose), strict=True):
        np.testing.assert_array_equal(got, put)
    assert [p.name for p in path.parent.iterdir()] == ["s.npz"]
    for bad_points, bad_pose, fault in (
        (np.zeros((0, 2)), pose, "the map is empty"),
        (points * np.nan, pose, "not finite"),
        (np.zeros((4, 3)), pose, "expected points"),
        (points, np.zeros(4), r"T_map_session: expected shape \(.*3\)"),
        (points, pose * np.inf, r"T_map_session: value at index \(0,\) is not finite"),
    ):
        with pytest.raises(MapError, match=f"bad.npz: .*{fault}"):
            save_map(tmp_path / "bad.npz", bad_points, bad_pose)
    with pytest.raises(MapError, match="none.npz: missing"):
        load_map(tmp_path / "none.npz")
    whole, array = path.read_bytes(), io.BytesIO()
    np.save(array, points)
    for content in (whole[: len(whole) // 2], b"", b"text", array.getvalue()):
        path.write_bytes(content)
        with pytest.raises(MapError, match="s.npz: not a whole map file"):
            load_map(path)
    np.savez(path, other=points)
    with pytest.raises(MapError, match="s.npz: not a whole map file"):
        load_map(path)
