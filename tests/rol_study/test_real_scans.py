"""Real scans on a map and beside sweeps in fog: chance, thresholds, pairs; all on small made-up scans."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial import cKDTree

from rol_data.rall import RealScan
from rol_study import real_scans

WALL = np.column_stack([np.linspace(-20.0, 20.0, 200), np.full(200, 8.0)])


def make_scan(stamp_us: int = 1) -> RealScan:
    """A scan with one strong target ahead and to the left."""
    power = np.zeros((400, 3768), dtype=np.uint8)
    power[350, 300] = 120
    azimuths = -2.0 * np.pi * np.arange(400) / 400
    return RealScan(Path("scan.png"), stamp_us, power, azimuths, np.zeros(3), (4.0, 0.0, 0.5))


def make_network(**points: object) -> SimpleNamespace:
    """What `evaluate_front_ends` reads of a network."""
    return SimpleNamespace(
        points={"threshold": 128, "thin": True, **points}, generator=SimpleNamespace(tta_rotations=4)
    )


def generate(network, power, azimuths, twist=None, tta_rotations=4):
    """A front end with as many points as headings, on the wall."""
    image = np.zeros((512, 512), dtype=np.uint8)
    image[200:203, 220:260] = 200
    return WALL[:tta_rotations], image, image


def test_by_chance_are_the_points_at_wrong_headings() -> None:
    found = real_scans.evaluate_with_chance(WALL, np.zeros(3), cKDTree(WALL))
    assert found["n"] == 200 and found["share_1m"] == found["share_2m"] == 1.0
    assert found["chance_1m"] < found["chance_2m"] < 0.1


def test_every_front_end_of_every_scan_is_a_row() -> None:
    networks = {"paper": make_network(), "unet": make_network()}
    scans = [make_scan(1), make_scan(2)]
    table, results = real_scans.evaluate_front_ends(scans, networks, "unet", cKDTree(WALL), generate)
    fronts = ["raw", "cfar", "paper", "unet", "unet, not thinned", "unet, one heading"]
    assert table["points"].tolist() == fronts * 2 and table.timestamp_us.tolist() == [1] * 6 + [2] * 6
    counts = table.set_index("points").n
    assert (
        (counts["unet"] == 4).all()
        and (counts["unet, one heading"] == 1).all()
        and (counts["raw"] == 1).all()
    )
    assert len(results) == 2 and results[0][0] is not None
    empty, none = real_scans.evaluate_front_ends([], networks, "unet", cKDTree(WALL), generate)
    assert none == [] and list(empty.columns) == list(table.columns)


def test_higher_thresholds_keep_fewer_points() -> None:
    image = np.zeros((512, 512), dtype=np.uint8)
    image[180, 200:300] = np.linspace(100, 250, 100).astype(np.uint8)
    table = real_scans.evaluate_thresholds(
        [image], [make_scan()], cKDTree(WALL), {"threshold": 1, "thin": False}, [100, 175, 251]
    )
    assert table.level.tolist() == [100, 175, 251]
    assert table.n.tolist() == [100, 50, 0]


def test_pairs_are_compared_within_the_reach_in_both_directions() -> None:
    sweep = np.array([[10.0, 0.0], [10.0, 5.0], [40.0, 0.0]])
    points = {"raw": np.array([[10.5, 0.0], [10.0, 1.5], [40.0, 0.0], [15.0, -9.0]])}
    [row] = real_scans.evaluate_pairs([points], [sweep], 20.0).to_dict("records")
    assert row["points"] == "raw" and row["n"] == 3  # the one at 40 m is out of reach
    assert row["share_1m"] == pytest.approx(1 / 3) and row["share_2m"] == pytest.approx(2 / 3)
    assert row["reached_1m"] == 0.5


def test_precision_is_averaged_and_named() -> None:
    networks = {"unet": make_network()}
    table, _ = real_scans.evaluate_front_ends(
        [make_scan(1), make_scan(2)], networks, "unet", cKDTree(WALL), generate
    )
    means = real_scans.tabulate_precision(table)
    assert means.loc["unet", ["within 1 m", "worst scan", "fewest"]].tolist() == [100.0, 100.0, 4.0]
    numbers = real_scans.describe_precision(table, "unet")
    assert numbers["near_1m"] == 100.0 and numbers["raw_1m"] == means.loc["raw", "within 1 m"]
    assert np.isnan(list(real_scans.describe_precision(table[:0], "unet").values())).all()
    empty, _ = real_scans.evaluate_front_ends([], networks, "unet", cKDTree(WALL), generate)
    assert np.isnan(list(real_scans.describe_precision(empty, "unet").values())).all()


def test_fog_and_adaptation_are_named() -> None:
    points = {"raw": np.array([[10.5, 0.0]]), "unet": np.array([[13.0, 0.0]])}
    table = real_scans.evaluate_pairs([points], [np.array([[10.0, 0.0]])], 20.0)
    assert real_scans.describe_fog(table, "unet") == {"fog_1m": 0.0, "fog_raw_1m": 100.0}
    assert real_scans.tabulate_fog(table)["recall, 1 m"].tolist() == [100.0, 0.0]
    empty = real_scans.evaluate_pairs([], [], 20.0)
    assert np.isnan(list(real_scans.describe_fog(empty, "unet").values())).all()
    curve = pd.DataFrame({"level": [10, 20], "n": [5, 2], "share_1m": [0.5, 1.0], "share_2m": [1.0, 1.0]})
    numbers = real_scans.describe_adaptation({"before": curve}, 20)
    assert (numbers["before_1m"], numbers["before_n"]) == (100.0, 2) and np.isnan(numbers["adapted_1m"])
