"""Fetch the small pieces of real data that `data/real.json` lists, from public repositories at pinned commits.

python workflow/get_real.py            fetches what is missing or has another checksum
python workflow/get_real.py --check    only compares the checksums; exits with 1 on a difference

ROL_REAL_URL names another server, or a folder, with the same repositories.
"""

from __future__ import annotations

import argparse
import os
import sys
from functools import partial
from pathlib import Path

from rol_data.fetch import FetchError, check_all, fetch_all, load_list

LIST = Path(__file__).resolve().parents[1] / "data" / "real.json"
URL = "https://github.com"


def main(arguments: list[str] | None = None) -> int:
    """Fetch or check; return 0 if every listed file is there with its checksum, else 1."""
    parser = argparse.ArgumentParser(description="Fetch the small pieces of real data.")
    parser.add_argument("--root", type=Path, default=Path("data/real"), help="folder of the data")
    parser.add_argument("--check", action="store_true", help="only compare the checksums")
    given = parser.parse_args(arguments)
    repositories, report = load_list(LIST), partial(print, flush=True)
    megabytes = sum(repository["bytes"] for repository in repositories) / 1e6
    print(f"{given.root}: {len(repositories)} repositories, {megabytes:.0f} MB of listed files")
    try:
        if given.check:
            faults = check_all(repositories, given.root)
        else:
            faults = fetch_all(repositories, given.root, os.environ.get("ROL_REAL_URL") or URL, report)
    except KeyboardInterrupt:
        faults = ["interrupted; the next run goes on with the files that are missing"]
    except (FetchError, OSError) as error:
        faults = [str(error)]
    if faults:
        faults.append(f"Not complete ({len(faults)}): `make real` fetches what is missing or corrupted.")
        print(*faults, sep="\n", file=sys.stderr)
        return 1
    print("All files are there, with the listed checksums.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
