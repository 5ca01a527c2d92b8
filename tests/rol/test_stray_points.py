"""Stray points: a grid that no memory holds is refused before it is allocated, with the extent and the stray points."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rol.geometry import check_grid
from rol.maps import MapError, load_map, save_map
from rol.mcl import MclError, Measurement, build_matched_grid, tabulate_distances
from rol_beyond.likelihood_field import build_likelihood_field
from rol_beyond.recovery import RecoveringFilter, RecoverySettings
from rol_beyond.robust import settings_for
from rol_beyond.search import SearchSettings, search_poses
from rol_sim.world.mapped import classify_cells
from rol_study.sampled_points import SampledPointsError, find_visible_points

RNG = np.random.default_rng(1)
STREET = RNG.uniform(-50.0, 50.0, (200, 2))
STRAY = np.vstack([STREET, [[1e6, -1e6]]])
TOLD = r"map: points from x -[45]\d\S* to 1e\+06 m and y -1e\+06 to \S+ m; 1 of 201 lie far .* farthest at \(1e\+06, -1e\+06\) m"


@pytest.mark.parametrize(
    "build",
    [
        build_matched_grid,
        build_likelihood_field,
        Measurement().build_grid,
        lambda points: find_visible_points(points, np.zeros((1, 3))),
        classify_cells,
        lambda points: RecoveringFilter(
            points, np.zeros(3), settings_for("robust"), RecoverySettings(0.2), RNG
        ),
    ],
)
def test_map_with_a_stray_point_is_refused(build: Callable) -> None:
    with pytest.raises(ValueError, match=TOLD + r"; their grid would take [\d,]+ GiB"):
        build(STRAY)
    build(STREET)


def test_narrow_map_that_is_far_too_long_is_refused() -> None:
    """Its grid would fit, but no map reaches over more than 100 km."""
    with pytest.raises(MclError, match="1 of 201 lie far"):
        build_matched_grid(np.vstack([STREET, [[2e5, 0.0]]]), cell=1.0)


def test_cloud_with_a_stray_point_is_refused_by_the_search() -> None:
    grid = build_likelihood_field(STREET)
    with pytest.raises(ValueError, match=r"^cloud: points from .*; 1 of 201 lie far .* GiB"):
        search_poses(STRAY, grid, grid, np.zeros(3), SearchSettings(5.0))


def test_map_file_with_a_stray_point_is_named(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"map\.npz: points from .*; 1 of 201 lie far"):
        save_map(tmp_path / "map.npz", STRAY, np.zeros(3))
    np.savez(tmp_path / "map.npz", points=STRAY, T_map_session=np.zeros(3))
    with pytest.raises(MapError, match=r"map\.npz: points from .*; 1 of 201 lie far"):
        load_map(tmp_path / "map.npz")


def test_points_that_are_not_finite_are_refused_before_the_grid() -> None:
    with pytest.raises(SampledPointsError, match="not finite"):
        find_visible_points(np.array([[0.0, np.inf]]), np.zeros((1, 3)))


def test_size_of_a_grid_counts_its_bytes() -> None:
    assert check_grid(np.array([2.0, 3.0]), STREET, "map") == (2, 3)
    check_grid((2**16, 2**16), STREET, "map")
    with pytest.raises(ValueError, match=r"map: .*; 0 of 200 lie far .* take 16 GiB"):
        check_grid((2**16, 2**16), STREET, "map", n_bytes=4)


@pytest.mark.parametrize(
    ("cell", "reach"), [(0.0, 1.0), (1.0, 0.0), (np.nan, 1.0), (-1.0, 1.0), (np.inf, 1.0)]
)
def test_lengths_of_a_grid_must_be_above_zero(cell: float, reach: float) -> None:
    with pytest.raises(MclError, match="must be above zero"):
        tabulate_distances(STREET, cell, reach, np.ones(1, dtype=np.uint8))
