"""Figures of localization draw what they are given."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from rol.evaluation import pose_errors
from rol_book import localization_plots as figures
from rol_book import plots

TRUTH = np.zeros((4, 3))
ESTIMATE = np.array([[0.5, 0, 0.01], [0, 1.5, -0.02], [3.0, 0, 0.03], [0, 30.0, 0.2]])
ERRORS = pose_errors(ESTIMATE, TRUTH)


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def test_cdf_ends_at_all_scans_and_each_session_has_a_line() -> None:
    figure = figures.draw_error_cdfs({"paper": [ERRORS, ERRORS]}, {"seq01": np.array([30.0, 60.0, 75.0])})
    lines = figure.axes[0].lines
    curves, circles = [line for line in lines if line.get_marker() == "None"], lines[-1]
    assert [len(line.get_xdata()) for line in curves] == [4, 4, 8]
    assert all(line.get_ydata()[-1] == 100.0 for line in curves)
    np.testing.assert_allclose(curves[0].get_xdata(), [0.5, 1.5, 3.0, 30.0])
    np.testing.assert_allclose(circles.get_xdata(), [1.0, 2.0, 5.0])
    np.testing.assert_allclose(figure.axes[1].lines[-1].get_xdata(), [2.0, 5.0, 10.0])
    assert curves[0].get_color() == plots.METHOD_COLOURS["paper"]


def test_errors_beyond_the_histogram_are_in_its_last_bin() -> None:
    _, axes = plots.subplots(1, 3)
    figures.draw_result_row(axes, TRUTH, ESTIMATE, ERRORS, "#123456", limits=(2.5, 3.0))
    heights = [bar.get_height() for bar in axes[1].patches]
    assert sum(heights) == pytest.approx(100.0) and heights[-1] == pytest.approx(50.0)
    assert [bar.get_height() for bar in axes[2].patches][-1] == pytest.approx(25.0)


def test_a_failure_is_a_cross() -> None:
    cloud = np.array([[1.0, 2.0]])
    figure = figures.draw_trajectory(np.zeros((3, 2)), ESTIMATE, ERRORS.position_m, [1], cloud, "#000000")
    cross = figure.axes[0].lines[0]
    assert (cross.get_xdata()[0], cross.get_ydata()[0]) == (1.5, 0.0)


def test_a_scan_lies_at_its_pose_on_the_map_around_it() -> None:
    ax, map_points = plots.subplots()[1], np.array([[0.0, 3.0], [0.0, 90.0]])
    plots.draw_scan(ax, map_points, np.array([0.0, 3.0, np.pi / 2]), {"a": np.array([[1.0, 0.0]])}, 10.0)
    on_map, cloud = (dots.get_offsets().tolist() for dots in ax.collections[:2])
    assert on_map == [[3.0, 0.0]] and ax.get_legend() is None
    np.testing.assert_allclose(cloud, [[4.0, 0.0]], atol=1e-9)
    assert ax.get_xlim() == (13.0, -7.0)


def test_registration_has_a_panel_for_each_pose() -> None:
    source = np.array([[1.0, 2.0]])
    figure = figures.draw_registration(
        source, source, {"a": np.zeros(3), "b": np.array([1.0, 0, 0])}, "#000000"
    )
    moved = [ax.collections[1].get_offsets()[0].tolist() for ax in figure.axes]
    assert moved == [[2.0, 1.0], [2.0, 2.0]]  # y to the left is the horizontal axis
