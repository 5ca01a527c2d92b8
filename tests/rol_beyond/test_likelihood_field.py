"""Likelihood field against values worked out by hand."""

import numpy as np
import pytest

from rol.mcl import MclError
from rol_beyond.likelihood_field import LikelihoodField, build_likelihood_field


def test_likelihood_field_by_hand():
    # on the point one, one sigma away exp(-1/2), three sigma away nothing
    grid = build_likelihood_field(np.array([[0.05, 0.05]]), sigma=0.5, cell=0.1)
    i, j = np.floor((np.array([0.05, 0.05]) - grid.origin) / 0.1).astype(int)
    assert grid.values[i, j] == grid.best == 255
    assert grid.values[i + 5, j] / grid.best == pytest.approx(np.exp(-0.5), abs=0.01)
    assert grid.values[i + 10, j] / grid.best == pytest.approx(np.exp(-2.0), abs=0.01)
    assert grid.values[0, 0] == 0


def test_points_in_dense_map_regions_are_down_weighted():
    lone, dense = (
        np.array([[0.125, 0.125]]),
        np.stack(np.meshgrid(*[np.arange(0.125, 8.0, 0.25)] * 2), axis=-1),
    )
    points = np.concatenate([lone, dense.reshape(-1, 2) + (20.0, 0.0)])
    grid = build_likelihood_field(points, 0.2, 0.25, density_radius_m=2.0)
    plain = build_likelihood_field(points, 0.2, 0.25)
    np.testing.assert_allclose(grid.origin, plain.origin)

    def value(grid, x, y):
        i, j = np.floor((np.array([x, y]) - grid.origin) / 0.25).astype(int)
        return int(grid.values[i, j])

    assert value(plain, 24.1, 4.1) == value(plain, 0.1, 0.1) == 255
    assert value(grid, 24.1, 4.1) == round(255 / (1 + 1 / 0.6))  # all of the square is matched
    assert value(grid, 0.1, 0.1) > 245
    assert ((grid.values > 0) <= (plain.values > 0)).all()


def test_settings_build_the_field_and_an_empty_map_is_an_error():
    points = np.random.default_rng(0).uniform(0.0, 9.0, (50, 2))
    built = LikelihoodField(sigma_m=0.3, density_radius_m=1.0, cell_m=0.5).build_grid(points)
    np.testing.assert_array_equal(built.values, build_likelihood_field(points, 0.3, 0.5, 1.0).values)
    with pytest.raises(MclError, match="the map holds no point"):
        LikelihoodField().build_grid(np.zeros((0, 2)))
