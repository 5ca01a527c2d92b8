"""Calibration of the motion model on increments with known ground truth, and gating of outliers."""

import numpy as np
import pytest

from rol.geometry import relative_pose
from rol.mcl import predict
from rol_beyond.motion import MotionModel, calibrate_motion, gate_odometry
from rol_data import rall


def drive(rng: np.random.Generator, n: int = 4000) -> np.ndarray:
    """True increments of a vehicle that is stationary a quarter of the time, and drives bends otherwise."""
    speed = np.where(np.arange(n) % 400 < 100, 0.0, 1.0 + 0.5 * np.sin(np.arange(n) / 60.0))
    turn = 0.05 * speed * np.sin(np.arange(n) / 25.0)
    return np.column_stack([speed, 1.2 * turn, turn])


def test_scale_and_noise_are_estimated() -> None:
    rng = np.random.default_rng(1)
    true = drive(rng)
    told = true * (0.98, 1.0, 1.0) + rng.normal(0.0, (0.05, 0.02, 0.002), true.shape)
    told[::97, 0] += 1.5  # one outlier in a hundred
    model = calibrate_motion(told, true, inflation=1.0)
    assert model.matrix[0][0] == pytest.approx(1.0 / 0.98, abs=0.005)
    assert model.matrix[2][2] == pytest.approx(1.0, abs=0.03)
    assert model.sigma_stationary[0] == pytest.approx(0.05, rel=0.5) and model.sigma_stationary[
        2
    ] == pytest.approx(0.002, rel=0.5)
    wary = calibrate_motion(told, true, inflation=3.0)
    assert wary.matrix == model.matrix
    np.testing.assert_allclose(np.array(wary.sigma_base), 3.0 * np.array(model.sigma_base))


def test_correlated_errors_enter_with_their_sum() -> None:
    rng = np.random.default_rng(2)
    true = drive(rng)
    once = rng.normal(0.0, 0.05, len(true))
    lasting = np.convolve(rng.normal(0.0, 0.05, len(true)), np.ones(4) / 2.0, mode="same")  # as large a step
    models = [
        calibrate_motion(true + np.column_stack([error, 0 * error, 0 * error]), true)
        for error in (once, lasting)
    ]
    at_1m = [model.sigma_base[0] + model.sigma_per_metre[0] for model in models]
    assert at_1m[1] > 1.5 * at_1m[0]


def test_the_drift_of_a_stationary_vehicle_is_corrected() -> None:
    rng = np.random.default_rng(5)
    true = drive(rng)
    is_still = true[:, 0] == 0.0
    told = true + rng.normal(0.0, (0.02, 0.01, 0.0005), true.shape)
    told[is_still, 2] += np.repeat(
        rng.normal(0.0, 0.002, 10), 100
    )  # it turns while it stands, as the real one does
    model = calibrate_motion(told, true)
    assert model.sigma_stationary[2] < 0.002 and abs(model.mean(np.array([0.01, 0.0, 0.002]))[2]) < 0.0005
    assert model.mean(np.array([1.0, 0.0, 0.002]))[2] == pytest.approx(0.002, abs=0.001)


def test_an_increment_is_corrected_and_its_noise_drawn() -> None:
    model = MotionModel(
        ((1.1, 0.0, 0.0), (0.0, 0.0, 2.0), (0.0, 0.0, 1.0)),
        sigma_stationary=(0.5, 0.0, 0.0),
        sigma_base=(0.1, 0.0, 0.0),
        sigma_per_metre=(0.1, 0.0, 0.0),
        outlier_fraction=0.0,
    )
    np.testing.assert_allclose(model.mean(np.array([2.0, 9.0, 0.1])), [2.2, 0.2, 0.1])
    start = np.tile([5.0, 5.0, np.pi / 2.0], (20_000, 1))
    moved = predict(start, np.array([2.0, 0.0, 0.0]), model, np.random.default_rng(3))
    assert moved[:, 1].mean() == pytest.approx(7.2, abs=0.01) and moved[:, 0] == pytest.approx(5.0)
    assert moved[:, 1].std() == pytest.approx(0.1 + 2.0 * 0.1, rel=0.03)  # driving, and for each metre
    moved = predict(start, np.array([0.05, 0.0, 0.0]), model, np.random.default_rng(3))
    assert moved[:, 1].std() == pytest.approx(0.5, rel=0.03)


def test_a_fraction_of_the_particles_takes_the_noise_of_an_outlier() -> None:
    model = MotionModel(
        sigma_stationary=(0.01, 0.0, 0.0),
        sigma_per_metre=(0.0, 0.0, 0.0),
        outlier_fraction=0.1,
        outlier_scale=100.0,
    )
    moved = predict(np.zeros((20_000, 3)), np.zeros(3), model, np.random.default_rng(4))
    assert np.mean(np.abs(moved[:, 0]) > 0.05) == pytest.approx(0.096, abs=0.01)


def test_increments_that_do_not_belong_together_are_refused() -> None:
    with pytest.raises(ValueError, match="40 increments for 39 true ones"):
        calibrate_motion(np.zeros((40, 3)), np.zeros((39, 3)))
    with pytest.raises(ValueError, match="at least 32 needed"):
        calibrate_motion(np.zeros((20, 3)), np.zeros((20, 3)))
    with pytest.raises(ValueError, match="not finite"):
        calibrate_motion(np.full((40, 3), np.nan), np.zeros((40, 3)))


def test_the_real_odometry_is_short_by_one_and_a_half_per_cent(real_root) -> None:
    found = []
    for number in ("01", "02", "07"):
        poses = rall.load_poses(real_root / rall.POSES_PATH / f"pose_xy_{number}.txt")
        true = relative_pose(poses[:-1], poses[1:])
        told = rall.load_odometry(real_root / rall.ODOMETRY_PATH / f"seq{number}_odom.txt")[: len(true)]
        found.append(calibrate_motion(told, true).matrix[0][0])
    np.testing.assert_allclose(found, 1.0 / 0.985, atol=0.003)


def test_implausible_increments_are_replaced() -> None:
    steps = np.tile([1.0, 0.0, 0.01], (9, 1))
    steps[2, 0], steps[5, 2], steps[7, 0] = 2.0, 0.2, 1.4  # a jump, a twist, and a car that gains speed
    gated = np.array(list(gate_odometry(steps)))
    np.testing.assert_allclose(gated[[2, 5]], [[1.0, 0.0, 0.01]] * 2)
    np.testing.assert_array_equal(np.delete(gated, [2, 5], axis=0), np.delete(steps, [2, 5], axis=0))


def test_a_lasting_change_is_accepted() -> None:
    steps = np.array([[0.0, 0.0, 0.0]] + [[2.0, 0.0, 0.0]] * 6)  # it was the first step that erred
    assert np.array(list(gate_odometry(steps)))[:, 0].tolist() == [0.0, 0.0, 0.0, 0.0, 2.0, 2.0, 2.0]
