"""Write the pairs of a whole session, continuing where a run was stopped."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pandas as pd

from rol.oxford import Session
from rol.pairs import AlignedScan, PairSettings, describe_pairs, pair_folder, write_pairs


def complete_pairs(
    session: Session,
    alignment_path: str | Path,
    folder: str | Path,
    settings: PairSettings,
    workers: int = 1,
) -> Iterator[int]:
    """Write the pairs of a session that a folder lacks, and complete the folder.

    Pairs of other settings, another alignment or another session are made anew.

    Parameters
    ----------
    session : Session
        The session.
    alignment_path : path
        Its ``alignment.csv``.
    folder : path
        Folder of its pairs.
    settings : PairSettings
        Settings of the images.
    workers : int
        Processes.

    Yields
    ------
    stamp_us : int
        Radar stamp of each pair made [us].
    """
    alignment = pd.read_csv(alignment_path)
    description = describe_pairs(session, alignment_path, settings)
    present = pair_folder(folder).prepare(description)
    rows = [line for _, line in alignment.iterrows() if line.radar_stamp_us not in present]
    missing = [AlignedScan.from_row(line) for line in rows]
    yield from write_pairs(session, folder, missing, settings, workers)
    pair_folder(folder).finish(description, alignment.radar_stamp_us.tolist())
