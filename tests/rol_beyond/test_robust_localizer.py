"""The robust localizer behind the same step: a simulated drive with known points, and the eleven real scans."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np

import rol_beyond.unet  # noqa: F401 (registers the network)
from rol.geometry import compose, invert, relative_pose, transform_points
from rol.pix2pix import load_network
from rol_beyond.front_ends import generate_points
from rol_beyond.motion import MotionModel
from rol_beyond.pipeline import RobustLocalizer
from rol_beyond.recovery import RecoveringFilter, RecoverySettings
from rol_beyond.robust import settings_for
from rol_data import rall

WEIGHTS = Path(__file__).resolve().parents[2] / "data" / "weights"


def test_points_are_compensated_with_the_velocity_of_the_odometry() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-60.0, 60.0, (600, 2))
    truth = np.column_stack([np.linspace(-10.0, 10.0, 21), np.zeros(21), np.zeros(21)])
    scans = [SimpleNamespace(stamp_us=250_000 * k, pose=pose) for k, pose in enumerate(truth)]
    twists = []

    def front_end(scan: SimpleNamespace) -> np.ndarray:
        cloud = transform_points(invert(scan.pose), points)
        cloud = cloud[np.hypot(*cloud.T) < 40.0]
        return cloud + rng.normal(0.0, 0.05, cloud.shape)

    settings = settings_for("robust", motion=MotionModel())
    robust_filter = RecoveringFilter(points, truth[0], settings, RecoverySettings(0.5), rng)
    localizer = RobustLocalizer(robust_filter, front_end, density_radius_m=1.0)

    def deskew(cloud: np.ndarray, twist: np.ndarray) -> np.ndarray:
        twists.append(twist)
        return cloud  # these points need none

    localizer.odometry.deskew = deskew
    found = []
    for scan in scans:
        found.append(localizer.step(scan))
        if len(found) > 5:  # the last call is that of the localizer
            np.testing.assert_allclose(twists[-1], (4.0, 0.0, 0.0), atol=0.5)
    off = np.hypot(*(np.array([scan.pose for scan in found]) - truth)[:, :2].T)
    assert off[4:].max() < 0.3 and not found[-1].update.is_lost
    assert found[-1].covariance.shape == (3, 3) and len(found[-1].points) > 100


def test_the_real_scans_are_localized_from_five_metres_off(real_root: Path) -> None:
    """From the fourth scan on within 0.6 m and 0.6 deg of the fitted poses."""
    scans, map_points = rall.load_scans(real_root), rall.load_map_points(real_root / rall.MAP_PATH)
    truth = np.array([scan.pose for scan in scans])
    near_map = map_points[np.hypot(*(map_points - truth[0, :2]).T) < 150.0]
    network = load_network(WEIGHTS / "unet.safetensors")

    def front_end(scan: rall.RealScan) -> np.ndarray:
        return generate_points(network, scan.power, scan.azimuths)[0]

    sigmas = (0.1, 0.05, np.deg2rad(0.3))
    spread = {"start_spread_m": 4.0, "start_spread_yaw_rad": np.deg2rad(4.0)}
    motion = MotionModel(sigma_stationary=sigmas, sigma_base=sigmas, sigma_per_metre=(0.03, 0.03, 0.0))
    settings = settings_for("robust", n_particles=40_000, max_particles=5000, motion=motion, **spread)
    start, rng = compose(truth[0], (0.0, 5.0, np.deg2rad(-5.0))), np.random.default_rng(1)
    robust_filter = RecoveringFilter(near_map, start, settings, RecoverySettings(0.239), rng)
    localizer = RobustLocalizer(robust_filter, front_end, density_radius_m=2.0)
    x, y, yaw = relative_pose(truth, np.array([localizer.step(scan).pose for scan in scans])).T
    assert np.hypot(x, y)[3:].max() < 0.6 and np.rad2deg(np.abs(yaw))[3:].max() < 0.6
