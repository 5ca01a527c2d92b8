"""The command line: `python -m rol_sim CONFIG.yaml --session NAME --out ROOT` writes a session."""

from __future__ import annotations

import argparse
import sys

from rol_sim.session.settings import load_settings
from rol_sim.session.writer import write_session


def main(arguments: list[str] | None = None) -> int:
    """Write the requested sessions.

    Parameters
    ----------
    arguments : list of str or None
        Command line without the program's name; None takes the real one.

    Returns
    -------
    status : int
        0 on success, 1 after a fault, which is reported on stderr.
    """
    parser = argparse.ArgumentParser(
        prog="python -m rol_sim", description="Write simulated sessions in Oxford's files."
    )
    parser.add_argument("config", help="config file (YAML) with a section 'simulated'")
    parser.add_argument(
        "--session", action="append", help="session to write; may be repeated; all of them if not given"
    )
    parser.add_argument("--out", required=True, help="folder of the sessions")
    parser.add_argument("--jobs", type=int, default=1, help="processes that write at once; 1 if not given")
    given = parser.parse_args(arguments)
    try:
        settings = load_settings(given.config)

        for name in given.session or settings.sessions:
            write_session(
                settings, name, given.out, report=lambda line: print(line, flush=True), jobs=given.jobs
            )
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"error: {error}\nWhat is written stays; the same command goes on from there.", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
