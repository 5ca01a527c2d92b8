"""Similarity: nearest-neighbour distances, shares, and the rules for empty clouds."""

import numpy as np
import pytest

from rol.similarity import distance_histogram, fraction_within, nn_distances, similarity_summary

FAKE = np.array([[0.0, 0.0], [3.0, 0.0], [10.0, 0.0]])
REAL = np.array([[0.0, 0.5], [3.0, 1.5]])


def test_distances_by_hand():
    np.testing.assert_allclose(nn_distances(FAKE, REAL), [0.5, 1.5, np.hypot(7.0, 1.5)])


def test_distances_agree_with_all_pairs():
    rng = np.random.default_rng(5)
    a, b = rng.normal(0, 20, (300, 2)), rng.normal(0, 20, (200, 2))
    slow = np.sqrt(((a[:, None] - b[None]) ** 2).sum(axis=-1)).min(axis=1)
    np.testing.assert_allclose(nn_distances(a, b), slow)


def test_shares_count_below_the_radius():
    distances = np.array([0.5, 1.0, 1.5, np.inf])
    assert fraction_within(distances, 1.0) == 0.25
    assert fraction_within(distances, 2.0) == 0.75
    with pytest.raises(ValueError, match="value 1 is nan"):
        fraction_within(np.array([0.0, np.nan]), 1.0)


def test_histogram_keeps_every_distance():
    counts = distance_histogram(np.array([0.0, 0.4, 1.0, 7.0, np.inf]), np.array([0.0, 0.5, 1.0, 2.0]))
    np.testing.assert_array_equal(counts, [2, 0, 3])
    with pytest.raises(ValueError, match="nan"):
        distance_histogram(np.array([np.nan]), np.array([0.0, 1.0]))


def test_summary_in_both_directions():
    summary = similarity_summary(FAKE, REAL)
    assert (summary["n_fake"], summary["n_real"]) == (3, 2)
    assert summary["fake_to_real_within_1m"] == pytest.approx(1 / 3)
    assert summary["fake_to_real_within_2m"] == pytest.approx(2 / 3)
    assert summary["fake_to_real_median_m"] == 1.5
    assert summary["real_to_fake_within_1m"] == 0.5
    assert summary["real_to_fake_within_2m"] == 1.0


def test_empty_clouds_follow_the_rule():
    empty = np.zeros((0, 2))
    assert nn_distances(empty, REAL).shape == (0,)
    np.testing.assert_array_equal(nn_distances(FAKE, empty), [np.inf] * 3)
    summary = similarity_summary(empty, REAL)
    assert summary["n_fake"] == 0 and np.isnan(summary["fake_to_real_within_1m"])
    assert summary["real_to_fake_within_2m"] == 0.0
    shares = [summary["fake_to_real_within_1m"], 0.5]
    assert np.nanmean(shares) == 0.5  # left out of a mean over scans
    assert np.isnan(similarity_summary(empty, empty)["real_to_fake_median_m"])


def test_refuses_nan_and_wrong_shapes():
    with pytest.raises(ValueError, match="points: point 0 is not finite"):
        nn_distances(np.array([[np.nan, 0.0]]), REAL)
    with pytest.raises(ValueError, match="reference: point 1 is not finite"):
        nn_distances(FAKE, np.array([[0.0, 0.0], [np.inf, 0.0]]))
    with pytest.raises(ValueError, match="expected points of shape"):
        nn_distances(np.zeros((3, 3)), REAL)
