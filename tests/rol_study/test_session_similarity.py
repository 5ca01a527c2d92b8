"""Generated points of a small made-up session against its lidar points."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("torch")

from rol.pix2pix import TrainedNetwork
from rol_study import session_similarity as similarity
from rol_study.session_similarity import GeneratedSession

pytestmark = pytest.mark.torch


class MadeUpSession(GeneratedSession):
    """Four scans without files: lidar on one line, generated points one or eleven pixels beside it."""

    stamps_us = (1, 2, 3, 4)

    def pair(self, us: int) -> tuple[np.ndarray, np.ndarray]:
        radar, lidar = np.zeros((2, 64, 64), dtype=np.uint8)
        radar[10 + us, 20:30] = 200
        lidar[10 + us, 20:40] = 255
        return radar, lidar

    def image(self, us: int) -> np.ndarray:
        generated = np.zeros((64, 64), dtype=np.uint8)
        generated[11 + us, 20:30] = 200
        generated[22 + us, 20:30] = 140
        return generated

    def detected(self, us: int) -> dict[str, np.ndarray]:
        return {"cfar": self.lidar(us)[:3]}


@pytest.fixture
def session() -> MadeUpSession:
    return MadeUpSession("made-up", "", "", "", {"threshold": 128, "thin": False})


def test_scans_are_compared_both_ways(session: MadeUpSession) -> None:
    table, counts = similarity.compare_scans(session, np.array([0.0, 1.0, 2.0, 10.0]))
    assert table.radar_stamp_us.tolist() == [1, 2, 3, 4]
    assert (table.fake_to_real_within_1m == 0.5).all() and (table.n_real == 20).all()
    assert counts[0].tolist() == [40, 0, 40] and counts[1].sum() == 80


def test_thresholds_trade_number_for_precision(session: MadeUpSession) -> None:
    table = similarity.compare_thresholds([session], 2, [128, 160, 220])
    assert table.n_fake.tolist() == [20.0, 10.0, 0.0]
    assert table.fake_to_real_within_1m[160] == 1.0 and np.isnan(table.fake_to_real_within_1m[220])


def test_brightest_pixels_are_those_of_the_echo(session: MadeUpSession) -> None:
    points = similarity.brightest_pixels(session.pair(1)[0], 10)
    np.testing.assert_allclose(points[:, 0], (31.5 - 11) * 0.25)
    np.testing.assert_allclose(np.sort(points[:, 1]), np.sort((31.5 - np.arange(20, 30)) * 0.25))


def test_controls_are_worse_than_the_points_only_where_they_should_be(session: MadeUpSession) -> None:
    means = similarity.compare_controls([session], 4).groupby("points").fake_to_real_within_1m.mean()
    assert means["fake"] == 0.5 and means["brightest"] == 0.5  # half of as many pixels are empty
    assert means["chance"] <= 0.5 and means["cfar"] == 1.0


def test_networks_are_compared_with_and_without_thinning(
    session: MadeUpSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    stroke = np.zeros((64, 64), dtype=np.uint8)
    stroke[11:14, 20:30] = [[150], [200], [150]]
    monkeypatch.setattr(similarity, "generate", lambda generator, image, bf16: stroke)
    networks = {
        "plain": TrainedNetwork(None, {"threshold": 180, "thin": False}, {}, {}),
        "thin": TrainedNetwork(None, {"threshold": 128, "thin": True}, {}, {}),
    }
    table = pd.DataFrame(similarity.compare_networks([session], 1, networks))
    assert table.network.tolist() == ["plain", "thin", "thin, not thinned"]
    assert table.n_fake.tolist() == [10, 14, 30] and (table.n_real == 20).all()  # ends keep their corners
    assert (table.fake_to_real_within_1m == 1.0).all() and (table.radar_stamp_us == 1).all()


def test_motion_is_compensated_before_points_are_compared(
    session: MadeUpSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moving = GeneratedSession("made-up", tmp_path, tmp_path, "", session.points)
    moving.__dict__["stamps_us"] = [1, 2]
    (tmp_path / "alignment" / "made-up").mkdir(parents=True)
    motion = {"radar_stamp_us": [1, 2], "vx_mps": [0.5, 9.0], "vy_mps": 0.0, "yaw_rate_radps": 0.1}
    pd.DataFrame(motion).to_csv(tmp_path / "alignment" / "made-up" / "alignment.csv")
    asked = {}

    def read(folder: Path, stamps: list[int], twists: np.ndarray) -> list[np.ndarray]:
        asked.update(folder=folder, twists=twists)
        return [session.lidar(us) + (0.5, 0.0) for us in stamps]

    monkeypatch.setattr(similarity, "read_points", read)
    monkeypatch.setattr(similarity, "load_pair", lambda folder, us: session.pair(us))
    table = similarity.compare_compensated([moving])
    assert asked["folder"] == tmp_path / "fake" / "made-up" and asked["twists"][1].tolist() == [9.0, 0.0, 0.1]
    assert table.speed.tolist() == ["below 1", "above 7"] and (table.fake_to_real_within_1m == 1.0).all()
