"""Consistency of covariances with the errors (NEES)."""

from __future__ import annotations

import numpy as np

from rol.evaluation import EvaluationError, check_pair
from rol.geometry import wrap_angle

NEES_95 = 7.814727903251179  # 95 % quantile of the chi-square distribution with three degrees of freedom


def pose_nees(estimate: np.ndarray, truth: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Compute the normalized estimation error squared (NEES) of poses.

    Parameters
    ----------
    estimate, truth : array, shape (n, 3)
        Poses T_map_radar [m, m, rad].
    covariances : array, shape (n, 3, 3)
        Covariances of (x, y, yaw) in the map frame, of each estimate [m, m, rad].

    Returns
    -------
    nees : array, shape (n,)
        e' C^-1 e with e = estimate - truth, its heading in [-pi, pi). The mean is 3 for consistent
        covariances.

    Raises
    ------
    EvaluationError
        If lengths differ, or a covariance is not finite, symmetric and positive definite; names its index.
    """
    estimate, truth = check_pair(estimate, truth)
    covariances = _check_covariances(covariances, len(estimate))
    errors = estimate - truth
    errors[:, 2] = wrap_angle(errors[:, 2])
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


def consistency(estimate: np.ndarray, truth: np.ndarray, covariances: np.ndarray) -> dict[str, float]:
    """Evaluate the consistency of covariances with the errors.

    Parameters
    ----------
    estimate, truth, covariances
        As in `pose_nees`.

    Returns
    -------
    figures : dict
        ``mean_nees``, 3 for a consistent filter and larger for an overconfident one, and ``within_95``, the
        fraction of poses with a NEES below ``NEES_95`` (0..1).

    Raises
    ------
    EvaluationError
        As in `pose_nees`.
    """
    nees = pose_nees(estimate, truth, covariances)
    return {"mean_nees": float(np.mean(nees)), "within_95": float(np.mean(nees <= NEES_95))}


def _check_covariances(covariances: np.ndarray, n: int) -> np.ndarray:
    """Check that there are n covariances, finite, symmetric and positive definite."""
    covariances = np.asarray(covariances, dtype=np.float64)
    if covariances.shape != (n, 3, 3):
        raise EvaluationError(f"covariances: expected shape ({n}, 3, 3), got {covariances.shape}")
    checks = {
        "finite": lambda c: np.isfinite(c).all(axis=(1, 2)),
        "symmetric": lambda c: np.isclose(c, c.transpose(0, 2, 1), rtol=1e-6, atol=1e-12).all(axis=(1, 2)),
        "positive definite": lambda c: np.linalg.eigvalsh(c) @ (1.0, 0.0, -1e-15) > 0.0,  # beyond rounding
    }
    for quality, check in checks.items():
        is_good = check(covariances)
        if not is_good.all():
            raise EvaluationError(f"covariances: matrix at index {int(np.argmin(is_good))} is not {quality}")
    return covariances
