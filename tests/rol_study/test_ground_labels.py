"""Losses of a height threshold, counted by hand."""

import numpy as np
import pytest

from rol_study import ground_labels
from rol_study.ground_labels import measure_ground_removal, read_labelled_sweeps


def test_fractions_of_points_and_of_pixels():
    # a wall at two places: one hit low and high, one low only; and two points on the ground
    points = np.array(
        [[10.0, 0.1, -1.8], [10.0, 0.1, 0.0], [20.0, 0.1, -1.7], [5.0, 1.0, -2.0], [3.0, 4.0, -1.0]]
    )
    is_ground = np.array([False, False, False, True, True])
    removal = measure_ground_removal([(points, is_ground)], -1.5, np.array([-3.0, -1.75, 1.0]))
    assert removal.n_sweeps == 1
    np.testing.assert_allclose(removal.ground_removed, [0.0, 0.5, 1.0])
    np.testing.assert_allclose(removal.objects_removed, [0.0, 1 / 3, 1.0])
    assert removal.at_threshold == pytest.approx((0.5, 2 / 3, 0.5))
    np.testing.assert_allclose(removal.ground_range_m, [np.hypot(5.0, 1.0), 5.0])


def test_without_labels_nothing_is_known():
    removal = measure_ground_removal([], -1.5, np.array([-2.0, -1.0]))
    assert removal.n_sweeps == 0 and len(removal.ground_range_m) == 0
    assert np.isnan([*removal.ground_removed, *removal.objects_removed, *removal.at_threshold]).all()


def test_sweeps_are_read_evenly_in_the_radar_frame(monkeypatch, tmp_path):
    assert list(read_labelled_sweeps(tmp_path, 64.0)) == []
    read = []

    def label_sweep(folder, sensor, stamp):
        read.append((sensor, stamp))
        return np.array([[3.0, 0.0, 0.0, 7.0], [200.0, 0.0, 0.0, 7.0]], np.float32), np.array(
            [1, 2], np.uint8
        )

    monkeypatch.setattr(ground_labels, "list_labels", lambda folder, sensor: np.arange(5))
    monkeypatch.setattr(ground_labels, "label_sweep", label_sweep)
    monkeypatch.setattr(ground_labels, "GROUND_MATERIALS", (1,))
    sweeps = list(read_labelled_sweeps("session", 64.0, max_sweeps=5))
    assert [stamp for _, stamp in read] == [0, 3, 1, 4] and len({sensor for sensor, _ in read}) == 2
    points, is_ground = sweeps[0]
    assert points.shape == (1, 4) and is_ground.tolist() == [True]  # the second point is too far away
    assert points[0, 0] == pytest.approx(-3.0 + 0.117, abs=0.05)  # the lidars are mounted facing backwards
