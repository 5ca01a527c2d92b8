"""A filter that watches itself: it stays quiet on a good track, says that it is lost, and finds back."""

import numpy as np
import pytest
from test_search import look, town

from rol.geometry import compose
from rol.mcl import MclError, build_grid, settings_for
from rol_beyond.recovery import (
    RecoverySettings,
    Rivals,
    covariance_of,
    localize_with_recovery,
    measure_level,
    move_mean,
)

SETTINGS = settings_for("rol", n_particles=300, min_particles=100)


def move(particles: np.ndarray, step: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return compose(particles, step + rng.standard_normal((len(particles), 3)) * (0.05, 0.05, 0.004))


@pytest.fixture(scope="module")
def drive() -> tuple:
    """A town, the poses of a drive through it, its steps and its clouds."""
    rng = np.random.default_rng(5)
    points = town(rng)
    poses = np.column_stack(
        [np.linspace(-30.0, 30.0, 70), 5.0 * np.sin(np.linspace(0.0, 3.0, 70)), np.zeros(70)]
    )
    clouds = [look(points, pose, 100, rng) for pose in poses]
    return points, poses, np.diff(poses, axis=0), clouds


def run(drive: tuple, start: np.ndarray, **changes: object) -> tuple[np.ndarray, list]:
    points, poses, steps, clouds = drive
    level = measure_level(clouds[::5], poses[::5], build_grid(points, SETTINGS))
    known = changes.pop("is_start_known", True)
    recovery = RecoverySettings(level, far_m=60.0, **changes)
    updates = list(
        localize_with_recovery(
            steps,
            clouds,
            points,
            start,
            SETTINGS,
            recovery,
            move,
            np.random.default_rng(1),
            is_start_known=known,
        )
    )
    return np.hypot(*(np.array([u.filter.pose for u in updates]) - poses)[:, :2].T), updates


def test_a_good_track_is_left_alone(drive: tuple) -> None:
    off, updates = run(drive, drive[1][0])
    assert off.max() < 0.5
    assert not any(u.is_lost or u.was_replaced for u in updates[8:])
    assert np.mean([u.health for u in updates]) == pytest.approx(1.0, abs=0.15)
    assert all(np.linalg.eigvalsh(u.covariance).min() > 0.0 for u in updates)
    assert np.mean([u.n_particles for u in updates[5:]]) < 300  # as many as their spread asks for


def test_a_wrong_start_is_noticed_and_mended(drive: tuple) -> None:
    off, updates = run(drive, drive[1][0] + (12.0, 16.0, np.deg2rad(20.0)))
    assert off[:10].min() > 3.0 and off[40:].max() < 1.0
    assert all(u.is_lost for u in updates[8:12]) and not any(u.is_lost for u in updates[40:])
    assert sum(u.was_replaced for u in updates) >= 1


def test_an_unknown_start_is_searched_for_afar(drive: tuple) -> None:
    start = np.array([5.0, -20.0, 2.0])  # the car is 32 m from here, and turned by 2 rad
    off, updates = run(drive, start, is_start_known=False)
    assert off[-1] < 1.0 and not updates[-1].is_lost and updates[0].is_lost


def test_same_seed_same_track(drive: tuple) -> None:
    start = drive[1][0] + (12.0, 16.0, 0.3)
    np.testing.assert_array_equal(run(drive, start)[0], run(drive, start)[0])


def test_scans_without_points_leave_the_filter_to_the_odometry(drive: tuple) -> None:
    points, poses, steps, clouds = drive
    silent = [cloud if k < 20 or k > 26 else np.zeros((0, 2)) for k, cloud in enumerate(clouds)]
    off, updates = run((points, poses, steps, silent), poses[0])
    assert off.max() < 1.0 and not updates[22].filter.is_informed


def test_a_standing_car_learns_slowly(drive: tuple) -> None:
    points, poses, _, clouds = drive
    stood = (points, np.repeat(poses[:1], 12, axis=0), np.zeros((11, 3)), clouds[:1] * 12)

    def ess(share: float) -> float:  # by how little the weights of the second scan differ
        _, updates = run(stood, poses[0], still_share=share)
        return updates[1].filter.ess / len(updates[1].filter.particles)

    assert ess(0.1) > 1.5 * ess(1.0)


def test_bad_input_is_refused(drive: tuple) -> None:
    points, poses, steps, clouds = drive
    with pytest.raises(MclError, match="no odometry step to scan 5"):
        run((points, poses, steps[:4], clouds), poses[0])
    with pytest.raises(MclError, match="the map holds no point"):
        list(
            localize_with_recovery(
                steps,
                clouds,
                np.zeros((0, 2)),
                poses[0],
                SETTINGS,
                RecoverySettings(0.1),
                move,
                np.random.default_rng(0),
            )
        )
    grid = build_grid(points, SETTINGS)
    with pytest.raises(ValueError, match="so not at all"):
        measure_level([], np.zeros((0, 3)), grid)


def test_rivals_give_their_means_in_spite_of_their_age() -> None:
    particles = np.zeros((2, 3, 3))
    particles[1, :, 2] = (np.pi - 0.1, np.pi + 0.1, np.pi)
    scores = np.array([[0.2, 0.4], [np.nan, 0.3]])
    rivals = Rivals(particles, np.full((2, 3), 1.0 / 3.0), scores)
    np.testing.assert_allclose(rivals.means, [0.3, 0.3])
    assert rivals.ages.tolist() == [2, 1] and abs(rivals.poses[1, 2]) == pytest.approx(np.pi)
    assert len(rivals.keep(np.array([1]))) == 1


def test_mean_motion_and_covariance(drive: tuple) -> None:
    np.testing.assert_allclose(move_mean(np.array([1.0, 0.1, 0.02]), move), [1.0, 0.1, 0.02], atol=0.01)
    update = run(drive, drive[1][0])[1][-1].filter
    spread = np.sqrt(np.trace(covariance_of(update)[:2, :2]))
    assert spread == pytest.approx(np.hypot(update.spread_m, np.sqrt(2e-4)), rel=1e-6)
