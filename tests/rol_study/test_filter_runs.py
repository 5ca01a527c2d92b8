"""Runs over a session: both filters, registration alone, failures."""

import numpy as np
import pytest

from rol.evaluation import FailureMonitor, FailureRule, pose_errors
from rol.geometry import accumulate_increments, compose, invert, relative_pose, transform_points
from rol.mcl import ParticleFilter, localize
from rol_beyond.recovery import RecoveringFilter, RecoverySettings
from rol_beyond.robust import settings_for
from rol_beyond.scan_matching import ScanToMapSettings
from rol_study.filter_runs import DIAGNOSTICS, FilterRun, find_failures, run_filter, run_registration

N = 40
STAMPS_US = np.arange(N, dtype=np.int64) * 250_000
TRUTH = accumulate_increments(np.tile([1.0, 0.0, 0.01], (N - 1, 1)), (0.0, 0.0, 0.0))
WRONG = relative_pose(TRUTH[:-1], TRUTH[1:]) + (-0.03, 0.0, 0.002)
EMPTY = [np.zeros((0, 2))] * N


@pytest.fixture(scope="module")
def posts() -> np.ndarray:
    """Posts around the path."""
    return np.random.default_rng(5).uniform((-40.0, -30.0), (80.0, 30.0), (300, 2))


@pytest.fixture(scope="module")
def clouds(posts: np.ndarray) -> list[np.ndarray]:
    """All posts in the frame of each scan, with noise."""
    rng = np.random.default_rng(6)
    return [
        transform_points(invert(pose), posts) + 0.05 * rng.standard_normal((len(posts), 2)) for pose in TRUTH
    ]


def watch(rule: FailureRule | None = None) -> FailureMonitor:
    return FailureMonitor(STAMPS_US, TRUTH, rule or FailureRule())


def filter_of(method: str, posts: np.ndarray) -> ParticleFilter | RecoveringFilter:
    """The filter of a method at the first true pose."""
    settings, rng = settings_for(method, n_particles=200, cell_m=0.25), np.random.default_rng(1)
    if method == "robust":
        return RecoveringFilter(posts, TRUTH[0], settings, RecoverySettings(0.2), rng)
    return ParticleFilter(settings.measurement.build_grid(posts), TRUTH[0], settings, rng)


def position_errors(run: FilterRun) -> np.ndarray:
    return pose_errors(run.poses, TRUTH).position_m


@pytest.mark.parametrize("method", ["paper", "robust"])
def test_a_run_is_the_filters_own_updates(method: str, posts: np.ndarray, clouds: list[np.ndarray]) -> None:
    particles: list[np.ndarray] = []
    run = run_filter(filter_of(method, posts), WRONG, clouds, watch(), particles)
    updates = list(localize(filter_of(method, posts), WRONG, clouds, watch()))
    mcl = [getattr(update, "filter", update) for update in updates]
    np.testing.assert_array_equal(run.poses, [update.pose for update in updates])
    np.testing.assert_array_equal(run.covariances, [update.covariance for update in updates])
    for name in DIAGNOSTICS:
        np.testing.assert_array_equal(run.diagnostics[name], [getattr(update, name) for update in mcl])
    for kept, update in zip(particles, mcl, strict=True):
        np.testing.assert_array_equal(kept, update.particles)
    expected = [getattr(u, "n_particles", len(m.particles)) for u, m in zip(updates, mcl, strict=True)]
    assert run.n_particles.tolist() == expected
    assert run.is_lost.tolist() == [getattr(update, "is_lost", False) for update in updates]
    assert position_errors(run).max() < 0.5 and run.failures == [] and (run.update_ms > 0.0).all()
    metrics = run.summarize(TRUTH, method, "town", 4)
    assert (metrics["n_scans"], metrics["failures"], metrics["seed"]) == (N, 0, 4)


def test_the_papers_filter_is_bounded_by_the_resets_of_its_evaluation(posts: np.ndarray) -> None:
    away = np.tile((5.0, 0.0, 0.0), (N - 1, 1))  # the vehicle drives 1 m
    for rule, is_bounded in ((FailureRule(10.0, seconds=1.0), True), (FailureRule(np.inf), False)):
        run = run_filter(filter_of("paper", posts), away, EMPTY, watch(rule))
        assert (position_errors(run).max() < 10.0 + 7 * 4.0) == is_bounded
        assert (len(run.failures) >= 4) == is_bounded


def test_without_a_monitor_failures_are_found_afterwards(posts: np.ndarray) -> None:
    run, rule = run_filter(filter_of("paper", posts), WRONG * 0.0, EMPTY), FailureRule(3.0, seconds=2.5)
    assert run.failures == [] and position_errors(run).max() > 30.0
    assert find_failures(STAMPS_US, run.poses, TRUTH, rule)[:3] == [14, 25, 36]  # it lasts, and counts again


def test_registration_alone_follows_good_points(posts: np.ndarray, clouds: list[np.ndarray]) -> None:
    run = run_registration(WRONG, clouds, posts, watch())
    errors = pose_errors(run.poses, TRUTH)
    assert errors.position_m.max() < 0.05 and np.abs(errors.yaw_rad).max() < 0.002
    assert not run.is_lost.any() and not run.failures and run.update_ms.shape == (N,)
    near = [cloud[np.hypot(*cloud.T) < 20.0] for cloud in clouds]
    seen = run_registration(WRONG, near, posts, watch(), ScanToMapSettings(range_m=25.0))
    assert position_errors(seen).max() < 0.2


def test_a_rejected_registration_leaves_the_guess(posts: np.ndarray, clouds: list[np.ndarray]) -> None:
    run = run_registration(WRONG, [clouds[0], *EMPTY[1:]], posts, watch(FailureRule(np.inf)))
    assert run.is_lost.tolist() == [False] + [True] * (N - 1)
    pose = run.poses[0]
    for k in range(1, N):
        pose = compose(pose, WRONG[k - 1])
        np.testing.assert_allclose(run.poses[k], pose, atol=1e-9)
    assert position_errors(run)[0] < 0.05
    strict = ScanToMapSettings(min_inlier_ratio=1.0)  # the trim leaves 90 %
    assert run_registration(WRONG, clouds, posts, watch(), strict).is_lost.all()


def test_registration_is_reset_to_the_truth_after_a_failure(posts: np.ndarray) -> None:
    run = run_registration(0.5 * WRONG, EMPTY, posts, watch(FailureRule(3.0, seconds=1.0)))
    errors = position_errors(run)
    assert len(run.failures) >= 2
    for k in run.failures:
        assert errors[k] > 3.0 and (k == N - 1 or errors[k + 1] < 1.0)
