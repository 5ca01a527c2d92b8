"""Faulty segments of a ground truth: found by the odometry alone, whatever its scale, noise and outliers."""

from pathlib import Path

import numpy as np
import pytest

from rol.geometry import accumulate_increments
from rol_data import rall
from rol_study.oxford_route import list_sessions, load_session
from rol_study.truth_faults import find_faulty_scans, find_faulty_steps, group_steps


@pytest.fixture(scope="module")
def route() -> tuple[np.ndarray, np.ndarray]:
    """A drive of 600 scans with a stop, and noisy odometry that is 1.5 % short, shapes (600, 3) and (599, 3)."""
    rng = np.random.default_rng(3)
    speed = np.clip(1.0 + 0.6 * np.sin(np.arange(599) / 25.0) + 0.5 * np.sin(np.arange(599) / 9.0), 0.0, None)
    steps = np.column_stack([speed, np.zeros(599), 0.02 * np.sin(np.arange(599) / 40.0)])
    noise = rng.standard_normal((599, 3)) * (0.05, 0.02, 0.0015)
    return accumulate_increments(steps), 0.985 * steps + noise


def stand_and_leap(truth: np.ndarray, first: int, n: int) -> np.ndarray:
    """Let the ground truth stand at pose `first` for n scans, and leap back to where it belongs."""
    faulty = truth.copy()
    faulty[first + 1 : first + 1 + n] = truth[first]
    return faulty


def test_a_right_ground_truth_has_no_faults(route: tuple) -> None:
    assert not find_faulty_scans(*route).any()


def test_a_standing_truth_and_its_leap_are_found(route: tuple) -> None:
    truth, odometry = route
    first = int(np.argmax(odometry[100:500, 0])) + 100
    faulty = stand_and_leap(truth, first, 5)
    steps = np.flatnonzero(find_faulty_steps(faulty, odometry))
    assert steps.tolist() == list(range(first, first + 6))  # five of standing and the leap
    assert np.flatnonzero(find_faulty_scans(faulty, odometry)).tolist() == list(range(first, first + 7))


@pytest.mark.parametrize("scale", [0.9, 1.0, 1.1])
def test_the_scale_of_the_odometry_changes_nothing(route: tuple, scale: float) -> None:
    truth, odometry = route
    faulty = stand_and_leap(stand_and_leap(truth, 210, 3), 300, 4)
    expected = find_faulty_scans(faulty, odometry)
    assert expected.any()
    np.testing.assert_array_equal(find_faulty_scans(faulty, odometry * (scale, scale, 1.0)), expected)


def test_outliers_of_the_odometry_are_no_faults(route: tuple) -> None:
    truth, odometry = route
    disturbed = odometry.copy()
    disturbed[50:550:50, 0] += np.resize((1.0, -0.8), 10)
    assert not find_faulty_steps(truth, disturbed).any()


def test_noise_of_the_odometry_widens_the_limit(route: tuple) -> None:
    truth, odometry = route
    noise = np.random.default_rng(4).standard_normal((599, 1)) * (0.15, 0.0, 0.0)
    assert not find_faulty_steps(truth, odometry + noise).any()
    faulty = stand_and_leap(truth, 230, 1)
    assert find_faulty_steps(faulty, odometry).sum() >= find_faulty_steps(faulty, odometry + noise).sum()


def test_steps_are_grouped() -> None:
    assert group_steps(np.array([3, 4, 13, 23, 40])) == [(3, 13), (23, 23), (40, 40)]
    assert group_steps(np.array([], dtype=int)) == []
    assert group_steps(np.array([1, 3]), 0) == [(1, 1), (3, 3)]


def test_too_few_moving_scans_have_no_faults_and_lengths_must_agree() -> None:
    truth = np.zeros((30, 3))
    assert not find_faulty_scans(truth, np.tile((1.0, 0.0, 0.0), (29, 1))).any()
    with pytest.raises(ValueError, match="28 odometry increments for 30 poses"):
        find_faulty_scans(truth, np.zeros((28, 3)))


def test_session_08_is_the_one_with_faults(real_root: Path) -> None:
    everywhere = np.array([[-5000.0, -5000.0], [5000.0, 5000.0]])
    counts = {}
    for place in rall.PLACES:
        for number in list_sessions(real_root, place):
            session = load_session(real_root, number, everywhere, place)
            steps = np.flatnonzero(find_faulty_steps(session.truth, session.increments))
            counts[place, number] = len(steps), len(group_steps(steps)), int(session.is_faulty.sum())
    assert counts.pop(("oxford", "08")) == (120, 24, 238)
    assert all(n_steps <= 8 and n_scans <= 11 for n_steps, _, n_scans in counts.values()), counts
    assert len(counts) >= 4


def test_cfear_contradicts_the_marked_steps_too(real_root: Path) -> None:
    everywhere = np.array([[-5000.0, -5000.0], [5000.0, 5000.0]])
    for number in list_sessions(real_root, "oxford", "cfear"):
        session = load_session(real_root, number, everywhere)
        other = load_session(real_root, number, everywhere, odometry="cfear")
        marked = np.flatnonzero(find_faulty_steps(session.truth, session.increments))
        gaps = (other.true_increments - other.increments)[marked, 0]
        assert len(marked) and np.abs(gaps).min() > 0.4
