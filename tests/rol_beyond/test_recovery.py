"""Failure detection and relocalization: no false alarm on a good track, a report when lost, and recovery."""

from dataclasses import replace

import numpy as np
import pytest
from test_search import look, town

from rol.mcl import MclError, Resampling, localize
from rol_beyond.motion import MotionModel
from rol_beyond.recovery import (
    Hypotheses,
    RecoveringFilter,
    RecoverySettings,
    RelocalizationSettings,
    measure_reference_contrast,
)
from rol_beyond.robust import settings_for

SIGMAS = (0.05, 0.05, 0.004)
MOTION = MotionModel(
    sigma_stationary=SIGMAS, sigma_base=SIGMAS, sigma_per_metre=(0.0,) * 3, outlier_fraction=0.0
)
SETTINGS = settings_for("robust", n_particles=300, min_particles=100, motion=MOTION)
FIELD = SETTINGS.measurement


@pytest.fixture(scope="module")
def drive() -> tuple:
    """A town, the poses of a drive through it, its increments and its clouds."""
    rng = np.random.default_rng(5)
    points = town(rng)
    poses = np.column_stack(
        [np.linspace(-30.0, 30.0, 70), 5.0 * np.sin(np.linspace(0.0, 3.0, 70)), np.zeros(70)]
    )
    clouds = [look(points, pose, 100, rng) for pose in poses]
    return points, poses, np.diff(poses, axis=0), clouds


def run(drive: tuple, start: np.ndarray, **changes: object) -> tuple[np.ndarray, list]:
    points, poses, increments, clouds = drive
    reference = measure_reference_contrast(clouds[::5], poses[::5], FIELD.build_grid(points))
    known, settings = changes.pop("is_start_known", True), changes.pop("settings", SETTINGS)
    recovery = RecoverySettings(reference, relocalization=RelocalizationSettings(far_reach_m=60.0), **changes)
    rng = np.random.default_rng(1)
    robust_filter = RecoveringFilter(points, start, settings, recovery, rng, known)
    updates = list(localize(robust_filter, increments, clouds))
    return np.hypot(*(np.array([u.filter.pose for u in updates]) - poses)[:, :2].T), updates


def test_no_false_alarm_on_a_good_track(drive: tuple) -> None:
    off, updates = run(drive, drive[1][0])
    assert off.max() < 0.5
    assert not any(u.is_lost or u.was_replaced for u in updates[8:])
    assert np.mean([u.normalized_score for u in updates]) == pytest.approx(1.0, abs=0.15)
    assert all(np.linalg.eigvalsh(u.covariance).min() > 0.0 for u in updates)
    assert np.mean([u.n_particles for u in updates[5:]]) < 300  # as many as their spread asks for


def test_a_wrong_start_is_detected_and_corrected(drive: tuple) -> None:
    off, updates = run(drive, drive[1][0] + (12.0, 16.0, np.deg2rad(20.0)))
    assert off[:10].min() > 3.0 and off[40:].max() < 1.0
    assert all(u.is_lost for u in updates[8:12]) and not any(u.is_lost for u in updates[40:])
    assert sum(u.was_replaced for u in updates) >= 1


def test_a_hypothesis_can_replace_the_estimate_of_the_filter_with_plain_resampling(drive: tuple) -> None:
    settings = replace(SETTINGS, resampling=Resampling())
    off, updates = run(drive, drive[1][0] + (12.0, 16.0, np.deg2rad(20.0)), settings=settings)
    assert sum(u.was_replaced for u in updates) >= 1 and off[40:].max() < 1.0


def test_an_unknown_start_is_searched_globally(drive: tuple) -> None:
    start = np.array([5.0, -20.0, 2.0])  # the vehicle is 32 m from here, and turned by 2 rad
    off, updates = run(drive, start, is_start_known=False)
    assert off[-1] < 1.0 and not updates[-1].is_lost and updates[0].is_lost


