"""Comparison of variants at equal recall on made-up curves, and the stored tables."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rol_study import translator_variants as variants

DATA = Path(__file__).resolve().parents[2] / "data"


def make_rows(network: str, places: str, precision: float) -> pd.DataFrame:
    """Three thresholds: recall falls as the precision grows."""
    return pd.DataFrame(
        {
            "network": network,
            "places": places,
            "threshold": [64, 128, 192],
            "n_fake": [900.0, 600.0, 300.0],
            "fake_to_real_within_1m": precision + np.array([0.0, 0.1, 0.2]),
            "fake_to_real_within_2m": precision + np.array([0.1, 0.2, 0.3]),
            "real_to_fake_within_1m": [0.9, 0.7, 0.5] if places != "real" else np.nan,
        }
    )


@pytest.fixture
def path(tmp_path: Path) -> Path:
    rows = [make_rows("ablation-base", "town", 0.4), make_rows("ablation-base", "route", 0.6)]
    rows += [make_rows("ablation-base", "real", 0.3), make_rows("ablation-seed-2", "town", 0.52)]
    rows += [make_rows("ablation-seed-2", "real", 0.29), make_rows("paper-as-printed", "town", 0.1)]
    path = tmp_path / "translator.csv"
    pd.concat(rows).to_csv(path, index=False)
    return path


def test_a_value_between_thresholds_is_interpolated_and_beyond_them_unknown() -> None:
    curve = make_rows("base", "town", 0.5)
    assert variants.value_at(curve, "real_to_fake_within_1m", 0.6, "n_fake") == pytest.approx(450.0)
    assert np.isnan(variants.value_at(curve, "real_to_fake_within_1m", 0.95, "n_fake"))


def test_variants_are_compared_at_equal_recall_and_number_of_points(path: Path) -> None:
    curves, printed = variants.load_variants(path)
    assert list(curves["simulated"]) == ["base", "seed-2"] and printed.network.unique() == [
        "paper-as-printed"
    ]
    table = variants.compare_variants(curves, {"simulated": 0.7, "real": 600.0})
    assert table.loc["base", "simulated_1m"] == pytest.approx(60.0)  # mean of the places 50 and 70
    assert table.loc["seed-2", "simulated_1m"] == pytest.approx(62.0)
    assert table.loc["base", "real_2m"] == pytest.approx(50.0)
    assert variants.seed_noise(table)["simulated_1m"] == pytest.approx(2.0)
    assert variants.seed_noise(table)["real_1m"] == pytest.approx(1.0)


def test_gain_of_headings_is_in_percentage_points() -> None:
    judged = pd.concat([make_rows("unet", "town", 0.5), make_rows("unet", "real", 0.5)]).to_dict("list")
    one = pd.concat([make_rows("unet", "town", 0.48), make_rows("unet", "real", 0.51)]).to_dict("list")
    card = {"judged": judged, "judged_one_heading": one}
    gain = variants.gain_of_headings(card, {"simulated": 0.6, "real": 500.0})
    assert gain["simulated"] == pytest.approx(2.0) and gain["real"] == pytest.approx(-1.0)


def test_cards_are_summarized_at_their_own_threshold() -> None:
    cards = variants.load_cards(DATA / "weights", ["unet", "paper"])
    summary = variants.summarize_card(cards["unet"])
    assert summary["threshold"] == 160 and summary["headings"] == 4 and summary["steps"] == 3000
    assert (
        70.0 < summary["recall_1m"] < 75.0 and summary["precision_1m"] > 85.0
    )  # as the threshold was chosen
    assert variants.summarize_card(cards["paper"])["precision_1m"] < summary["precision_1m"]


def test_a_tuned_network_is_compared_at_the_recall_before() -> None:
    levels = {"threshold": [128, 160, 192], "n_points": [900, 600, 300], "recall_1m": [0.9, 0.7, 0.5]}
    before = pd.DataFrame({**levels, "precision_1m": [0.5, 0.6, 0.7], "seed": 0, "steps": 0})
    after = pd.DataFrame({**levels, "precision_1m": [0.6, 0.7, 0.8], "seed": 1, "steps": 50})
    after["recall_1m"] -= 0.1
    table = pd.concat([before, after]).assign(source="fog", n_scans=18)
    found = variants.compare_tuned(table, 160, ["fog"]).set_index("steps")
    assert found.loc[0, "equal_1m"] == pytest.approx(60.0)
    assert found.loc[50, "precision_1m"] == pytest.approx(70.0)
    assert found.loc[50, "equal_1m"] == pytest.approx(65.0)
