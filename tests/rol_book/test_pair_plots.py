"""Tables of real pairs as text, and figures that hold what they are given."""

from collections.abc import Iterator
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from scipy.spatial import cKDTree

from rol_book import pair_plots, plots, real_plots


@pytest.fixture(autouse=True)
def close_figures() -> Iterator[None]:
    yield
    plt.close("all")


def test_means_are_joined_with_their_spread() -> None:
    joined = pair_plots.join_spread(pd.Series([-0.884, 4.06, 16.4]), pd.Series([0.19, 0.69, np.nan]), 2)
    assert joined.tolist() == ["−0.88 ± 0.19", "4.06 ± 0.69", "16.40"]


def test_misalignment_is_a_row_per_motion_and_reference() -> None:
    rows = [("none", "nearest", 8.0, -0.8, 0.0), ("none", "nearest", 4.0, -0.6, 0.2)]
    columns = ["motion", "sweeps", "speed_mps", "forward_m", "left_m"]
    table = pair_plots.format_misalignment(pd.DataFrame(rows, columns=columns))
    assert table.iloc[0].tolist() == ["as recorded", "nearest", "−0.70 ± 0.14", "0.10 ± 0.14", "−0.12"]


def test_the_papers_numbers_stand_above_ours() -> None:
    means = {"precision_1m": 59.4, "precision_2m": 75.0, "recall_1m": 66.0}
    spreads = {f"{name}_sd": 5.0 for name in means}
    comparison = SimpleNamespace(
        rows=pd.DataFrame({"front_end": ["cfar"], "n_points": [1200]}),
        average=lambda way: pd.DataFrame({**means, **spreads}, index=["cfar"]),
    )
    table = pair_plots.format_comparison(comparison, {("none", "nearest"): "one", ("x", "turn"): "all"})
    assert table.loc["reported", ("one", "1 m")] == "> 40" and table.loc["reported", ("all", "1 m")] == "–"
    assert table.loc["cfar", [("one", "1 m"), ("", "points")]].tolist() == ["59 ± 5", "1200"]


def test_every_case_is_a_row_of_five_panels() -> None:
    image = np.zeros((512, 512), dtype=np.uint8)
    points = np.array([[10.0, 0.0], [12.0, 3.0]])
    pair = SimpleNamespace(radar_image=image, lidar_image=image, lidar_points=points)
    figure = pair_plots.draw_cases([(pair, image, points), (pair, image, points + 0.5)])
    assert len(figure.axes) == 10 and figure.get_figwidth() == plots.WIDTH
    titles = [ax.get_title(loc="left") or ax.get_title() for ax in figure.axes[:5]]
    assert titles == ["real radar", "generated", "real lidar", "overlay", "points [%]"]


def test_curves_end_at_the_fraction_of_near_points() -> None:
    distances = {"one": {"cfar": np.array([0.5, 4.0, 9.0, 9.0])}, "none": {}}
    left, right = pair_plots.draw_distance_curves(distances).axes
    assert left.lines[0].get_ydata()[-1] == 50.0
    assert left.lines[0].get_color() == plots.FRONT_END_COLOURS["cfar"]
    assert len(right.lines) == 1  # the stars alone


def test_the_story_has_a_panel_for_each_image_and_the_map() -> None:
    image = np.zeros((512, 512), dtype=np.uint8)
    points = np.array([[10.0, 0.0], [100.0, 3.0]])
    figure = real_plots.draw_story({"real radar": image, "generated": image}, points, points, "overlay")
    assert len(figure.axes) == 3
    drawn = [collection.get_offsets() for collection in figure.axes[-1].collections[:2]]
    assert [len(part) for part in drawn] == [1, 1]  # what lies outside the square is not drawn


def test_points_are_coloured_by_their_distance_to_the_map() -> None:
    wall = np.column_stack([np.arange(-20.0, 20.0, 0.5), np.full(80, 8.0)])
    placed = [np.array([[0.0, 8.0], [1.0, 8.5], [0.0, 4.0]])]
    figure = real_plots.draw_scans_on_map(placed, np.zeros((1, 3)), ["0.0 s"], wall, cKDTree(wall))
    near, far = figure.axes[0].collections[1:3]
    assert (len(near.get_offsets()), len(far.get_offsets())) == (2, 1)