def drive_off(drive: tuple, max_outside_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Follow the drive, then odometry that leaves the map by 700 m and returns; estimates and reports of being lost."""
    points, poses, increments, clouds = drive
    steps = np.concatenate([np.tile((8.0, 0.0, 0.0), (100, 1)), np.tile((-8.0, 0.0, 0.0), (100, 1))])
    reference = measure_reference_contrast(clouds[::5], poses[::5], FIELD.build_grid(points))
    recovery = RecoverySettings(
        reference, max_outside_m=max_outside_m, relocalization=RelocalizationSettings(far_reach_m=60.0)
    )
    robust_filter = RecoveringFilter(points, poses[0], SETTINGS, recovery, np.random.default_rng(1))
    increments = np.concatenate([increments, steps])
    updates = list(localize(robust_filter, increments, [*clouds, *[np.zeros((0, 2))] * 200]))
    return np.array([u.pose for u in updates]), np.array([u.is_lost for u in updates])


def test_an_estimate_off_the_map_is_held_and_reported(drive: tuple) -> None:
    low, high = drive[0].min(axis=0), drive[0].max(axis=0)
    free, _ = drive_off(drive, np.inf)
    held, is_lost = drive_off(drive, 64.0)
    np.testing.assert_array_equal(held[:70], free[:70])  # on the map nothing changes, to the last bit
    assert (free[:, :2] > high + 500.0).any() and (held[:, :2] <= high + 64.0).all()
    assert (held[:, :2] >= low - 64.0).all() and is_lost[-1]
    at_border = (held[:, :2] == high + 64.0).any(axis=1)
    assert at_border.sum() > 50 and is_lost[at_border].all()
    assert not at_border[-10:].any() and np.hypot(*(held[-1] - drive[1][-1])[:2]) < 30.0  # it has returned


def test_a_start_off_the_map_is_held(drive: tuple) -> None:
    points, _, _, clouds = drive
    recovery, rng = RecoverySettings(0.1), np.random.default_rng(1)
    robust_filter = RecoveringFilter(points, np.array([9e5, -9e5, 0.0]), SETTINGS, recovery, rng)
    update = robust_filter.step(clouds[0])
    low, high = points.min(axis=0), points.max(axis=0)
    np.testing.assert_allclose(update.pose[:2], (high[0] + 64.0, low[1] - 64.0))
    assert update.is_lost and np.isfinite(update.covariance).all()


def test_same_seed_same_track(drive: tuple) -> None:
    start = drive[1][0] + (12.0, 16.0, 0.3)
    np.testing.assert_array_equal(run(drive, start)[0], run(drive, start)[0])


def test_scans_without_points_leave_the_filter_to_the_odometry(drive: tuple) -> None:
    points, poses, increments, clouds = drive
    silent = [cloud if k < 20 or k > 26 else np.zeros((0, 2)) for k, cloud in enumerate(clouds)]
    off, updates = run((points, poses, increments, silent), poses[0])
    assert off.max() < 1.0 and not updates[22].filter.measurement_used


def test_scans_of_a_stationary_vehicle_weigh_less(drive: tuple) -> None:
    points, poses, _, clouds = drive
    stood = (points, np.repeat(poses[:1], 12, axis=0), np.zeros((11, 3)), clouds[:1] * 12)

    def ess(weight: float) -> float:  # large where the weights of the second scan differ little
        _, updates = run(stood, poses[0], stationary_weight=weight)
        return updates[1].filter.ess / len(updates[1].filter.particles)

    assert ess(0.1) > 1.5 * ess(1.0)


def test_bad_input_is_refused(drive: tuple) -> None:
    points, poses, increments, clouds = drive
    with pytest.raises(MclError, match="no odometry increment for scan 5"):
        run((points, poses, increments[:4], clouds), poses[0])
    with pytest.raises(MclError, match="the map holds no point"):
        RecoveringFilter(
            np.zeros((0, 2)), poses[0], SETTINGS, RecoverySettings(0.1), np.random.default_rng(0)
        )
    with pytest.raises(ValueError, match="match by chance only"):
        measure_reference_contrast([], np.zeros((0, 3)), FIELD.build_grid(points))


def test_means_of_hypotheses_of_different_age() -> None:
    particles = np.zeros((2, 3, 3))
    particles[1, :, 2] = (np.pi - 0.1, np.pi + 0.1, np.pi)
    scores = np.array([[0.2, 0.4], [np.nan, 0.3]])
    found = Hypotheses(particles, np.full((2, 3), 1.0 / 3.0), scores)
    np.testing.assert_allclose(found.means, [0.3, 0.3])
    assert found.ages.tolist() == [2, 1] and abs(found.poses[1, 2]) == pytest.approx(np.pi)
    assert len(found.keep(np.array([1]))) == 1


def test_a_reset_starts_again(drive: tuple) -> None:
    points, poses, increments, clouds = drive
    recovery, rng = RecoverySettings(0.1), np.random.default_rng(1)
    robust_filter = RecoveringFilter(points, poses[0] + (40.0, 0.0, 0.0), SETTINGS, recovery, rng)
    resets = {3: poses[3]}
    updates = localize(robust_filter, increments[:6], clouds[:7], lambda index, _: resets.get(index))
    off = [np.hypot(*(u.pose - pose)[:2]) for u, pose in zip(updates, poses, strict=False)]
    assert min(off[:4]) > 20.0 and max(off[4:]) < 1.0
