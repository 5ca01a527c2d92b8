"""Measure the filters on the real route over many seeds, settings and wrong starts: tables of hours of filtering.

python benchmarks/route.py [--real-root DIR] [--jobs 2] [--only seeds,...] [--sessions 02,10] [--seeds 3]

Writes data/ablations/route_<what>.csv row by row; a run that was stopped continues where it ended. Chapters 11 and 12
read these tables, and make one run of each session themselves.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from rol_book.parameters import positive
from rol_data.rall import find_real_root
from rol_study.route_tables import MEASURES, list_jobs, run_table

DATA = Path(__file__).resolve().parents[1] / "data"


def main() -> None:
    """Measure the requested tables."""
    parser = argparse.ArgumentParser(description="Measure the filter on the real route.")
    parser.add_argument("--real-root", default="", help="folder of the real data")
    parser.add_argument("--jobs", type=positive, default=2, help="processes")
    parser.add_argument("--only", default=",".join(MEASURES), help="tables to measure")
    parser.add_argument("--sessions", default="", help="only these sessions, such as 02,10")
    parser.add_argument("--seeds", type=positive, default=10**6, help="only seeds up to this one")
    given = parser.parse_args()
    if unknown := set(given.only.split(",")) - set(MEASURES):
        parser.error(f"--only: no table {min(unknown)!r}; there are: {', '.join(MEASURES)}")
    root = find_real_root(given.real_root)
    if root is None:
        raise SystemExit("the real map is not at hand: run `make real`, or give --real-root")
    for threads in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(threads, "1")  # of each process of the pool; here it would come too late
    sessions = given.sessions.split(",") if given.sessions else []

    def is_chosen(job: tuple) -> bool:
        return job[-1] <= given.seeds and (not sessions or job[0] in sessions)

    files = {"real_root": str(root), "weights": str(DATA / "weights" / "unet.safetensors")}
    with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
        for what, jobs in list_jobs(str(root)).items():
            if what in given.only.split(","):
                path = DATA / "ablations" / f"route_{what}.csv"
                run_table(pool, what, jobs, path, is_chosen=is_chosen, **files)


if __name__ == "__main__":
    main()
