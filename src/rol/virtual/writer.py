"""The session writer: a virtual session on disk in Oxford's own files.

A session that was interrupted goes on with the same bytes: files that are there are whole (they get their
names last) and are kept. `settings.json` is written first and tells whether the files belong to the settings
at hand; `session.json` is written last and tells that the session is complete.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from .session import VirtualSession
    from .settings import VirtualSettings

FORMAT = 1  # raise it when the same settings give other files
LIDARS = ("velodyne_left", "velodyne_right")
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
    settings: VirtualSettings, name: str, root: Path | str, report: Callable[[str], None] = lambda line: None
) -> Path:
    """Write a session folder, or go on with one that was interrupted.

    Parameters
    ----------
    settings : VirtualSettings
        The settings.
    name : str
        The session, also the folder's name.
    root : path
        Folder of the sessions.
    report : callable
        Takes a line of text at the beginning, every tenth of the way and at the end.

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
    """
    from .session import build_session, sensor_settings
    from .settings import describe

    sensor_settings(settings)  # faults are told before anything is built
    folder = Path(root) / name
    if not _prepare_folder(folder, {"format": FORMAT, **describe(settings, name)}, report):
        return folder
    session = build_session(settings, name)
    n = len(session.scans_us)
    pending = {sensor: list(enumerate(session.chosen[sensor])) for sensor in LIDARS}
    for i in range(n):
        end = session.scans_us[i] + session.turns_us[i] if i < n - 1 else np.iinfo(np.int64).max
        _write_scan(folder, session, i)
        for sensor in LIDARS:
            while pending[sensor] and session.sweeps_us[sensor][pending[sensor][0][1]] < end:
                _write_sweep(folder, session, sensor, *pending[sensor].pop(0))
        if (i + 1) * 10 // n > i * 10 // n:
            report(f"{name}: {i + 1} of {n} scans")
    _write_logs(folder, session)
    report(f"{name}: complete")
    return folder


def _prepare_folder(folder: Path, wanted: dict[str, Any], report: Callable[[str], None]) -> bool:
    """Make the folder fit for these settings; False if the session in it is complete."""
    path, wanted = folder / "settings.json", json.loads(json.dumps(wanted))
    for leftover in folder.rglob(".*.tmp"):  # of a run that was killed
        leftover.unlink()
    found = None
    if path.exists():
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            found = {}
    elif folder.exists() and any(folder.iterdir()):
        raise ValueError(
            f"{folder}: not empty and without a settings.json, so it was not made by this program; left alone"
        )
    if found == wanted and (folder / "session.json").exists():
        report(f"{folder.name}: complete already")
        return False
    if found == wanted:
        report(f"{folder.name}: going on with what is there")
    elif found is not None:
        changed = sorted(key for key in {*found, *wanted} if found.get(key) != wanted.get(key))
        report(f"{folder.name}: settings changed ({', '.join(changed)}), starting anew")
        for entry in (folder / name for name in _MADE):
            if entry.is_dir():
                shutil.rmtree(entry)
            else:
                entry.unlink(missing_ok=True)
    _write_json(path, wanted)
    for name in ("radar", *LIDARS, "gt", "gps"):
        (folder / name).mkdir(exist_ok=True)
    return True


def _write_scan(folder: Path, session: VirtualSession, index: int) -> None:
    from ..oxford import save_radar
    from .session import make_scan

    path = folder / "radar" / f"{session.scans_us[index]}.png"
    if not path.exists():
        save_radar(path, make_scan(session, index))


def _write_sweep(folder: Path, session: VirtualSession, sensor: str, place: int, index: int) -> None:
    from ..oxford import VelodyneRaw, save_velodyne_raw
    from .session import make_sweep

    stamp, every = int(session.sweeps_us[sensor][index]), session.settings.labels_every
    path = folder / sensor / f"{stamp}.png"
    labels = folder / "labels" / sensor / path.name if every and place % every == 0 else None
    if path.exists() and (labels is None or labels.exists()):
        return
    sweep = make_sweep(session, sensor, int(index))
    if labels is not None:
        _write_image(labels, sweep.materials)
    save_velodyne_raw(path, VelodyneRaw(sweep.intensities, sweep.ranges, sweep.angles, sweep.stamps_us))


def _write_logs(folder: Path, session: VirtualSession) -> None:
    """Everything but scans and sweeps; session.json last."""
    from .. import oxford
    from ..evaluation import write_tum
    from . import logs
    from .session import GPS, INS, ODOMETRY

    scans, middles, settings = session.scans_us, session.scans_us + session.turns_us // 2, session.settings
    oxford.save_timestamps(folder / "radar.timestamps", scans)
    for sensor in LIDARS:
        oxford.save_timestamps(
            folder / f"{sensor}.timestamps", session.sweeps_us[sensor][session.chosen[sensor]]
        )
    truth = session.drive.pose(middles)
    steps = np.zeros((len(scans) - 2, 6))  # as in the data set, the last scan has no pose
    steps[:, [0, 1, 5]] = logs.drift_odometry(
        truth[:-1],
        session.generator(ODOMETRY),
        scale_spread=settings.odometry_scale,
        yaw_spread_rad=settings.odometry_yaw_rad,
    )
    oxford.save_radar_odometry(
        folder / "gt" / "radar_odometry.csv",
        oxford.RadarOdometry(middles[1:-1], middles[:-2], scans[1:-1], scans[:-2], steps),
    )
    oxford.save_gps(folder / "gps" / "gps.csv", logs.draw_gps(session.drive, session.generator(GPS)))
    oxford.save_ins(folder / "gps" / "ins.csv", logs.draw_ins(session.drive, session.generator(INS)))
    write_tum(folder / "truth.tum", scans, truth)
    _write_json(folder / "session.json", _summarise(session, truth))


def _summarise(session: VirtualSession, truth: np.ndarray) -> dict[str, Any]:
    from .settings import describe

    way = np.interp(
        [session.scans_us[0], session.scans_us[-1] + session.turns_us[-1]], session.drive.stamps_us,
        np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(session.drive.poses[:, :2], axis=0).T))]),
    )  # fmt: skip
    duration = float(session.scans_us[-1] + session.turns_us[-1] - session.scans_us[0]) * 1e-6
    return {
        "name": session.name,
        "made_by": "rol.virtual, a simulation: no real place, no real sensor",
        "format": FORMAT,
        "settings": describe(session.settings, session.name),
        "duration_s": round(duration, 3),
        "distance_m": round(float(way[1] - way[0]), 2),
        "n_scans": len(session.scans_us),
        "n_sweeps": {sensor: len(session.chosen[sensor]) for sensor in LIDARS},
        "start_pose_town": [round(float(v), 6) for v in truth[0]],
        "truth": "truth.tum: pose of the radar in the town at mid-scan, under the scan's own stamp",
    }


def _write_json(path: Path, values: dict[str, Any]) -> None:
    _write_bytes(path, (json.dumps(values, indent=2) + "\n").encode())


def _write_image(path: Path, image: np.ndarray) -> None:
    import cv2

    _write_bytes(path, cv2.imencode(".png", image)[1].tobytes())


def _write_bytes(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
