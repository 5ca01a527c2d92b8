"""What the figures of the real route show."""

from types import SimpleNamespace

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from rol_book import plots, route_plots


@pytest.fixture(autouse=True)
def closed_figures() -> None:
    yield
    plt.close("all")


def test_qualities_with_fewer_runs_have_open_markers() -> None:
    runs = pd.DataFrame(
        {
            "method": ["paper", "paper", "robust", "robust"],
            "fraction_1m": [0.3, 0.5] * 2,
            "is_complete": [False, True] * 2,
            "rmse_m": [20.0, 0.2, 5.0, 0.1],
            "within_1m_2deg": [0.3, 0.9, 0.5, 1.0],
            "failures": [9, 0, 2, 0],
        }
    )
    printed = {"rmse_m": [7.0, 14.0], "within_1m_2deg": [0.1, 0.3], "failures": [0, 2]}
    figure = route_plots.draw_quality(runs, printed, (0.44, 0.50))
    _, full, few = figure.axes[0].lines[:3]
    assert np.isfinite(full.get_ydata()).tolist() == [False, True] and full.get_linestyle() == "-"
    assert np.isfinite(few.get_ydata()).tolist() == [True, False]
    assert few.get_markerfacecolor() == "white" and full.get_color() == plots.METHOD_COLOURS["paper"]
    assert figure.axes[1].lines[1].get_ydata()[1] == pytest.approx(90.0)


def test_panels_fill_equal_parts_of_the_width() -> None:
    figure, axes = route_plots.split_figure(3, 3.0)
    figure.canvas.draw()
    centres = [ax.get_window_extent().x0 / figure.bbox.width for ax in axes]
    assert figure.get_figwidth() == plots.WIDTH and [int(3 * centre) for centre in centres] == [0, 1, 2]


def test_errors_are_root_mean_squares() -> None:
    n = 200
    figure = route_plots.draw_errors(
        np.arange(n) / 240, np.full((n, 2), 2.0), np.full((n, 2), 3.0), np.zeros(n, dtype=bool)
    )
    error, deviation = figure.axes[0].lines
    np.testing.assert_allclose(error.get_ydata(), 2.0)
    np.testing.assert_allclose(deviation.get_ydata(), 3.0)
    assert error.get_color() == plots.METHOD_COLOURS["robust"]


def test_trials_never_found_keep_the_curve_below_all() -> None:
    figure = route_plots.draw_found({"a": pd.DataFrame({"found_s": [1.0, np.inf]})}, {"a": 10.0})
    x, y = figure.axes[0].lines[0].get_data()
    assert y[np.asarray(x) <= 10.0].max() == 50.0 and figure.axes[0].get_xlim() == (0.0, 10.0)


def test_frames_of_a_recovery_are_placed_at_the_estimate() -> None:
    pose = np.array([10.0, 0.0, np.pi / 2])
    update = SimpleNamespace(filter=SimpleNamespace(pose=pose, particles=np.zeros((3, 3))), is_lost=True)
    (frame,) = route_plots.recovery_frames([update], [np.array([[1.0, 0.0]])], np.zeros((5, 3)))
    np.testing.assert_allclose(frame.cloud, [[10.0, 1.0]], atol=1e-12)
    assert frame.text == "0.0 s, lost, 10.0 m off"
