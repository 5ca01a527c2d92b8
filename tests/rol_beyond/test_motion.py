"""What odometry is worth: the scale, the noise and the outliers of steps whose truth is known."""

import numpy as np
import pytest

from rol.geometry import relative_pose
from rol_beyond.motion import MotionModel, correct_step, learn_motion, mover, sample_motion, screen_steps
from rol_data import rall


def drive(rng: np.random.Generator, n: int = 4000) -> np.ndarray:
    """True steps of a car that stands a quarter of the time, and drives bends otherwise."""
    speed = np.where(np.arange(n) % 400 < 100, 0.0, 1.0 + 0.5 * np.sin(np.arange(n) / 60.0))
    turn = 0.05 * speed * np.sin(np.arange(n) / 25.0)
    return np.column_stack([speed, 1.2 * turn, turn])


def test_scale_and_noise_are_found() -> None:
    rng = np.random.default_rng(1)
    true = drive(rng)
    told = true * (0.98, 1.0, 1.0) + rng.normal(0.0, (0.05, 0.02, 0.002), true.shape)
    told[::97, 0] += 1.5  # one gross error in a hundred
    model = learn_motion(told, true, caution=1.0)
    assert model.matrix[0][0] == pytest.approx(1.0 / 0.98, abs=0.005)
    assert model.matrix[2][2] == pytest.approx(1.0, abs=0.03)
    assert model.still[0] == pytest.approx(0.05, rel=0.5) and model.still[2] == pytest.approx(0.002, rel=0.5)
    wary = learn_motion(told, true, caution=3.0)
    assert wary.matrix == model.matrix
    np.testing.assert_allclose(np.array(wary.driving), 3.0 * np.array(model.driving))


def test_errors_that_go_on_count_as_what_they_become() -> None:
    rng = np.random.default_rng(2)
    true = drive(rng)
    once = rng.normal(0.0, 0.05, len(true))
    lasting = np.convolve(rng.normal(0.0, 0.05, len(true)), np.ones(4) / 2.0, mode="same")  # as large a step
    models = [
        learn_motion(true + np.column_stack([error, 0 * error, 0 * error]), true) for error in (once, lasting)
    ]
    at_1m = [model.driving[0] + model.moving[0] for model in models]
    assert at_1m[1] > 1.5 * at_1m[0]


def test_the_drift_of_a_standing_car_is_not_believed() -> None:
    rng = np.random.default_rng(5)
    true = drive(rng)
    is_still = true[:, 0] == 0.0
    told = true + rng.normal(0.0, (0.02, 0.01, 0.0005), true.shape)
    told[is_still, 2] += np.repeat(
        rng.normal(0.0, 0.002, 10), 100
    )  # it turns while it stands, as the real one does
    model = learn_motion(told, true)
    assert model.still[2] < 0.002 and abs(correct_step(np.array([0.01, 0.0, 0.002]), model)[2]) < 0.0005
    assert correct_step(np.array([1.0, 0.0, 0.002]), model)[2] == pytest.approx(0.002, abs=0.001)


def test_a_step_is_corrected_and_its_noise_drawn() -> None:
    model = MotionModel(
        ((1.1, 0.0, 0.0), (0.0, 0.0, 2.0), (0.0, 0.0, 1.0)),
        still=(0.5, 0.0, 0.0),
        driving=(0.1, 0.0, 0.0),
        moving=(0.1, 0.0, 0.0),
        outlier_share=0.0,
    )
    np.testing.assert_allclose(correct_step(np.array([2.0, 9.0, 0.1]), model), [2.2, 0.2, 0.1])
    start = np.tile([5.0, 5.0, np.pi / 2.0], (20_000, 1))
    moved = sample_motion(start, np.array([2.0, 0.0, 0.0]), model, np.random.default_rng(3))
    assert moved[:, 1].mean() == pytest.approx(7.2, abs=0.01) and moved[:, 0] == pytest.approx(5.0)
    assert moved[:, 1].std() == pytest.approx(0.1 + 2.0 * 0.1, rel=0.03)  # driving, and for each metre
    moved = sample_motion(start, np.array([0.05, 0.0, 0.0]), model, np.random.default_rng(3))
    assert moved[:, 1].std() == pytest.approx(0.5, rel=0.03)


def test_a_share_of_the_particles_takes_the_noise_of_an_outlier() -> None:
    model = MotionModel(
        still=(0.01, 0.0, 0.0), moving=(0.0, 0.0, 0.0), outlier_share=0.1, outlier_scale=100.0
    )
    moved = sample_motion(np.zeros((20_000, 3)), np.zeros(3), model, np.random.default_rng(4))
    assert np.mean(np.abs(moved[:, 0]) > 0.05) == pytest.approx(0.096, abs=0.01)


def test_steps_that_do_not_belong_together_are_refused() -> None:
    with pytest.raises(ValueError, match="40 steps for 39 true ones"):
        learn_motion(np.zeros((40, 3)), np.zeros((39, 3)))
    with pytest.raises(ValueError, match="at least 32 needed"):
        learn_motion(np.zeros((20, 3)), np.zeros((20, 3)))
    with pytest.raises(ValueError, match="not finite"):
        learn_motion(np.full((40, 3), np.nan), np.zeros((40, 3)))


def test_the_real_odometry_is_short_by_one_and_a_half_per_cent(real_root) -> None:
    found = []
    for number in ("01", "02", "07"):
        poses = rall.load_poses(real_root / rall.POSES_PATH / f"pose_xy_{number}.txt")
        true = relative_pose(poses[:-1], poses[1:])
        told = rall.load_odometry(real_root / rall.ODOMETRY_PATH / f"seq{number}_odom.txt")[: len(true)]
        found.append(learn_motion(told, true).matrix[0][0])
    np.testing.assert_allclose(found, 1.0 / 0.985, atol=0.003)


def test_steps_that_no_car_makes_are_replaced() -> None:
    steps = np.tile([1.0, 0.0, 0.01], (9, 1))
    steps[2, 0], steps[5, 2], steps[7, 0] = 2.0, 0.2, 1.4  # a jump, a twist, and a car that gains speed
    screened = np.array(list(screen_steps(steps)))
    np.testing.assert_allclose(screened[[2, 5]], [[1.0, 0.0, 0.01]] * 2)
    np.testing.assert_array_equal(np.delete(screened, [2, 5], axis=0), np.delete(steps, [2, 5], axis=0))


def test_a_change_that_lasts_is_believed() -> None:
    steps = np.array([[0.0, 0.0, 0.0]] + [[2.0, 0.0, 0.0]] * 6)  # it was the first step that erred
    assert np.array(list(screen_steps(steps)))[:, 0].tolist() == [0.0, 0.0, 0.0, 0.0, 2.0, 2.0, 2.0]


def test_a_mover_moves_as_its_model_does() -> None:
    model, particles, step = (
        MotionModel(driving=(0.2, 0.1, 0.01)),
        np.zeros((50, 3)),
        np.array([1.0, 0.0, 0.1]),
    )
    moved = mover(model)(particles, step, np.random.default_rng(4))
    np.testing.assert_array_equal(moved, sample_motion(particles, step, model, np.random.default_rng(4)))
