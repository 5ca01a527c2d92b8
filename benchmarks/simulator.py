"""How fast simulated sensors are, and where the time goes.

python benchmarks/simulator.py [--scans 40]      prints a table and writes build/benchmarks/simulator.json

Medians over scans of one process on one thread; the sessions of a trajectory are written by as many processes as wanted. With
the real data at hand the world is that of the route, without them the simulated town.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np

from rol.files import write_text
from rol.oxford import VelodyneRaw
from rol_book.parameters import positive
from rol_data import rall
from rol_sim.sensors import radar as radar_sensor
from rol_sim.sensors import radar_signal
from rol_sim.session import oxford_files
from rol_sim.session.settings import load_settings, sensor_settings
from rol_sim.session.simulation import SimulatedSession, build_session, make_scan, make_sweep

ROOT = Path(__file__).resolve().parents[1]


def build_benchmark_session() -> tuple[SimulatedSession, float]:
    """Build a session of the route, or of the town without the real data; return also the seconds it took."""
    config = "route" if rall.find_real_root() else "demo"
    settings = load_settings(ROOT / "config" / f"{config}.yaml")
    begin = perf_counter()
    session = build_session(settings, list(settings.sessions)[1])
    return session, perf_counter() - begin


def time_scan(session: SimulatedSession, index: int, folder: Path) -> dict[str, float]:
    """Time the parts of one radar scan [ms]."""
    settings = sensor_settings(session.settings)[1]
    stamp, turn = int(session.scans_us[index]), int(session.turns_us[index])
    rng = np.random.default_rng(index)
    times = stamp + (np.arange(400) + 0.5) * turn / 400
    marks = [perf_counter()]
    scene = session.scene_at(stamp + 0.5 * turn)
    marks.append(perf_counter())
    rays = radar_sensor.emit_rays(session.trajectory.pose(times), rng, settings)
    marks.append(perf_counter())
    rows, ranges, powers, _, _ = radar_sensor.trace_echoes(scene, rays, settings)
    marks.append(perf_counter())
    codes = radar_signal.echoes_to_codes(rows, radar_signal.range_to_bins(ranges), powers, rng)
    marks.append(perf_counter())
    scan = make_scan(session, index)
    whole = perf_counter() - marks[-1]
    begin = perf_counter()
    oxford_files.save_radar(folder / f"{scan.stamp_us}.png", scan)
    written = perf_counter() - begin
    assert codes.shape == scan.power.shape
    names = ("traffic", "rays sent", "rays traced", "signal")
    parts = dict(zip(names, np.diff(marks), strict=True))
    found = {**parts, "file written": written, "whole scan": whole + written, "echoes": len(rows) / 1000.0}
    return {name: 1000.0 * float(value) for name, value in found.items()}


def time_sweep(session: SimulatedSession, index: int, folder: Path) -> dict[str, float]:
    """Time one lidar sweep [ms]."""
    begin = perf_counter()
    sweep = make_sweep(session, "velodyne_left", index)
    made = perf_counter()
    raw = VelodyneRaw(sweep.intensities, sweep.ranges, sweep.angles, sweep.stamps_us)
    oxford_files.save_velodyne_raw(folder / "sweep.png", raw)
    return {"sweep": 1000.0 * (made - begin), "sweep written": 1000.0 * (perf_counter() - made)}


def main() -> None:
    """Measure, print, and write the table."""
    parser = argparse.ArgumentParser(description="How fast simulated sensors are, and where the time goes.")
    parser.add_argument("--scans", type=positive, default=40)
    given = parser.parse_args()
    session, built_s = build_benchmark_session()
    indices = np.linspace(5, len(session.scans_us) - 5, given.scans).astype(int)
    with tempfile.TemporaryDirectory() as folder:
        time_scan(session, int(indices[0]), Path(folder))  # compiles
        rows = [time_scan(session, int(i), Path(folder)) for i in indices]
        sweeps = [
            time_sweep(session, int(i), Path(folder)) for i in np.linspace(5, 2000, given.scans).astype(int)
        ]
    medians = {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
    medians |= {name: float(np.median([row[name] for row in sweeps])) for name in sweeps[0]}
    report = {
        "session": session.name,
        "triangles": len(session.scene.static_mesh.triangles),
        "world built [s]": built_s,
        **{f"{name} [ms]" if name != "echoes" else "echoes a scan": value for name, value in medians.items()},
        "scans a second": 1000.0 / medians["whole scan"],
        "sweeps a second": 1000.0 / (medians["sweep"] + medians["sweep written"]),
        "memory at most [GB]": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }
    for name, value in report.items():
        print(f"{name:22s} {value:,.3f}" if isinstance(value, float) else f"{name:22s} {value}")
    target = ROOT / "build" / "benchmarks" / "simulator.json"
    write_text(target, json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
