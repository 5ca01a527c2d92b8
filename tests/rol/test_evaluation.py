"""Figures worked out by hand, files that go round, files that are refused, and evo as a second opinion."""

import json

import numpy as np
import pytest

from rol.evaluation import (
    METRICS,
    EvaluationError,
    FailureMonitor,
    FailureRule,
    drift_by_length,
    fraction_within,
    pose_errors,
    read_metrics,
    read_tum,
    rmse,
    summarize,
    write_metrics,
    write_tum,
)
from rol.geometry import accumulate_increments, compose

QUARTER_US = 250_000


def noisy_run(n: int = 50) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, estimate and truth of a made-up drive in a bend."""
    truth = accumulate_increments(np.tile((1.0, 0.0, 0.05), (n - 1, 1)), (100.0, -20.0, 3.0))
    noise = np.random.default_rng(1).normal(0.0, (0.5, 0.3, 0.02), (n, 3))
    return 1_547_120_789_640_420 + QUARTER_US * np.arange(n), compose(truth, noise), truth


def test_pose_errors_by_hand():
    # facing along y: an estimate 3 m further along y is ahead, 4 m towards -x is left
    errors = pose_errors(np.array([[-4.0, 3.0, -np.pi + 0.1]]), np.array([[0.0, 0.0, np.pi / 2]]))
    assert errors.position_m[0] == pytest.approx(5.0)
    assert errors.longitudinal_m[0] == pytest.approx(3.0) and errors.lateral_m[0] == pytest.approx(4.0)
    assert errors.yaw_rad[0] == pytest.approx(np.pi / 2 + 0.1)
    # across the cut at 180 deg the short way counts
    errors = pose_errors(np.array([[0.0, 0.0, -3.1]]), np.array([[0.0, 0.0, 3.1]]))
    assert errors.yaw_rad[0] == pytest.approx(2 * np.pi - 6.2)


def test_pose_errors_refuse_what_cannot_be_compared():
    with pytest.raises(EvaluationError, match="3 estimated poses for 2 true ones"):
        pose_errors(np.zeros((3, 3)), np.zeros((2, 3)))
    with pytest.raises(EvaluationError, match="0 estimated poses"):
        pose_errors(np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(ValueError, match=r"estimate: value at index \(1, 2\)"):
        pose_errors(np.array([[0, 0, 0], [0, 0, np.nan]]), np.zeros((2, 3)))


def test_rmse_and_shares_by_hand():
    assert rmse(np.array([3.0, -4.0, 0.0, 0.0])) == pytest.approx(2.5)
    estimate = np.array(
        [[0.5, 0, 0], [0.5, 0, np.deg2rad(3)], [1.0, 0, 0], [4.0, 0, np.deg2rad(-9)], [9.0, 0, 0]]
    )
    errors = pose_errors(estimate, np.zeros((5, 3)))
    assert fraction_within(errors, 1.0, 2.0) == pytest.approx(0.2)  # an error of just 1 m is outside
    assert fraction_within(errors, 2.0, 5.0) == pytest.approx(0.6)
    assert fraction_within(errors, 5.0, 10.0) == pytest.approx(0.8)


def watch_run(offsets_m, yaws=0.0, rule=None) -> list[int]:
    """Failures of a run whose estimate lies so far beside the truth, four scans a second."""
    n = len(offsets_m)
    monitor = FailureMonitor(QUARTER_US * np.arange(n), np.zeros((n, 3)), rule or FailureRule())
    for i, (offset, yaw) in enumerate(np.broadcast(offsets_m, yaws)):
        if monitor(i, np.array([0.0, offset, yaw])) is not None:
            assert monitor.failures[-1] == i
    return monitor.failures


def test_failure_rule():
    far, near = [21.0], [19.0]
    assert watch_run(near * 100) == []
    assert watch_run(far * 20 + near + far * 20) == []  # 4.75 s, and again 4.75 s
    assert watch_run(near * 4 + far * 21) == [24]  # the 21st scan off is 5 s after the first
    assert watch_run(far * 42) == [20, 41]  # counted anew after each restart
    assert watch_run([0.0] * 30, np.deg2rad(50.0)) == [20]
    assert watch_run([3.0] * 30, rule=FailureRule(max_position_m=2.0, seconds=1.0)) == [4, 9, 14, 19, 24, 29]


def test_failure_gives_the_true_pose():
    truth = np.array([[1.0, 2.0, 0.3]] * 9)
    monitor = FailureMonitor(QUARTER_US * np.arange(9), truth, FailureRule(seconds=2.0))
    given = [monitor(i, np.array([100.0, 0.0, 0.0])) for i in range(9)]
    assert all(pose is None for pose in given[:8])
    np.testing.assert_array_equal(given[8], truth[8])


def test_drift_by_length_of_a_scale_error_and_a_constant_turn():
    # 250 m straight: 3 % short, then 0.001 rad off in each metre; no segments of 300 m
    steps = np.tile((1.0, 0.0, 0.0), (250, 1))
    report = drift_by_length(
        accumulate_increments(steps * 0.97), accumulate_increments(steps), (100.0, 150.0, 300.0)
    )
    np.testing.assert_array_equal(report.lengths_m, (100.0, 150.0))
    np.testing.assert_array_equal(report.n_segments, (16, 11))  # from 0, 10 ... 150; and 0, 10 ... 100
    np.testing.assert_allclose(report.translation_pct, 3.0)
    assert report.mean_translation_pct == pytest.approx(3.0)
    assert np.abs(report.rotation_deg_per_100m).max() < 1e-9
    turning = drift_by_length(
        accumulate_increments(steps + (0, 0, -0.001)), accumulate_increments(steps), (100.0,)
    )
    np.testing.assert_allclose(turning.rotation_deg_per_100m, np.rad2deg(0.1))


def test_drift_over_a_way_too_short_has_no_length_left():
    poses = accumulate_increments(np.tile((1.0, 0.0, 0.0), (50, 1)))
    report = drift_by_length(poses, poses)
    assert len(report.lengths_m) == len(report.n_segments) == len(report.translation_pct) == 0
    assert np.isnan(report.mean_translation_pct) and np.isnan(report.mean_rotation_deg_per_100m)
    with pytest.raises(EvaluationError, match="50 estimated poses for 51 true ones"):
        drift_by_length(poses[1:], poses)


def matrix(pose: np.ndarray) -> np.ndarray:
    """A planar pose as a 4 x 4 matrix, for the loop below."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, 0, pose[0]], [s, c, 0, pose[1]], [0, 0, 1, 0], [0, 0, 0, 1]])


