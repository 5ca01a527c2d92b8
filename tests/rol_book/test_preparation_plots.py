"""Figures of chapters 2, 3, 4 and 6: what they show is what they are given."""

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest

from rol_book import preparation_plots as draw


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def offsets(ax):
    """Points of each scatter of a panel, as (y, x) on paper."""
    return [np.asarray(part.get_offsets()) for part in ax.collections]


def test_timeline_has_a_bar_for_each_sweep():
    spans = {"none": {"left": (-30.0, 20.0), "right": (-10.0, 40.0)}, "corrected": {"left": (100.0, 150.0)}}
    ax = draw.draw_timeline(plt.subplots()[1], (0.0, 250.0), spans)
    bars = [(bar.get_x(), bar.get_width(), bar.get_y() + bar.get_height() / 2) for bar in ax.patches]
    assert bars == [(-30.0, 50.0, 1.0), (-10.0, 50.0, 2.0), (100.0, 50.0, 1.0)]
    assert [text.get_text() for text in ax.get_yticklabels()] == ["radar scan", "left lidar", "right lidar"]
    assert [text.get_text() for text in ax.get_legend().get_texts()] == [
        "not compensated",
        "motion-compensated",
    ]


def test_registration_moves_the_maps_and_enlarges_the_square_only():
    points = np.array([[0.0, 0.0], [10.0, 5.0], [90.0, 0.0]])
    axes = plt.subplots(2, 2)[1]
    draw.draw_registration(axes, {"a": points}, {"a": np.array([1.0, 2.0, 0.0])}, np.zeros(2))
    np.testing.assert_allclose(offsets(axes[0, 0])[0], points[:, ::-1])
    np.testing.assert_allclose(offsets(axes[0, 1])[0], (points + [1.0, 2.0])[:, ::-1])
    np.testing.assert_allclose(offsets(axes[1, 1])[0], (points + [1.0, 2.0])[:2, ::-1])


def test_residuals_are_drawn_as_a_running_median_that_skips_empty_scans():
    residuals = np.array([0.1, np.nan, 0.3, 9.0, 0.2, 0.1, 0.1, 0.1, 0.1, 0.1])
    _, axes = plt.subplots(1, 1, squeeze=False, layout="constrained")
    draw.draw_along(axes[:, 0], {"a": (np.arange(10.0), np.arange(12.0))}, {"a": residuals}, {})
    [line] = axes[0, 0].lines
    expected = [np.nanmedian(residuals[max(i - 4, 0) : i + 5]) for i in range(10)]
    np.testing.assert_allclose(line.get_ydata(), expected)
    assert expected[3] == pytest.approx(0.1) and line.get_label() == "a"


def test_round_trip_shows_where_most_points_are():
    back = np.concatenate([np.full((3, 2), [30.0, -12.0]), [[0.0, 0.0]]])
    ax = draw.draw_round_trip(plt.subplots()[1], np.zeros((512, 512), np.uint8), back, back, 1.5)
    assert ax.get_ylim() == (28.5, 31.5) and ax.get_xlim() == (-10.5, -13.5)
    draw.draw_round_trip(plt.subplots()[1], np.zeros((512, 512), np.uint8), back[:0], back[:0], 1.5)


def test_removal_is_drawn_in_percent():
    thresholds = np.array([-2.0, -1.0, 0.0])
    removed = {"ground": np.array([0.5, 1.0, 1.0]), "others": np.array([0.0, 0.1, 0.2])}
    ax = draw.draw_removal(plt.subplots()[1], thresholds, removed, -1.5)
    np.testing.assert_allclose([line.get_ydata() for line in ax.lines[:2]], [[50, 100, 100], [0, 10, 20]])


def test_split_marks_each_set_at_its_scans():
    path = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 1.0]])
    parts = {"training": np.array([True, False, False]), "held out": np.array([False, False, True])}
    ax = draw.draw_split(plt.subplots()[1], path, parts)
    first, second = (part for part in offsets(ax) if len(part))
    np.testing.assert_allclose(first, [[0.0, 0.0]])
    np.testing.assert_allclose(second, [[1.0, 2.0]])
