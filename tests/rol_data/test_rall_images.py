"""Radar images of a session of the real route: names, sizes, and the polar scan behind an image."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

import rol_beyond.unet  # noqa: F401 (registers the network)
from rol.pix2pix import load_network
from rol.radar import MEASURED, SDK, polar_to_cartesian
from rol_beyond.front_ends import evaluate_on_map, generate_points
from rol_data import rall
from rol_data.rall import RallError, image_to_scan, load_radar_images

WEIGHTS = Path(__file__).resolve().parents[2] / "data" / "weights"
N = 4


def make_image(value: int = 90) -> np.ndarray:
    """A dark image with a bright spot 30 m ahead and 12 m to the left."""
    image = np.zeros((512, 512), dtype=np.uint8)
    image[round(255.5 - 30.0 / 0.25), round(255.5 - 12.0 / 0.25)] = value
    return cv2.GaussianBlur(image, (5, 5), 1.0) * 4


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A folder with the poses and images of a short session."""
    for path in (tmp_path / rall.POSES_PATH, tmp_path / rall.IMAGES_PATH / "seq02"):
        path.mkdir(parents=True)
    np.savetxt(tmp_path / rall.POSES_PATH / "pose_xy_02.txt", np.arange(3.0 * N).reshape(N, 3))
    for k in range(N):
        cv2.imwrite(str(tmp_path / rall.IMAGES_PATH / "seq02" / f"{k + 1}.png"), make_image(60 + k))
    return tmp_path


def test_images_come_in_the_order_of_their_numbers(root: Path) -> None:
    (root / rall.IMAGES_PATH / "seq02" / "preview.png").write_bytes(b"")  # no number, no scan
    images = load_radar_images(root)
    assert len(images) == N and images.truth[1].tolist() == [3.0, 4.0, 5.0]
    for k, image in enumerate(images):
        np.testing.assert_array_equal(image, make_image(60 + k))
    np.testing.assert_array_equal(images[-1], images[N - 1])


def test_a_folder_that_does_not_fit_is_refused(root: Path) -> None:
    folder = root / rall.IMAGES_PATH / "seq02"
    cv2.imwrite(str(folder / "5.png"), make_image())
    with pytest.raises(RallError, match="seq02: 5 images for the 4 poses of session 02"):
        load_radar_images(root)
    for name in ("5.png", "2.png", "3.png"):
        (folder / name).unlink()
    with pytest.raises(RallError, match=r"seq02: 2 of 4 images missing, the first: 2.png"):
        load_radar_images(root)
    with pytest.raises(RallError, match=r"pose_xy_07.txt: missing"):
        load_radar_images(root, "07")
    (root / rall.POSES_PATH / "pose_xy_07.txt").write_text("0 0 0\n", encoding="utf-8")
    with pytest.raises(RallError, match=r"seq07: missing; the README of the repository HuanYin94/RaLL"):
        load_radar_images(root, "07")


@pytest.mark.parametrize(
    ("image", "fault"),
    [
        (np.zeros((512, 500), np.uint8), "500 x 512 pixels instead of 512 x 512"),
        (np.zeros((512, 512, 3), np.uint8), "not grey with 8 bits"),
        (np.zeros((512, 512), np.uint16), "not grey with 8 bits"),
        (b"<html>sign in</html>", "not a PNG file"),
    ],
)
def test_an_image_of_another_form_is_named(root: Path, image: np.ndarray | bytes, fault: str) -> None:
    path = root / rall.IMAGES_PATH / "seq02" / "3.png"
    path.write_bytes(image if isinstance(image, bytes) else cv2.imencode(".png", image)[1].tobytes())
    with pytest.raises(RallError, match=f"3.png: {fault}"):
        load_radar_images(root)


def test_an_image_that_ends_early_is_named(root: Path) -> None:
    path = root / rall.IMAGES_PATH / "seq02" / "3.png"
    path.write_bytes(path.read_bytes()[:60])
    images = load_radar_images(root)
    with pytest.raises(RallError, match="3.png: not a whole grey image"):
        images[2]


def test_a_scan_shows_what_the_image_shows() -> None:
    scan = image_to_scan(make_image(), 7)
    row, column = np.unravel_index(np.argmax(scan.power), scan.power.shape)
    assert scan.azimuths[row] % (2.0 * np.pi) == pytest.approx(np.arctan2(12.0, 30.0), abs=0.012)
    assert (column + 0.5) * SDK.resolution_m == pytest.approx(np.hypot(12.0, 30.0), abs=0.3)
    assert scan.stamp_us == 7 and len(scan.power) == 400
    again = polar_to_cartesian(scan.power, scan.azimuths, calibration=SDK)
    spot = np.array(np.unravel_index(np.argmax(again), again.shape))
    np.testing.assert_allclose(spot, np.unravel_index(np.argmax(make_image()), (512, 512)), atol=1)


def test_the_calibration_of_the_image_is_undone() -> None:
    """A scan is made into an image with one calibration; back in bins, a peak is in its own bin."""
    azimuths = image_to_scan(make_image(), 0).azimuths
    power = np.zeros((400, 1400), dtype=np.uint8)
    power[101, 905] = 255
    power = cv2.GaussianBlur(power.astype(np.float32), (0, 0), sigmaX=12.0, sigmaY=2.0)
    power = np.rint(power / power.max() * 200.0).astype(np.uint8)
    for calibration in (SDK, MEASURED):
        image = np.rint(255.0 * polar_to_cartesian(power, azimuths, calibration=calibration)).astype(np.uint8)
        found = image_to_scan(image, 0, calibration).power.astype(float)[:, :1400]
        rows, bins = np.indices(found.shape)
        middle = [(found * index).sum() / found.sum() for index in (rows, bins)]
        np.testing.assert_allclose(middle, [101.0, 905.0], atol=0.5)


def test_points_of_the_network_are_those_of_the_scan_as_recorded(real_root: Path) -> None:
    """Three real scans, as the images of the public folder would show them: resampled by the SDK's convention."""
    scans, network = rall.load_scans(real_root)[::5], load_network(WEIGHTS / "unet.safetensors")
    tree = cKDTree(rall.load_map_points(real_root / rall.MAP_PATH))
    for scan in scans:
        image = polar_to_cartesian(scan.power, scan.azimuths, calibration=SDK)
        polar = image_to_scan(np.rint(255.0 * image).astype(np.uint8), 0)
        own, other = (
            generate_points(network, s.power, s.azimuths, scan.twist, tta_rotations=1)[0]
            for s in (scan, polar)
        )
        assert len(other) == pytest.approx(len(own), rel=0.1)
        assert (cKDTree(own).query(other)[0] < 0.5).mean() > 0.93
        shares = [evaluate_on_map(points, scan.pose, tree)["share_1m"] for points in (own, other)]
        assert shares[1] == pytest.approx(shares[0], abs=0.04)
