"""One run of the workflow at a time in one folder.

The operating system releases the lock when its process ends, however it ends: no lock is ever left behind. Snakemake's own
lock stays after a kill, and `snakemake --unlock` removes that of a living run too.
"""

from __future__ import annotations

import fcntl
import os
import sys
from datetime import datetime
from pathlib import Path
from typing import TextIO

_held: dict[Path, TextIO] = {}  # open files; closing one would release its lock


def wait_for_lock(path: str | Path, owner: str) -> None:
    """Wait until no other process holds a lock, and hold it until this process ends.

    Parameters
    ----------
    path : str or Path
        The file that is locked; it is made where it is missing, and stays.
    owner : str
        What this process does, for the message of those that wait for it.
    """
    path = Path(path).absolute()
    if path in _held:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.open("a+", encoding="utf-8")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        print(f"Another run is at work in {path.parent.parent}: {file.read().strip()}.", file=sys.stderr)
        print("This one starts when that one has ended; Ctrl-C stops waiting.", file=sys.stderr, flush=True)
        fcntl.flock(file, fcntl.LOCK_EX)
    except OSError as error:  # some network file systems have no locks
        print(f"{path}: not locked ({error}); start no second run in this folder", file=sys.stderr)
    file.truncate(0)
    file.write(f"{owner}, process {os.getpid()}, since {datetime.now().isoformat(' ', 'seconds')}\n")
    file.flush()
    _held[path] = file
