"""Sessions of the real route: their parts must belong together; how a recovery is judged; drawn points at real poses."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rol.evaluation import FailureRule, pose_errors, rmse
from rol.geometry import compose, transform_points
from rol.mcl import build_grid, settings_for
from rol_beyond.motion import MotionModel
from rol_beyond.recovery import RecoverySettings
from rol_data import rall
from rol_study.route import (
    Route,
    RouteError,
    displace,
    judge_recovery,
    learn_from_others,
    list_routes,
    load_route,
    published_level,
    published_motion,
    run_registration,
)
from rol_study.route_runs import (
    Stage,
    add_outliers,
    draw_session,
    kidnap,
    run_method,
    set_stage,
    start_anywhere,
)
from rol_study.sampled_points import FrontEnd

MAP = np.array([[0.0, 0.0], [100.0, 100.0]])
MAP_ALL = np.array([[-2000.0, -2000.0], [2000.0, 2000.0]])  # holds any route


def write_route(root: Path, number: str, n: int = 60, n_steps: int | None = None, **places: tuple) -> Path:
    """Write poses along a line and their steps; `places` moves single poses."""
    poses = np.column_stack([np.linspace(0.0, 50.0, n), np.full(n, 50.0), np.zeros(n)])
    for row, place in places.items():
        poses[int(row[1:]), :2] = place
    steps = np.tile([50.0 / (n - 1), 0.0, 0.0], ((n - 1) if n_steps is None else n_steps, 1))
    for path, rows in (
        (root / rall.POSES_PATH / f"pose_xy_{number}.txt", poses),
        (root / rall.ODOMETRY_PATH / f"seq{number}_odom.txt", steps),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(path, rows)
    return root


def test_a_session_is_read_with_or_without_its_last_row(tmp_path: Path) -> None:
    for number, n_steps in (("03", 59), ("04", 60)):
        route = load_route(write_route(tmp_path, number, n_steps=n_steps), number, MAP)
        assert route.truth.shape == (60, 3) and route.steps.shape == (59, 3)
        np.testing.assert_allclose(route.true_steps, route.steps, atol=1e-6)
        assert np.diff(route.stamps_us).tolist() == [250_000] * 59
    assert list_routes(tmp_path) == ["03", "04"]


def test_parts_that_do_not_belong_together_are_named(tmp_path: Path) -> None:
    with pytest.raises(
        RouteError, match=r"seq03_odom.txt: 57 steps for the 60 poses of pose_xy_03.txt; 59 needed"
    ):
        load_route(write_route(tmp_path, "03", n_steps=57), "03", MAP)
    with pytest.raises(RouteError, match=r"pose_xy_05.txt: pose 8 at \(900.0, 1.0\) m is outside the map"):
        load_route(write_route(tmp_path, "05", p7=(900.0, 1.0)), "05", MAP)
    with pytest.raises(rall.RallError, match=r"pose_xy_06.txt: row 3 is not finite"):
        load_route(write_route(tmp_path, "06", p2=(np.nan, 1.0)), "06", MAP)
    with pytest.raises(rall.RallError, match=r"pose_xy_99.txt: missing"):
        load_route(tmp_path, "99", MAP)


def test_motion_is_learnt_from_another_session_if_there_is_one(tmp_path: Path) -> None:
    root = write_route(tmp_path, "03")
    model, teacher, poses = learn_from_others(root, "03", MAP)
    assert model == published_motion() and teacher == "" and poses.shape == (0, 3)
    model, teacher, _ = learn_from_others(write_route(root, "01", n=80), "03", MAP)
    assert teacher == "01" and model != published_motion()


def test_the_published_odometry_is_what_session_01_teaches(real_root: Path) -> None:
    taught, kept = learn_from_others(real_root, "02", MAP_ALL)[0], published_motion()
    for name in ("still", "driving", "moving"):
        np.testing.assert_allclose(getattr(kept, name), getattr(taught, name), atol=0.002)
    for name in ("matrix", "still_matrix"):
        np.testing.assert_allclose(
            np.diag(getattr(kept, name))[[0, 2]], np.diag(getattr(taught, name))[[0, 2]], atol=0.01
        )
    assert kept.matrix[1][2] == pytest.approx(taught.matrix[1][2], abs=0.05)


def test_the_published_level_is_what_session_01_teaches(real_root: Path) -> None:
    for front_end in (FrontEnd(), FrontEnd(0.50, 0.70), FrontEnd(0.65, 0.80), FrontEnd(0.80, 0.90)):
        taught = set_stage(real_root, "02", front_end, max_scans=3)
        assert taught.teacher == "01"
        assert published_level(front_end.share_1m) == pytest.approx(taught.level, abs=0.003)
    assert 0.048 < published_level(0.45) < 0.1 and published_level(0.3) == published_level(0.4)


def test_a_session_alone_teaches_nothing_about_itself(real_root: Path, tmp_path: Path) -> None:
    for name in (
        rall.MAP_PATH,
        f"{rall.POSES_PATH}/pose_xy_02.txt",
        f"{rall.ODOMETRY_PATH}/seq02_odom.txt",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).symlink_to(real_root / name)
    stage = set_stage(tmp_path, "02", FrontEnd(), max_scans=3)
    assert (stage.teacher, stage.level, stage.model) == ("", published_level(0.4), published_motion())


@pytest.fixture(scope="module")
def street() -> tuple[Route, np.ndarray, list[np.ndarray]]:
    """A drive of 40 scans between rows of posts, its odometry a little short, and what is near in each scan."""
    rng = np.random.default_rng(5)
    posts = rng.uniform((-40.0, -30.0), (80.0, 30.0), (300, 2))
    truth = np.column_stack([np.arange(40.0), np.zeros(40), 0.01 * np.arange(40.0)])
    steps = np.tile([0.97, 0.0, 0.012], (39, 1))
    clouds = [
        np.column_stack([c * x + s * y, c * y - s * x]) + 0.05 * rng.standard_normal((len(posts), 2))
        for (px, py, yaw) in truth
        for c, s in [(np.cos(yaw), np.sin(yaw))]
        for x, y in [(posts - (px, py)).T]
    ]
    return Route("09", truth, steps), posts, clouds


def test_registration_alone_follows_good_points(street: tuple) -> None:
    route, posts, clouds = street
    run = run_registration(route, clouds, posts)
    errors = pose_errors(run.poses, route.truth)
    assert errors.position_m.max() < 0.05 and np.abs(errors.yaw_rad).max() < 0.002
    assert not run.is_lost.any() and not run.failures and run.update_ms.shape == (40,)
    near = [cloud[np.hypot(*cloud.T) < 20.0] for cloud in clouds]
    seen = run_registration(route, near, posts, reach_m=25.0)
    assert pose_errors(seen.poses, route.truth).position_m.max() < 0.2


def test_registration_that_is_not_believed_leaves_the_guess(street: tuple) -> None:
    route, posts, clouds = street
    empty = [clouds[0], *[np.zeros((0, 2))] * 39]
    run, guess = run_registration(route, empty, posts), route.truth[0]
    assert run.is_lost.tolist() == [False] + [True] * 39
    start = run.poses[0]
    for k in range(1, 40):
        start = compose(start, route.steps[k - 1])
        np.testing.assert_allclose(run.poses[k], start, atol=1e-9)
    assert np.hypot(*(run.poses[0] - guess)[:2]) < 0.05
    asked = run_registration(route, clouds, posts, min_share=1.0)  # the trim leaves 90 %
    assert asked.is_lost.all()


def test_registration_is_set_back_to_the_truth_after_a_failure(street: tuple) -> None:
    route, posts, _ = street
    rule, empty = FailureRule(max_position_m=3.0, seconds=1.0), [np.zeros((0, 2))] * 40
    run = run_registration(Route("09", route.truth, 0.5 * route.steps), empty, posts, rule)
    assert len(run.failures) >= 2
    for k in run.failures:
        if k < 39:
            off = pose_errors(run.poses[k + 1 : k + 2], route.truth[k + 1 : k + 2]).position_m[0]
            assert off < 1.0 and pose_errors(run.poses[k : k + 1], route.truth[k : k + 1]).position_m[0] > 3.0


@pytest.mark.parametrize("begin", [kidnap, start_anywhere])
@pytest.mark.parametrize("first", [-20, 40])
def test_a_start_at_no_scan_of_the_session_is_refused(street: tuple, begin: Callable, first: int) -> None:
    route, posts, _ = street
    stage = Stage(route, posts, FrontEnd(), None, None, MotionModel(), "", 0.2, None)
    with pytest.raises(ValueError, match=f"first: {first} is no scan of session .*, which has 40"):
        begin(stage, first, 1)


def test_a_run_takes_the_registration_and_another_watch(street: tuple) -> None:
    route, posts, clouds = street
    stage = Stage(
        route, posts, FrontEnd(), None, None, MotionModel(), "", 0.2, build_grid(posts, settings_for("rol"))
    )
    alone = run_method(stage, "registration", clouds, 1)
    np.testing.assert_array_equal(alone.poses, run_registration(route, clouds, posts).poses)
    wrong = [transform_points((9.0, 7.0, 0.3), cloud) for cloud in clouds]
    told = run_method(stage, "rol", wrong, 1)
    blind = RecoverySettings(0.2, doubt=-np.inf, lost=-np.inf)
    quiet = run_method(stage, "rol", wrong, 1, recovery=blind)
    assert told.is_lost.any() and not quiet.is_lost.any()
    assert told.n_particles.max() > 1000 >= quiet.n_particles.max()


@dataclass
class Told:
    """As much of an update as is judged."""

    pose: np.ndarray
    is_lost: bool
    n_particles: int = 7

    @property
    def filter(self) -> SimpleNamespace:
        return SimpleNamespace(pose=self.pose)


def test_recovery_is_judged_by_the_first_estimate_that_stays_right() -> None:
    truth, wrong, right = np.zeros((40, 3)), np.array([9.0, 0.0, 0.0]), np.array([0.5, 0.0, 0.0])
    updates = [Told(right if k in (3, 4) or k >= 20 else wrong, is_lost=k < 14) for k in range(40)]
    trial = judge_recovery(updates, truth)
    assert trial.found_s == 5.0  # scans 3 and 4 did not last
    assert trial.told_share == pytest.approx(6 / 12)  # of scans 8 to 19
    assert trial.error_m == 0.5 and not trial.is_lost_at_end and trial.n_particles == 7
    never = judge_recovery([Told(wrong, True)] * 40, truth)
    assert never.found_s == np.inf and never.told_share == 1.0


def test_displaced_poses_are_as_far_off_as_asked() -> None:
    rng, pose = np.random.default_rng(1), np.array([3.0, 4.0, 0.5])
    off = np.array([displace(pose, 20.0, 0.3, rng) for _ in range(50)]) - pose
    np.testing.assert_allclose(np.hypot(off[:, 0], off[:, 1]), 20.0)
    assert set(np.round(off[:, 2], 9)) == {-0.3, 0.3} and np.ptp(np.arctan2(off[:, 1], off[:, 0])) > 4.0


def test_outliers_are_as_many_as_asked() -> None:
    route = Route("09", np.zeros((4001, 3)), np.zeros((4000, 3)))
    steps = add_outliers(route, 0.05, np.random.default_rng(2)).steps
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    assert np.mean(lengths > 0.0) == pytest.approx(0.05, abs=0.01)
    assert lengths[lengths > 0.0].min() >= 0.5 and lengths.max() <= 2.0 and not route.steps.any()


@pytest.mark.slow
def test_the_real_route_is_held_and_found_again(real_root: Path) -> None:
    stage = set_stage(real_root, "02", FrontEnd(), max_scans=400)
    clouds = draw_session(stage, 1)
    spoiled = add_outliers(stage.route, 0.015, np.random.default_rng(1))
    for part in (stage, type(stage)(**{**vars(stage), "route": spoiled})):
        run = run_method(part, "rol", clouds, 1)
        errors = pose_errors(run.poses, stage.route.truth)
        assert rmse(errors.position_m) < 0.3 and not run.failures and run.is_lost.mean() < 0.1
    paper = run_method(stage, "paper", clouds, 1)
    assert np.isnan(paper.health).all() and not paper.is_lost.any() and len(paper.poses) == 400
    trial, updates, heard = kidnap(stage, 300, 1)
    assert trial.found_s <= 10.0 and trial.told_share > 0.8 and len(updates) == len(heard) == 60
