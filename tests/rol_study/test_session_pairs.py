"""Pairs of a session: only those that are missing are made."""

import pandas as pd

from rol.pairs import PairSettings, list_pairs
from rol_study import session_pairs


class Drive:
    """What `rol.pairs.describe_pairs` reads of a session."""

    def __init__(self, root):
        self.root, self.name = root, root.name


def test_missing_pairs_are_made_and_others_after_a_change(monkeypatch, tmp_path):
    def write_pairs(session, folder, aligned, settings, workers):
        for scan in aligned:
            for side in ("radar", "lidar"):
                path = folder / side / f"{scan.radar_stamp_us}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(b"png")
            yield scan.radar_stamp_us

    monkeypatch.setattr(session_pairs, "write_pairs", write_pairs)
    table = {"radar_stamp_us": [10, 20, 30], "mid_stamp_us": [11, 21, 31], "left_stamp_us": [9, 19, 29]}
    table |= {name: [0.0] * 3 for name in ("vx_mps", "vy_mps", "yaw_rate_radps")}
    alignment, folder = tmp_path / "alignment.csv", tmp_path / "pairs"
    pd.DataFrame(table).to_csv(alignment, index=False)

    def complete(**settings):
        made = session_pairs.complete_pairs(Drive(tmp_path), alignment, folder, PairSettings(**settings))
        return list(made)

    assert complete() == [10, 20, 30] and list_pairs(folder) == [10, 20, 30]
    assert complete() == []
    (folder / "lidar" / "20.png").unlink()
    assert complete() == [20]
    assert complete(min_height=-1.0) == [10, 20, 30]
