"""Sessions of the real route: consistency of their parts, evaluation of a recovery, sampled points at real poses."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from rol.evaluation import pose_errors, rmse
from rol.geometry import transform_points
from rol.radar import ScanMotion, compensate_points
from rol_beyond.motion import MotionModel
from rol_beyond.recovery import DetectionSettings, RecoverySettings
from rol_beyond.robust import settings_for
from rol_data import cfear, rall
from rol_study import route_experiments
from rol_study.oxford_route import (
    ODOMETRIES,
    RouteError,
    RouteSession,
    calibrate_on_another,
    exact_motion,
    list_sessions,
    load_session,
    published_motion,
    published_reference_contrast,
    select_sessions,
)
from rol_study.route_experiments import (
    RouteExperiment,
    add_outliers,
    change_front_end,
    cut_scans,
    displace,
    evaluate_recovery,
    first_lasting,
    kidnap,
    localize_globally,
    prepare_experiment,
    run_displaced,
    run_method,
    sample_session,
    skew_by_motion,
)
from rol_study.sampled_points import FrontEnd, SampledPointsError, VisiblePoints

MAP = np.array([[0.0, 0.0], [100.0, 100.0]])
MAP_ALL = np.array([[-2000.0, -2000.0], [2000.0, 2000.0]])  # holds any route


def write_route(
    root: Path, number: str, n: int = 60, n_steps: int | None = None, place: str = "oxford", **places: tuple
) -> Path:
    """Write poses along a line and their steps; `places` moves single poses."""
    poses = np.column_stack([np.linspace(0.0, 50.0, n), np.full(n, 50.0), np.zeros(n)])
    for row, position in places.items():
        poses[int(row[1:]), :2] = position
    steps = np.tile([50.0 / (n - 1), 0.0, 0.0], ((n - 1) if n_steps is None else n_steps, 1))
    for path, rows in (
        (root / rall.PLACES[place].poses.format(number), poses),
        (root / rall.PLACES[place].odometry.format(number), steps),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(path, rows)
    return root


def test_a_session_is_read_with_or_without_its_last_row(tmp_path: Path) -> None:
    for number, n_steps in (("03", 59), ("04", 60)):
        route = load_session(write_route(tmp_path, number, n_steps=n_steps), number, MAP)
        assert route.truth.shape == (60, 3) and route.increments.shape == (59, 3)
        np.testing.assert_allclose(route.true_increments, route.increments, atol=1e-6)
        assert np.diff(route.stamps_us).tolist() == [250_000] * 59
    assert list_sessions(tmp_path) == ["03", "04"]


@pytest.mark.parametrize("place", ["kaist", "dcc", "riverside"])
def test_another_place_has_its_own_files(tmp_path: Path, place: str) -> None:
    for number, n_steps in (("01", 59), ("02", 60), ("03", 58)):
        write_route(tmp_path, number, n_steps=n_steps, place=place)
        route = load_session(tmp_path, number, MAP, place)
        assert (route.place, len(route.truth)) == (place, 59 if number == "03" else 60)
        assert len(route.increments) == len(route.truth) - 1 == len(route.is_faulty) - 1
    assert list_sessions(tmp_path, place) == ["01", "02", "03"] and list_sessions(tmp_path) == []
    assert select_sessions(tmp_path, "all", place) == ["02", "03"]  # 01 made the map
    assert select_sessions(tmp_path, "01", place) == ["01"]
    model, other, _ = calibrate_on_another(tmp_path, "01", MAP, place)
    assert other == "02" and model != published_motion()
    for number in ("02", "03"):
        (tmp_path / rall.PLACES[place].poses.format(number)).unlink()
    assert calibrate_on_another(tmp_path, "01", MAP, place)[:2] == (MotionModel(), "")


def test_all_means_the_papers_sessions(tmp_path: Path) -> None:
    for number in ("01", "02", "08", "09", "10"):
        write_route(tmp_path, number)
    assert select_sessions(tmp_path, "all") == ["02", "08", "10"]
    assert select_sessions(tmp_path, "01") == ["01"]
    with pytest.raises(RouteError, match=r"oxford has no '07' with rall odometry .*: 01, 02, 08, 09, 10"):
        select_sessions(tmp_path, "07")
    with pytest.raises(RouteError, match=r"dcc has no '02' with true odometry at hand; there are: none"):
        select_sessions(tmp_path, "02", "dcc", "true")
    with pytest.raises(rall.RallError, match="place: 'paris' is unknown"):
        select_sessions(tmp_path, "all", "paris")


def test_a_scan_that_the_odometry_lacks_is_left_out(tmp_path: Path) -> None:
    repeated = write_route(tmp_path, "03", n=61, n_steps=59, place="dcc")
    path = repeated / rall.PLACES["dcc"].poses.format("03")
    poses = np.loadtxt(path)
    poses[30] = poses[29]
    np.savetxt(path, poses)
    route = load_session(tmp_path, "03", MAP, "dcc")
    np.testing.assert_allclose(route.truth, np.delete(poses, 30, axis=0))
    poses[30, 0] += 0.01
    np.savetxt(path, poses)
    np.testing.assert_allclose(load_session(tmp_path, "03", MAP, "dcc").truth, poses[:-1])


def test_the_real_odometry_of_dcc03_fits_before_and_after_the_missing_scan(real_root: Path) -> None:
    route = load_session(real_root, "03", MAP_ALL, "dcc")
    assert (len(route.truth), len(route.increments)) == (3002, 3001)
    lags = np.arange(-1.5, 1.51, 0.25)  # in scans; MulRan's ground truth is half a scan late
    for part in (np.arange(20, 118), np.arange(125, 375), np.arange(400, 2900)):
        steps = [np.interp(part + lag, np.arange(3001), route.true_increments[:, 0]) for lag in lags]
        errors = [np.median(np.abs(step - 0.98 * route.increments[part, 0])) for step in steps]
        assert -0.8 < lags[int(np.argmin(errors))] < -0.2


@pytest.mark.parametrize("odometry", ODOMETRIES)
def test_the_odometry_of_a_session_can_be_chosen(tmp_path: Path, odometry: str) -> None:
    for number in ("01", "02", "07"):
        write_route(tmp_path, number)
        if number in cfear.FILES:
            path = cfear.find_cfear(tmp_path, number)
            path.parent.mkdir(parents=True)
            rows = [f"1 0 0 {0.9 * k} 0 1 0 0 0 0 1 0" for k in range(59)]  # the last pose is missing
            path.write_text("\n".join(rows), encoding="utf-8")
    numbers = ["01", "02"] if odometry == "cfear" else ["01", "02", "07"]
    assert list_sessions(tmp_path, odometry=odometry) == numbers
    route = load_session(tmp_path, "02", MAP, odometry=odometry)
    assert (len(route.truth), len(route.increments), len(route.is_faulty), route.odometry) == (
        *((59, 58, 59) if odometry == "cfear" else (60, 59, 60)),
        odometry,
    )
    step = {"rall": 50.0 / 59, "cfear": 0.9, "true": 50.0 / 59}[odometry]
    np.testing.assert_allclose(
        route.increments, np.tile((step, 0.0, 0.0), (len(route.increments), 1)), atol=1e-9
    )
    model, other, poses = calibrate_on_another(tmp_path, "02", MAP, odometry=odometry)
    assert other == "01" and len(poses) == len(route.truth)
    assert (model == exact_motion()) == (odometry == "true")


def test_odometries_that_are_not_there_are_named(tmp_path: Path) -> None:
    write_route(tmp_path, "07")
    write_route(tmp_path, "02", place="kaist")
    for odometry in ("wheels", "cfear-3"):
        with pytest.raises(
            RouteError, match=f"odometry: '{odometry}' is unknown; there are rall, cfear, true"
        ):
            load_session(tmp_path, "07", MAP, odometry=odometry)
        with pytest.raises(RouteError, match=f"odometry: '{odometry}' is unknown"):
            list_sessions(tmp_path, odometry=odometry)
    with pytest.raises(RouteError, match="CFEAR's is published for Oxford only, not for kaist"):
        load_session(tmp_path, "02", MAP, "kaist", "cfear")
    with pytest.raises(cfear.CfearError, match="session 07 is not published"):
        load_session(tmp_path, "07", MAP, odometry="cfear")
    (tmp_path / rall.PLACES["oxford"].odometry.format("07")).unlink()
    assert load_session(tmp_path, "07", MAP, odometry="true").is_faulty is None
    with pytest.raises(rall.RallError, match=r"seq07_odom.txt: missing"):
        load_session(tmp_path, "07", MAP)


def test_a_part_of_a_session() -> None:
    truth = np.column_stack([np.arange(10.0), np.zeros((10, 2))])
    route = RouteSession("02", truth, np.diff(truth, axis=0) * 0.9, "dcc", "cfear", np.arange(10) > 6)
    part = route.part(5, 8)
    assert part.truth[:, 0].tolist() == [5.0, 6.0, 7.0] and part.is_faulty.tolist() == [False, False, True]
    assert part.increments.shape == (2, 3) and (part.place, part.odometry) == ("dcc", "cfear")
    whole = replace(route, is_faulty=None).part(0)
    assert len(whole.truth) == 10 and len(whole.increments) == 9 and whole.is_faulty is None


def test_parts_that_do_not_belong_together_are_named(tmp_path: Path) -> None:
    with pytest.raises(
        RouteError, match=r"seq03_odom.txt: 57 increments for the 60 poses of pose_xy_03.txt; 59 needed"
    ):
        load_session(write_route(tmp_path, "03", n_steps=57), "03", MAP)
    with pytest.raises(RouteError, match=r"pose_xy_05.txt: pose 8 at \(900.0, 1.0\) m is outside the map"):
        load_session(write_route(tmp_path, "05", p7=(900.0, 1.0)), "05", MAP)
    with pytest.raises(rall.RallError, match=r"pose_xy_06.txt: row 3 is not finite"):
        load_session(write_route(tmp_path, "06", p2=(np.nan, 1.0)), "06", MAP)
    with pytest.raises(rall.RallError, match=r"pose_xy_99.txt: missing"):
        load_session(tmp_path, "99", MAP)


def test_motion_is_calibrated_on_another_session_if_there_is_one(tmp_path: Path) -> None:
    root = write_route(tmp_path, "03")
    model, other, poses = calibrate_on_another(root, "03", MAP)
    assert model == published_motion() and other == "" and poses.shape == (0, 3)
    model, other, _ = calibrate_on_another(write_route(root, "01", n=80), "03", MAP)
    assert other == "01" and model != published_motion()


def test_the_published_motion_is_that_of_session_01(real_root: Path) -> None:
    taught, kept = calibrate_on_another(real_root, "02", MAP_ALL)[0], published_motion()
    for name in ("sigma_stationary", "sigma_base", "sigma_per_metre"):
        np.testing.assert_allclose(getattr(kept, name), getattr(taught, name), atol=0.002)
    for name in ("matrix", "stationary_matrix"):
        np.testing.assert_allclose(
            np.diag(getattr(kept, name))[[0, 2]], np.diag(getattr(taught, name))[[0, 2]], atol=0.01
        )
    assert kept.matrix[1][2] == pytest.approx(taught.matrix[1][2], abs=0.05)


def test_the_published_contrast_is_that_of_session_01(real_root: Path) -> None:
    experiment = prepare_experiment(real_root, "02", FrontEnd(), max_scans=3)
    for front_end in (FrontEnd(), FrontEnd(0.50, 0.70), FrontEnd(0.65, 0.80), FrontEnd(0.80, 0.90)):
        taught = change_front_end(experiment, front_end)
        assert taught.calibration_session == "01"
        assert published_reference_contrast(front_end.fraction_1m) == pytest.approx(
            taught.reference_contrast, abs=0.003
        )
    assert 0.048 < published_reference_contrast(0.45) < 0.1 and published_reference_contrast(
        0.3
    ) == published_reference_contrast(0.4)


def test_a_session_alone_is_not_calibrated_on_itself(real_root: Path, tmp_path: Path) -> None:
    for name in (rall.MAP_PATH, f"{rall.POSES_PATH}/pose_xy_02.txt", f"{rall.ODOMETRY_PATH}/seq02_odom.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).symlink_to(real_root / name)
    experiment = prepare_experiment(tmp_path, "02", FrontEnd(), max_scans=3)
    assert (experiment.calibration_session, experiment.reference_contrast, experiment.motion) == (
        "",
        published_reference_contrast(0.4),
        published_motion(),
    )


def test_another_front_end_is_the_same_as_prepared_with_it(real_root: Path) -> None:
    better = FrontEnd(0.47, 0.65)
    changed = change_front_end(prepare_experiment(real_root, "02", FrontEnd(), max_scans=3), better)
    prepared = prepare_experiment(real_root, "02", better, max_scans=3)
    assert changed.front_end == better and len(changed.session.truth) == 3
    np.testing.assert_array_equal(changed.parts, prepared.parts)
    assert changed.reference_contrast == prepared.reference_contrast


def test_sessions_whose_points_cannot_be_sampled_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def prepare(real_root, number, front_end, *, place):
        if number == "02":
            raise SampledPointsError("the map is too dense")
        return real_root, number, front_end, place

    monkeypatch.setattr(route_experiments, "prepare_experiment", prepare)
    experiments, left_out = route_experiments.prepare_sessions("", ["01", "02"], FrontEnd(), place="dcc")
    assert experiments == {"01": ("", "01", FrontEnd(), "dcc")} and left_out == {"02": "the map is too dense"}


@pytest.fixture(scope="module")
def street() -> tuple[RouteSession, np.ndarray, list[np.ndarray]]:
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
    return RouteSession("09", truth, steps), posts, clouds


@pytest.mark.parametrize("begin", [kidnap, localize_globally])
@pytest.mark.parametrize("first", [-20, 40])
def test_a_start_at_no_scan_of_the_session_is_refused(street: tuple, begin: Callable, first: int) -> None:
    route, posts, _ = street
    experiment = RouteExperiment(
        route, posts, FrontEnd(), None, route.truth, route.truth, None, MotionModel(), "", 0.2, None
    )
    with pytest.raises(ValueError, match=f"first: {first} is no scan of session .*, which has 40"):
        begin(experiment, first, 1)


def test_points_are_skewed_by_the_motion_of_their_own_scan(street: tuple) -> None:
    route, _, clouds = street
    skewed = skew_by_motion(clouds, route.true_increments)
    for index in (0, 20, 39):
        twist = route.true_increments[min(index, 38)] / 0.25
        again = compensate_points(skewed[index], ScanMotion(twist))
        x, y = clouds[index].T
        near = (np.hypot(x, y) < 50.0) & (np.abs(np.arctan2(y, x)) > 0.2)  # away from the turn's beginning
        moved = np.hypot(*(skewed[index] - clouds[index])[near].T)
        assert 0.5 < moved.max() < 1.5 and np.abs(again - clouds[index])[near].max() < 0.15 * moved.max()
    still = skew_by_motion(clouds, np.zeros((39, 3)))
    np.testing.assert_allclose(still[7], clouds[7], atol=1e-9)


def test_a_run_takes_the_registration_and_other_recovery_settings(street: tuple) -> None:
    route, posts, clouds = street
    experiment = RouteExperiment(
        route,
        posts,
        FrontEnd(),
        None,
        route.truth,
        route.truth,
        None,
        MotionModel(),
        "",
        0.2,
        settings_for("robust").measurement.build_grid(posts),
    )
    alone = run_method(experiment, "registration", clouds, 1)
    assert np.isnan(alone.covariances).all() and not alone.n_particles.any()
    wrong = [transform_points((9.0, 7.0, 0.3), cloud) for cloud in clouds]
    told = run_method(experiment, "robust", wrong, 1)
    blind = RecoverySettings(0.2, detection=DetectionSettings(search_below=-np.inf, lost_below=-np.inf))
    quiet = run_method(experiment, "robust", wrong, 1, recovery=blind)
    assert told.is_lost.any() and not quiet.is_lost.any()
    assert told.n_particles.max() > 1000 >= quiet.n_particles.max()


@dataclass
class Reported:
    """Fields of an update that are evaluated."""

    pose: np.ndarray
    is_lost: bool
    n_particles: int = 7


def test_recovery_is_evaluated_by_the_first_estimate_that_stays_right() -> None:
    truth, wrong, right = np.zeros((40, 3)), np.array([9.0, 0.0, 0.0]), np.array([0.5, 0.0, 0.0])
    updates = [Reported(right if k in (3, 4) or k >= 20 else wrong, is_lost=k < 14) for k in range(40)]
    trial = evaluate_recovery(updates, truth)
    assert trial.found_s == 5.0  # scans 3 and 4 did not last
    assert trial.told_share == pytest.approx(6 / 12)  # of scans 8 to 19
    assert trial.error_m == 0.5 and not trial.is_lost_at_end and trial.n_particles == 7
    never = evaluate_recovery([Reported(wrong, True)] * 40, truth)
    assert never.found_s == np.inf and never.told_share == 1.0


def test_an_estimate_must_stay_right() -> None:
    assert first_lasting(np.arange(20) >= 6) == 1.5 and first_lasting(np.arange(20) >= 13) == np.inf
    assert first_lasting(np.ones(7, dtype=bool)) == np.inf


def test_scans_are_cut_with_what_is_visible_from_them(street: tuple) -> None:
    route, posts, _ = street
    visible = VisiblePoints(np.arange(80).reshape(40, 2), np.arange(41))
    others = FrontEnd(), visible, route.truth, route.truth, None, MotionModel(), "", 0.2, None
    part = cut_scans(RouteExperiment(route, posts, *others), 35, 100)
    np.testing.assert_array_equal(part.session.truth, route.truth[35:])
    np.testing.assert_allclose([part.visible[k][0, 0] for k in range(5)], 0.02 * np.arange(35, 40))


def test_the_papers_filter_returns_from_a_near_start_only(street: tuple) -> None:
    route, posts, clouds = street
    grid = settings_for("paper", cell_m=0.25).measurement.build_grid(posts)
    others = FrontEnd(), None, route.truth, route.truth, None, MotionModel(), "", 0.2, grid
    experiment = RouteExperiment(route, posts, *others)
    near, far = (
        run_displaced(experiment, route.truth[0] + (off_m, 0.0, 0.0), clouds, 1) for off_m in (-2.0, -200.0)
    )
    assert near[0] > 1.0 and near[-1] < 0.5 and far.min() > 100.0  # no reset


def test_displaced_poses_are_as_far_off_as_asked() -> None:
    rng, pose = np.random.default_rng(1), np.array([3.0, 4.0, 0.5])
    off = np.array([displace(pose, 20.0, 0.3, rng) for _ in range(50)]) - pose
    np.testing.assert_allclose(np.hypot(off[:, 0], off[:, 1]), 20.0)
    assert set(np.round(off[:, 2], 9)) == {-0.3, 0.3} and np.ptp(np.arctan2(off[:, 1], off[:, 0])) > 4.0


def test_outliers_are_as_many_as_asked() -> None:
    route = RouteSession("09", np.zeros((4001, 3)), np.zeros((4000, 3)))
    steps = add_outliers(route, 0.05, np.random.default_rng(2)).increments
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    assert np.mean(lengths > 0.0) == pytest.approx(0.05, abs=0.01)
    assert lengths[lengths > 0.0].min() >= 0.5 and lengths.max() <= 2.0 and not route.increments.any()


@pytest.mark.slow
def test_the_real_route_is_held_and_found_again(real_root: Path) -> None:
    experiment = prepare_experiment(real_root, "02", FrontEnd(), max_scans=400)
    clouds = sample_session(experiment, 1)
    disturbed = add_outliers(experiment.session, 0.015, np.random.default_rng(1))
    for part in (experiment, type(experiment)(**{**vars(experiment), "session": disturbed})):
        run = run_method(part, "robust", clouds, 1)
        errors = pose_errors(run.poses, experiment.session.truth)
        assert rmse(errors.position_m) < 0.3 and not run.failures and run.is_lost.mean() < 0.1
    paper = run_method(experiment, "paper", clouds, 1)
    assert not paper.is_lost.any() and len(paper.poses) == 400
    trial, updates, heard = kidnap(experiment, 300, 1)
    assert trial.found_s <= 10.0 and trial.told_share > 0.8 and len(updates) == len(heard) == 60
