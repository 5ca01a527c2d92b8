"""Runs over the scans of a session: the filters, and registration without a filter.

A run keeps the estimates, diagnostics and times of all scans, but not the particles, so that its memory stays
small on a long session.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, MutableSequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd

from rol.evaluation import FailureMonitor, FailureRule, summarize
from rol.mcl import ParticleFilter, localize
from rol_beyond.recovery import RecoveringFilter
from rol_beyond.scan_matching import ScanToMapSettings, scan_to_map_icp

DIAGNOSTICS = ["ess", "spread_m", "spread_yaw_rad", "inlier_ratio", "n_points", "measurement_used"]


@dataclass(frozen=True)
class FilterRun:
    """Results of one run over a session, scan by scan.

    Attributes
    ----------
    poses : array, shape (n, 3)
        Estimates T_map_radar [m, m, rad].
    covariances : array, shape (n, 3, 3)
        Of the particles [m, m, rad].
    failures : list of int
        Scans at which the run failed by the rule of failures.
    is_lost : array of bool, shape (n,)
        The filter reported that it was lost; never with the method `paper`.
    n_particles : array of int, shape (n,)
        Particles.
    update_ms : array, shape (n,)
        Time of each update [ms].
    diagnostics : DataFrame
        Fields `DIAGNOSTICS` of `rol.mcl.MclUpdate`, one row per scan; no columns without a filter.
    """

    poses: np.ndarray
    covariances: np.ndarray
    failures: list[int]
    is_lost: np.ndarray
    n_particles: np.ndarray
    update_ms: np.ndarray
    diagnostics: pd.DataFrame

    def summarize(self, truth: np.ndarray, method: str, session: str, seed: int) -> dict:
        """Compute the metrics of the run by `rol.evaluation.summarize`."""
        median_ms = float(np.median(self.update_ms))
        names = {"method": method, "session": session, "seed": seed, "failures": len(self.failures)}
        return summarize(self.poses, truth, update_ms_median=median_ms, **names)


def run_filter(
    particle_filter: ParticleFilter | RecoveringFilter,
    increments: Iterable[np.ndarray],
    clouds: Iterable[np.ndarray],
    monitor: FailureMonitor | None = None,
    particles: MutableSequence | None = None,
) -> FilterRun:
    """Run a filter over the scans of a session.

    Parameters
    ----------
    particle_filter : ParticleFilter or RecoveringFilter
        Filter at the first pose.
    increments : iterable of array, shape (3,)
        Odometry between successive scans [m, m, rad].
    clouds : iterable of array, shape (m, 2)
        Points of each scan in the radar frame [m].
    monitor : FailureMonitor, optional
        Records failures and resets the filter to the ground truth after each. Without it there are no resets
        and no failures; `find_failures` finds them afterwards.
    particles : mutable sequence, optional
        The particles of each scan are appended to it, such as a `rol.array_file.ArrayFile`.

    Returns
    -------
    run : FilterRun
        Yin et al. 2020, Sec. III-B and IV-C.
    """
    rows, diagnostics, update_ms = [], [], []
    for update, ms in _measure_times(localize(particle_filter, increments, clouds, monitor)):
        mcl = getattr(update, "filter", update)  # that of the robust filter holds one
        n_particles = getattr(update, "n_particles", len(mcl.particles))
        rows.append((update.pose, update.covariance, getattr(update, "is_lost", False), n_particles))
        diagnostics.append([getattr(mcl, name) for name in DIAGNOSTICS])
        update_ms.append(ms)
        if particles is not None:
            particles.append(mcl.particles)
    poses, covariances, *flags = (np.array(column) for column in zip(*rows, strict=True))
    failures, table = monitor.failures if monitor else [], pd.DataFrame(diagnostics, columns=DIAGNOSTICS)
    return FilterRun(poses, covariances, failures, *flags, np.array(update_ms), table)


def run_registration(
    increments: Iterable[np.ndarray],
    clouds: Iterable[np.ndarray],
    map_points: np.ndarray,
    monitor: FailureMonitor,
    settings: ScanToMapSettings | None = None,
) -> FilterRun:
    """Register each cloud to the map by ICP, without a filter, from the first true pose on.

    Parameters
    ----------
    increments : iterable of array, shape (3,)
        Odometry between successive scans [m, m, rad].
    clouds : iterable of array, shape (m, 2)
        Points of each scan in the radar frame [m].
    map_points : array, shape (k, 2)
        Map [m].
    monitor : FailureMonitor
        Records failures and resets the pose to the ground truth after each.
    settings : ScanToMapSettings, optional
        Settings of `rol_beyond.scan_matching.scan_to_map_icp`.

    Returns
    -------
    run : FilterRun
        ``is_lost`` marks rejected registrations; there are no covariances and no particles (NaN and 0). Yin
        et al. 2020, Sec. III-B.
    """
    settings, start = settings or ScanToMapSettings(), monitor.truth[0]
    results = scan_to_map_icp(increments, clouds, map_points, start, monitor, settings)
    rows = [(found.T_target_source, not found.converged, ms) for found, ms in _measure_times(results)]
    poses, is_lost, update_ms = (np.array(column) for column in zip(*rows, strict=True))
    nothing, none = np.full((len(rows), 3, 3), np.nan), np.zeros(len(rows), dtype=int)
    return FilterRun(poses, nothing, monitor.failures, is_lost, none, update_ms, pd.DataFrame())


def find_failures(
    stamps_us: np.ndarray, poses: np.ndarray, truth: np.ndarray, rule: FailureRule | None = None
) -> list[int]:
    """Find the failures of a run without resets; one that lasts counts each time the rule is fulfilled."""
    monitor = FailureMonitor(stamps_us, truth, rule or FailureRule())
    for index, pose in enumerate(poses):
        monitor(index, pose)
    return monitor.failures


def _measure_times(items: Iterable) -> Iterator[tuple[Any, float]]:
    """Pass items on, each with the time that it took [ms]."""
    begin = perf_counter()
    for item in items:
        yield item, 1000.0 * (perf_counter() - begin)
        begin = perf_counter()