def kitti_loop(estimate: np.ndarray, truth: np.ndarray, lengths_m: list[float]) -> dict[float, np.ndarray]:
    """The benchmark's development kit, written as it is in C++: matrices, and one segment after the other."""
    way = [0.0]
    for i in range(1, len(truth)):
        way.append(way[-1] + float(np.linalg.norm(truth[i, :2] - truth[i - 1, :2])))
    found: dict[float, list[tuple[float, float]]] = {}
    for first in range(0, len(way), 10):
        for length in lengths_m:
            last = next((i for i in range(first, len(way)) if way[i] >= way[first] + length), -1)
            if last == -1:
                continue
            delta_truth = np.linalg.inv(matrix(truth[first])) @ matrix(truth[last])
            delta_estimate = np.linalg.inv(matrix(estimate[first])) @ matrix(estimate[last])
            error = np.linalg.inv(delta_estimate) @ delta_truth
            angle = np.arccos(np.clip((np.trace(error[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
            found.setdefault(length, []).append((np.linalg.norm(error[:3, 3]) / length, angle / length))
    return {length: np.array(errors) for length, errors in found.items()}


def test_drift_by_length_agrees_with_a_slow_loop():
    rng = np.random.default_rng(4)
    steps = np.column_stack(
        [rng.uniform(0.0, 2.5, 900), rng.normal(0.0, 0.02, 900), rng.normal(0.0, 0.03, 900)]
    )
    truth = accumulate_increments(steps)
    estimate = accumulate_increments(
        steps * (0.98, 1.0, 1.0) + rng.normal(0.0, (0.05, 0.02, 0.002), (900, 3))
    )
    report = drift_by_length(estimate, truth)
    loop = kitti_loop(estimate, truth, [100.0 * k for k in range(1, 9)])
    assert report.lengths_m.tolist() == list(loop) == [100.0 * k for k in range(1, 9)]
    for i, errors in enumerate(loop.values()):
        assert report.n_segments[i] == len(errors)
        assert report.translation_pct[i] == pytest.approx(100.0 * errors[:, 0].mean(), abs=1e-9)
        assert report.rotation_deg_per_100m[i] == pytest.approx(
            np.rad2deg(100.0 * errors[:, 1].mean()), abs=1e-6
        )
    every = np.concatenate(list(loop.values()))
    assert report.mean_translation_pct == pytest.approx(100.0 * every[:, 0].mean(), abs=1e-9)


def test_tum_round_trip(tmp_path):
    stamps_us, estimate, _ = noisy_run()
    write_tum(tmp_path / "new" / "a.tum", stamps_us, estimate)
    stamps_back, poses_back = read_tum(tmp_path / "new" / "a.tum")
    np.testing.assert_array_equal(stamps_back, stamps_us)
    np.testing.assert_allclose(poses_back, estimate, atol=6e-7)
    first = (tmp_path / "new" / "a.tum").read_text(encoding="utf-8").splitlines()[0].split()
    assert first[0] == "1547120789.640420" and len(first) == 8
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.tum"]  # no temporary file is left


@pytest.mark.parametrize(
    ("lines", "fault"),
    [
        (["1.0 0 0 0 0 0 0 1", "2.0 nan 0 0 0 0 0 1"], "pose 2 is not finite"),
        (["1.0 0 0 0 0 0 0 1", "1.0 0 0 0 0 0 0 1"], "times do not increase at pose 2"),
        (["1.0 0 0 0 0 0 0"], "line 1 has 7 values instead of 8"),
        (["1.0 0 0 0 0 0 0 one"], "could not convert"),
        (["# nothing"], "no pose"),
        (
            ["# t x y z", "1.0 0 0 0 0 0 0 1", "2.0 0 0 0 0 0 0 0"],
            "line 3: norm of the quaternion is 0, not 1",
        ),
        (["1547131046353776 0 0 0 0 0 0 1"], "time 1547131046353776 cannot be in seconds"),
        (["1.0000001 0 0 0 0 0 0 1", "1.0000002 0 0 0 0 0 0 1"], "times do not increase at pose 2"),
        (["1.0 0 0 0 0 0 0.5 0.5"], "line 1: norm of the quaternion is 0.707, not 1"),
        (["nan 0 0 0 0 0 0 1"], "pose 1 is not finite"),
    ],
)
def test_bad_tum_files_are_named(tmp_path, lines, fault):
    path = tmp_path / "bad.tum"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    with pytest.raises(EvaluationError, match=f"bad.tum: .*{fault}"):
        read_tum(path)


def test_bad_trajectories_are_not_written(tmp_path):
    path = tmp_path / "t.tum"
    for stamps, poses, fault in (
        ([1, 2], np.zeros((3, 3)), "2 times for 3 poses"),
        ([1, 2], np.array([[0, 0, 0], [0, np.inf, 0]]), "pose 2 is not finite"),
        ([2, 1], np.zeros((2, 3)), "times do not increase at pose 2"),
        ([], np.zeros((0, 3)), "no pose"),
    ):
        with pytest.raises(EvaluationError, match=f"t.tum: {fault}"):
            write_tum(path, np.array(stamps), poses)
    assert list(tmp_path.iterdir()) == []


def test_metrics_of_a_run_by_hand(tmp_path):
    truth = np.zeros((4, 3))
    estimate = np.array([[0.0, 0.0, 0.0], [0.0, 3.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, np.deg2rad(4.0)]])
    metrics = summarize(
        estimate, truth, method="paper", session="s", failures=2, update_ms_median=np.float64(1.5), seed=3
    )
    assert metrics == {
        "method": "paper", "session": "s", "n_scans": 4, "failures": 2,
        "rmse_m": pytest.approx(2.5), "rmse_yaw_deg": pytest.approx(2.0),
        "within_1m_2deg": 0.25, "within_2m_5deg": 0.5, "within_5m_10deg": 1.0,
        "update_ms_median": 1.5, "seed": 3,
    }  # fmt: skip
    assert list(metrics) == list(METRICS)
    write_metrics(tmp_path / "metrics.json", metrics)
    assert read_metrics(tmp_path / "metrics.json") == metrics


def test_bad_metrics_are_refused(tmp_path):
    path, good = tmp_path / "metrics.json", {key: kind(1) for key, kind in METRICS.items()}
    write_metrics(path, good)
    for change, fault in (
        ({"extra": 1}, "extra"),
        ({"rmse_m": float("nan")}, "rmse_m is not finite"),
        ({"rmse_m": "small"}, "rmse_m is 'small', expected float"),
        ({"seed": True}, "seed is True, expected int"),
        ({"failures": 1.0}, "failures is 1.0, expected int"),
    ):
        with pytest.raises(EvaluationError, match=fault):
            write_metrics(path, good | change)
    assert read_metrics(path) == good
    path.write_text(json.dumps(good)[:40], encoding="utf-8")
    with pytest.raises(EvaluationError, match="metrics.json: not a whole json file"):
        read_metrics(path)
    path.write_text("[]", encoding="utf-8")
    with pytest.raises(EvaluationError, match="metrics.json: keys missing or unknown"):
        read_metrics(path)


def test_evo_reads_our_files_and_finds_our_errors(tmp_path):
    pytest.importorskip("evo")
    from evo.core import metrics as evo_metrics
    from evo.tools import file_interface

    stamps_us, estimate, truth = noisy_run()
    write_tum(tmp_path / "estimate.tum", stamps_us, estimate)
    write_tum(tmp_path / "truth.tum", stamps_us, truth)
    pair = tuple(
        file_interface.read_tum_trajectory_file(tmp_path / f"{n}.tum") for n in ("truth", "estimate")
    )
    errors = pose_errors(estimate, truth)
    for relation, ours in (
        (evo_metrics.PoseRelation.translation_part, rmse(errors.position_m)),
        (evo_metrics.PoseRelation.rotation_angle_deg, rmse(np.rad2deg(errors.yaw_rad))),
    ):
        ape = evo_metrics.APE(relation)
        ape.process_data(pair)
        assert ape.get_statistic(evo_metrics.StatisticsType.rmse) == pytest.approx(ours, rel=1e-5)


def test_evo_finds_the_same_ape_in_our_files_to_the_last_digit(tmp_path):
    pytest.importorskip("evo")
    from evo.core import metrics as evo_metrics
    from evo.tools import file_interface

    stamps_us, estimate, truth = noisy_run()
    paths = tmp_path / "truth.tum", tmp_path / "estimate.tum"
    for path, poses in zip(paths, (truth, estimate), strict=True):
        write_tum(path, stamps_us, poses)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data(tuple(file_interface.read_tum_trajectory_file(path) for path in paths))
    read_truth, read_estimate = (read_tum(path)[1] for path in paths)
    ours = rmse(pose_errors(read_estimate, read_truth).position_m)
    assert ape.get_statistic(evo_metrics.StatisticsType.rmse) == pytest.approx(ours, rel=0, abs=1e-9)
