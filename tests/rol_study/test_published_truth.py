"""Published ground truth beside the data set's odometry, and paths of sessions beside one another."""

import numpy as np
import pytest

from rol.geometry import compose
from rol_study.published_truth import largest_gap, lateral_offsets


def test_a_path_beside_another_is_offset_to_its_left() -> None:
    reference = np.column_stack([np.zeros(50), np.arange(50.0), np.full(50, np.pi / 2)])  # along y
    beside = reference[10:20] + (-1.5, 0.3, 0.0)  # left of a vehicle that drives along y
    np.testing.assert_allclose(lateral_offsets(beside, reference), 1.5, atol=1e-9)
    assert np.isnan(lateral_offsets(beside + (0.0, 0.0, np.pi), reference)).all()  # the other way
    assert np.isnan(lateral_offsets(beside - (20.0, 0.0, 0.0), reference)).all()


def test_a_ground_truth_is_an_odometry_wherever_that_starts() -> None:
    rng = np.random.default_rng(3)
    truth = np.cumsum(rng.uniform(-1.0, 1.0, (30, 3)), axis=0)
    moved = compose((40.0, -7.0, 2.0), truth)
    assert largest_gap(truth, moved[:29]) < 1e-9
    moved[12, :2] += 0.3, 0.4
    assert largest_gap(truth, moved) == pytest.approx(0.5)
