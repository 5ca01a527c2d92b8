"""The reader of the RADIATE pairs, and what it says of files that are at fault."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rol_data import radiate


def make_sample(root: Path) -> Path:
    """One scan, two sweeps, in the sample's own files."""
    folder, calibration = root / radiate.PAIRS_PATH, root / radiate.CALIBRATION_PATH
    for name in ("Navtech_Polar", "velo_lidar"):
        (folder / name).mkdir(parents=True)
    calibration.parent.mkdir(parents=True)
    calibration.write_text("lidar_calib:\n    T: [0.5, -0.25, 0.125]\n    R: [0, 0, 0]\n", encoding="utf-8")
    (folder / "Navtech_Polar.txt").write_text("Frame: 000001 Time: 100.2\n", encoding="utf-8")
    (folder / "velo_lidar.txt").write_text(
        "Frame: 000007 Time: 100.1\nFrame: 000008 Time: 100.25\n", encoding="utf-8"
    )
    image = np.zeros((radiate.N_BINS, radiate.N_AZIMUTHS), dtype=np.uint8)
    image[120, 100] = 200
    cv2.imwrite(str(folder / "Navtech_Polar" / "000001.png"), image)
    for number in (7, 8):
        (folder / "velo_lidar" / f"{number:06d}.csv").write_text(
            f"1,{number},3,4,5\n2,2,2,2,2\n", encoding="utf-8"
        )
    return folder


def test_axes_and_times_of_a_pair(tmp_path: Path) -> None:
    make_sample(tmp_path)
    (pair,) = radiate.load_pairs(tmp_path)
    assert pair.lidar_path.name == "000008.csv" and pair.gap_s == pytest.approx(0.05)
    np.testing.assert_allclose(pair.points[0], [8.0 - 0.25, -1.0 - 0.5, 3.125, 4.0])
    assert pair.power.shape == (400, 576) and pair.power[100, 120] == 200
    assert radiate.radiate_azimuths()[100] == pytest.approx(-0.5 * np.pi)  # a quarter turn clockwise


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("Navtech_Polar.txt", None, "Navtech_Polar.txt: missing"),
        ("velo_lidar.txt", b"none", "velo_lidar.txt: holds no line"),
        ("Navtech_Polar.txt", b"Frame: 000002 Time: 1.0", "000001.png: has no time"),
        ("velo_lidar/000008.csv", b"1,2,3", "000008.csv: expected rows of five"),
        ("velo_lidar/000008.csv", b"a,b,c,d,e", "000008.csv: not a table"),
        ("Navtech_Polar/000001.png", b"", "000001.png: expected a grey image of 576 x 400, got None"),
        (
            "../../../config/default-calib.yaml",
            b"lidar_calib: {}",
            "default-calib.yaml: holds no lidar_calib",
        ),
    ],
)
def test_faults_are_named(tmp_path: Path, name: str, content: bytes | None, fault: str) -> None:
    path = make_sample(tmp_path) / name
    path.unlink() if content is None else path.write_bytes(content)
    with pytest.raises(radiate.RadiateError, match=fault):
        radiate.load_pairs(tmp_path)


def test_the_real_sample(real_root: Path) -> None:
    pairs = radiate.load_pairs(real_root)
    assert len(pairs) == 18 and max(abs(pair.gap_s) for pair in pairs) < 0.15
    assert all(pair.power.max() > 100 and len(pair.points) > 10_000 for pair in pairs)
