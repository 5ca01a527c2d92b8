"""Consistency of covariances, worked out by hand and drawn."""

import numpy as np
import pytest
from scipy.stats import chi2

from rol.evaluation import EvaluationError
from rol_beyond.consistency import NEES_95, consistency, pose_nees


def test_nees_by_hand():
    truth = np.array([[0.0, 0.0, 3.1], [5.0, 5.0, 0.0]])
    estimate = np.array([[2.0, -1.0, -3.1], [5.0, 5.0, 0.0]])
    # across the cut the heading is off by 2 pi - 6.2; sigmas 1 m, 0.5 m, 0.1 rad: 4 + 4 + its share
    covariances = np.tile(np.diag([1.0, 0.25, 0.01]), (2, 1, 1))
    nees = pose_nees(estimate, truth, covariances)
    np.testing.assert_allclose(nees, [8.0 + (2 * np.pi - 6.2) ** 2 / 0.01, 0.0])
    figures = consistency(estimate, truth, covariances)
    assert figures == {"mean_nees": pytest.approx(nees.mean()), "within_95": 0.5}
    # correlated errors: C = [[2, 1], [1, 2]] has the inverse [[2, -1], [-1, 2]] / 3, so (1, 1) gives 2 / 3
    covariances[0] = [[2.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]
    assert pose_nees(truth[:1] + (1.0, 1.0, 0.0), truth[:1], covariances[:1])[0] == pytest.approx(2.0 / 3.0)


def test_errors_drawn_from_their_covariances_are_consistent_and_smaller_covariances_are_not():
    rng, n = np.random.default_rng(5), 20_000
    root = np.array([[0.5, 0.0, 0.0], [0.2, 0.3, 0.0], [0.01, 0.0, 0.02]])
    covariances = np.tile(root @ root.T, (n, 1, 1))
    truth = np.column_stack([rng.uniform(-90, 90, (n, 2)), rng.uniform(-np.pi, np.pi, n)])
    estimate = truth + rng.normal(size=(n, 3)) @ root.T
    estimate[:, 2] = (estimate[:, 2] + np.pi) % (2 * np.pi) - np.pi
    figures = consistency(estimate, truth, covariances)
    assert figures["mean_nees"] == pytest.approx(3.0, abs=0.1)  # five standard errors
    assert figures["within_95"] == pytest.approx(0.95, abs=0.008)
    assert consistency(estimate, truth, covariances / 4)["mean_nees"] == pytest.approx(
        4 * figures["mean_nees"]
    )


def test_the_bound_of_nees_is_that_of_chi_square():
    assert pytest.approx(chi2.ppf(0.95, 3), rel=1e-12) == NEES_95


@pytest.mark.parametrize(
    ("bad", "fault"),
    [
        ([[1, 0, 0], [0, np.nan, 0], [0, 0, 1]], "matrix at index 1 is not finite"),
        ([[1, 0.5, 0], [0, 1, 0], [0, 0, 1]], "matrix at index 1 is not symmetric"),
        ([[1, 2, 0], [2, 1, 0], [0, 0, 1]], "matrix at index 1 is not positive definite"),
        (np.zeros((3, 3)), "matrix at index 1 is not positive definite"),
        (np.ones((3, 3)), "matrix at index 1 is not positive definite"),
    ],
)
def test_bad_covariances_are_named(bad, fault):
    poses, good = np.zeros((3, 3)), np.eye(3)
    with pytest.raises(EvaluationError, match=f"covariances: {fault}"):
        pose_nees(poses, poses, np.array([good, bad, good]))
    with pytest.raises(EvaluationError, match=r"covariances: expected shape \(3, 3, 3\), got \(2, 3, 3\)"):
        pose_nees(poses, poses, np.array([good, good]))
