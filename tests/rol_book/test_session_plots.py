"""Figures of a turn, of frames, of times and of drifts: what is drawn is where it belongs."""

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes

from rol.geometry import exp
from rol.oxford import EXTRINSICS
from rol.radar import azimuth_times
from rol_book import runtime_plots, session_plots
from rol_book.simulator_plots import format_value


@pytest.fixture
def ax() -> Axes:
    figure, ax = plt.subplots()
    yield ax
    plt.close(figure)


def test_beams_start_where_the_radar_is(ax: Axes) -> None:
    azimuths, seconds = -2.0 * np.pi * np.arange(400) / 400, azimuth_times(400)
    beams = session_plots.draw_turn(ax, exp((8.0, 0.0, 0.0), seconds), azimuths, seconds, range_m=6.0)
    first, last = beams.get_segments()[0], beams.get_segments()[-1]
    np.testing.assert_allclose(first, [(0.0, -1.0), (0.0, 5.0)], atol=1e-9)  # y, x: straight ahead
    assert last[0, 1] == pytest.approx(0.96) and beams.get_array()[0] == pytest.approx(-125.0)


def test_displacement_is_shown_at_each_azimuth(ax: Axes) -> None:
    azimuths, seconds = -2.0 * np.pi * np.arange(400) / 400, azimuth_times(400)
    session_plots.draw_displacement(ax, exp((8.0, 0.0, 0.0), seconds), azimuths)
    clockwise, forward = ax.lines[0].get_data()
    assert np.interp(180.0, clockwise, forward) == pytest.approx(0.0, abs=1e-9)
    assert forward[0] == pytest.approx(-1.0) and not ax.lines[1].get_ydata().any()


def test_frames_carry_their_names_and_heights(ax: Axes) -> None:
    session_plots.draw_mounting(ax, EXTRINSICS)
    words = {text.get_text() for text in ax.texts}
    assert {"vehicle", "radar\nz = 0.54 m", "lidar, left\nz = 0.27 m"} <= words
    session_plots.draw_map_frames(
        ax, np.array([[0.0, 0.0, 0.0], [10.0, 5.0, 0.4]]), np.array([10.0, 5.0, 0.4])
    )
    assert {"map", "radar", "T_map_radar"} <= {text.get_text() for text in ax.texts}


def test_drifts_are_in_the_rows_of_their_names() -> None:
    columns = [
        f"drift [%], {case}{end}"
        for case in ("as read", "corrected")
        for end in ("", ", lowest", ", highest")
    ]
    ways = pd.DataFrame([[2.0, 1.5, 2.5, 0.5, 0.4, 0.6], [0.1, 0.1, 0.1, *[np.nan] * 3]], ["a", "b"], columns)
    ways["step [ms]"] = [1.0, 4.0]
    figure, axes = plt.subplots(1, 2)
    runtime_plots.draw_drift(axes, ways, {"a": "red"})
    assert [tick.get_text() for tick in axes[0].get_yticklabels()] == ["a", "b"]
    bars = {bar.get_y() + bar.get_height() / 2.0: bar.get_width() for bar in axes[1].patches}
    assert bars == {1.0: 1.0, 0.0: 4.0}
    plt.close(figure)


@pytest.mark.parametrize(
    ("value", "text"), [(np.nan, "–"), (0.0, "0"), (21051.4, "21,051"), (0.02451, "0.0245"), (99.39, "99.4")]
)
def test_numbers_have_three_digits_and_no_exponent(value: float, text: str) -> None:
    assert format_value(value) == text
