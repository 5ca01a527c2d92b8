"""Write simulated sessions to disk, in the file formats of the data set.

An interrupted session is continued with the same bytes: existing files are whole (they get their
names last) and are kept. `settings.json` is written first: it shows whether the files belong to the current
settings. `session.json` is written last: it marks the session as complete.
"""

from __future__ import annotations

import errno
import json
import multiprocessing
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import numpy as np

from rol.evaluation import write_tum
from rol.files import is_used, read_marker, write_bytes, write_text
from rol.oxford import LIDARS, RadarOdometry, VelodyneRaw
from rol_sim.session import logs, oxford_files
from rol_sim.session.settings import SimulationSettings, describe, sensor_settings
from rol_sim.session.simulation import (
    GPS,
    INS,
    ODOMETRY,
    SimulatedSession,
    build_session,
    make_scan,
    make_sweep,
)

SCAN_BYTES, SWEEP_BYTES = 470_000, 65_000  # what a file takes on the mean
FORMAT = 5  # raise it when the same settings give other files
_MADE = (
    "session.json",
    "truth.tum",
    "radar",
    *LIDARS,
    "labels",
    "gt",
    "gps",
    "radar.timestamps",
    *(f"{s}.timestamps" for s in LIDARS),
)


def write_session(
    settings: SimulationSettings,
    name: str,
    root: Path | str,
    report: Callable[[str], None] = lambda line: None,
    *,
    jobs: int = 1,
) -> Path:
    """Write a session folder, or go on with one that was interrupted.

    Parameters
    ----------
    settings : SimulationSettings
        The settings.
    name : str
        The session, also the folder's name.
    root : path
        Folder of the sessions.
    report : callable
        Takes a line of text: what will be written and how large it is, how far it has come, the end.
    jobs : int
        Processes that write at once. The files are the same whatever their number.

    Returns
    -------
    folder : Path
        The session's folder.

    Raises
    ------
    SettingsError
        If there is no such session, or a sensor's setting does not exist.
    ValueError
        If the folder holds files that were not made by this program.
    OSError
        If the disk has less free space than the session needs, or is full.
    """
    sensor_settings(settings)  # report faults before anything is built
    folder = Path(root) / name
    if not _prepare_folder(folder, {"format": FORMAT, **describe(settings, name)}, report):
        return folder
    session = build_session(settings, name)
    report(f"{name}: {_check_disk_space(folder, session)}")
    n = len(session.scans_us)
    edges = np.unique(np.linspace(0, n, min(n, max(20, n // 50)) + 1).astype(int)).tolist()
    begin = perf_counter()
    for done in _write_stretches(folder, session, list(pairwise(edges)), jobs):
        rate = done / max(perf_counter() - begin, 1e-9)
        left = f", {rate:.1f} a second, {(n - done) / rate:.0f} s left" if done < n else ""
        report(f"{name}: {done} of {n} scans{left}")
    _write_logs(folder, session)
    report(f"{name}: complete")
    return folder


def _check_disk_space(folder: Path, session: SimulatedSession) -> str:
    """Compute how much will be written; refuse if the disk has too little free space.

    Parameters
    ----------
    folder : Path
        The session's folder, which exists; what is there already is not counted again.
    session : SimulatedSession
        The session.

    Returns
    -------
    line : str
        Numbers of scans and sweeps, size, free space.

    Raises
    ------
    OSError
        If less is free than is needed.
    """
    sweeps = sum(len(session.chosen[sensor]) for sensor in LIDARS)
    whole = len(session.scans_us) * SCAN_BYTES + sweeps * SWEEP_BYTES
    there = sum(path.stat().st_size for part in ("radar", *LIDARS) for path in (folder / part).glob("*"))
    needed, free = max(whole - there, 0), shutil.disk_usage(folder).free
    line = (
        f"{len(session.scans_us)} scans and {sweeps} sweeps, about {whole / 1e9:.2f} GB in all, "
        f"{needed / 1e9:.2f} GB of them to be written; {free / 1e9:.1f} GB are free"
    )
    if free < needed:
        raise OSError(errno.ENOSPC, f"not enough disk space: {line}", str(folder))
    return line


def _write_stretches(
    folder: Path, session: SimulatedSession, segments: list[tuple[int, int]], jobs: int
) -> Iterator[int]:
    """Write all scans and sweeps; yield the number of scans after each segment."""
    done = 0
    if jobs <= 1:
        for first, end in segments:
            _write_segment(folder, session, first, end)
            yield end
        return
    context = multiprocessing.get_context("spawn")  # a fork would inherit the ray caster's locks
    given = (folder, session.settings, session.name)
    with ProcessPoolExecutor(jobs, context, initializer=_open_worker, initargs=given) as pool:
        waiting = {pool.submit(_work, *segment): segment for segment in segments}
        try:
            for finished in as_completed(waiting):
                finished.result()
                done += waiting[finished][1] - waiting[finished][0]
                yield done
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


_worker: tuple[Path, SimulatedSession] | None = None


def _open_worker(folder: Path, settings: SimulationSettings, name: str) -> None:
    """Build the session once in each process."""
    global _worker
    _worker = folder, build_session(settings, name)


def _work(first: int, end: int) -> None:
    assert _worker is not None
    _write_segment(*_worker, first, end)


def _write_segment(folder: Path, session: SimulatedSession, first: int, end: int) -> None:
    """Write some scans and the sweeps that begin during them, or before the first and after the last one."""
    n = len(session.scans_us)
    low = session.scans_us[first] if first > 0 else np.iinfo(np.int64).min
    high = session.scans_us[end] if end < n else np.iinfo(np.int64).max
    for index in range(first, end):
        _write_scan(folder, session, index)
    for sensor in LIDARS:
        begins = session.sweeps_us[sensor][session.chosen[sensor]]
        for place in np.flatnonzero((begins >= low) & (begins < high)):
            _write_sweep(folder, session, sensor, int(place), int(session.chosen[sensor][place]))


def _prepare_folder(folder: Path, wanted: dict[str, Any], report: Callable[[str], None]) -> bool:
    """Prepare the folder for these settings; return False if the session in it is complete."""
    path, wanted = folder / "settings.json", json.loads(json.dumps(wanted))
    found = read_marker(path)
    if not {"format", "session"} <= found.keys() and is_used(folder):
        raise ValueError(
            f"{folder}: not empty and without a settings.json of this program, so it was not made by it; left alone"
        )
    for leftover in folder.rglob(".*.tmp"):  # of a run that was killed
        leftover.unlink()
    if found == wanted and (folder / "session.json").exists():
        report(f"{folder.name}: complete already")
        return False
    if found == wanted:
        report(f"{folder.name}: going on with what is there")
    elif found:
        changed = sorted(key for key in {*found, *wanted} if found.get(key) != wanted.get(key))
        report(f"{folder.name}: settings changed ({', '.join(changed)}), starting anew")
        for entry in (folder / name for name in _MADE):
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink(missing_ok=True)
    _write_json(path, wanted)
    for name in ("radar", "gt", "gps"):
        (folder / name).mkdir(exist_ok=True)
    return True


def _write_scan(folder: Path, session: SimulatedSession, index: int) -> None:
    path = folder / "radar" / f"{session.scans_us[index]}.png"
    if not path.exists():
        oxford_files.save_radar(path, make_scan(session, index))


def _write_sweep(folder: Path, session: SimulatedSession, sensor: str, place: int, index: int) -> None:
    (folder / sensor).mkdir(exist_ok=True)
    stamp, every = int(session.sweeps_us[sensor][index]), session.settings.labels_every
    path = folder / sensor / f"{stamp}.png"
    labels = folder / "labels" / sensor / path.name if every and place % every == 0 else None
    if path.exists() and (labels is None or labels.exists()):
        return
    sweep = make_sweep(session, sensor, int(index))
    if labels is not None:
        _write_image(labels, sweep.materials)
    oxford_files.save_velodyne_raw(
        path, VelodyneRaw(sweep.intensities, sweep.ranges, sweep.angles, sweep.stamps_us)
    )


def _write_logs(folder: Path, session: SimulatedSession) -> None:
    """Everything but scans and sweeps; session.json last."""
    scans, middles, settings = session.scans_us, session.scans_us + session.turns_us // 2, session.settings
    oxford_files.save_timestamps(folder / "radar.timestamps", scans)
    for sensor in LIDARS:
        if len(
            session.chosen[sensor]
        ):  # a session without sweeps looks like one whose lidars were not fetched
            chosen = session.sweeps_us[sensor][session.chosen[sensor]]
            oxford_files.save_timestamps(folder / f"{sensor}.timestamps", chosen)
    truth = session.trajectory.pose(middles)
    steps = np.zeros((len(scans) - 2, 6))  # as in the data set, the last scan has no pose
    steps[:, [0, 1, 5]] = logs.drift_odometry(
        truth[:-1],
        session.generator(ODOMETRY),
        scale_spread=settings.odometry_scale,
        yaw_spread_rad=settings.odometry_yaw_rad,
    )
    oxford_files.save_radar_odometry(
        folder / "gt" / "radar_odometry.csv",
        RadarOdometry(middles[1:-1], middles[:-2], scans[1:-1], scans[:-2], steps),
    )
    oxford_files.save_gps(
        folder / "gps" / "gps.csv", logs.draw_gps(session.trajectory, session.generator(GPS))
    )
    oxford_files.save_ins(
        folder / "gps" / "ins.csv", logs.draw_ins(session.trajectory, session.generator(INS))
    )
    write_tum(folder / "truth.tum", scans, truth)
    _write_json(folder / "session.json", _summarise(session, truth))


def _summarise(session: SimulatedSession, truth: np.ndarray) -> dict[str, Any]:
    way = np.interp(
        [session.scans_us[0], session.scans_us[-1] + session.turns_us[-1]],
        session.trajectory.stamps_us,
        np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(session.trajectory.poses[:, :2], axis=0).T))]),
    )
    duration = float(session.scans_us[-1] + session.turns_us[-1] - session.scans_us[0]) * 1e-6
    return {
        "name": session.name,
        "made_by": "rol_sim, a simulation: no real place, no real sensor",
        "format": FORMAT,
        "settings": describe(session.settings, session.name),
        "duration_s": round(duration, 3),
        "distance_m": round(float(way[1] - way[0]), 2),
        "n_scans": len(session.scans_us),
        "n_sweeps": {sensor: len(session.chosen[sensor]) for sensor in LIDARS},
        "start_pose_world": [round(float(v), 6) for v in truth[0]],
        "truth": "truth.tum: pose of the radar in the world at mid-scan, under the scan's own stamp",
    }


def _write_json(path: Path, values: dict[str, Any]) -> None:
    write_text(path, json.dumps(values, indent=2) + "\n")


def _write_image(path: Path, image: np.ndarray) -> None:
    write_bytes(path, cv2.imencode(".png", image)[1].tobytes())
