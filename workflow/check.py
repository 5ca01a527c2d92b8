"""Compare the numbers of a build with the reference numbers of its profile, in data/reference.

    python workflow/check.py config/demo.yaml                      print the table; exit 1 on a miss
    python workflow/check.py config/demo.yaml --run metrics.json   compare one rerun of chapter 7 or 11
    python workflow/check.py --renew config/demo.yaml              take the values of this build as the reference

The names, sources, tolerances and reasons in data/reference are curated by hand; `--renew` replaces values only.
The source of a number is `glue:NAME` (glued by the chapter's notebook) or `file:PATH#KEY` below the profile's out_dir:
a key of a JSON file or a column of a CSV file, of which the mean is taken. Of a text it is the first
number, or with `[2]` behind the source the third.
"""

from __future__ import annotations

import argparse
import csv
import importlib.metadata
import json
import math
import os
import platform
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from chapters import ROOT, ChapterError, Run, load_config
from rol.files import read_text, write_text
from rol_data.rall import find_real_root

REFERENCE = ROOT / "data" / "reference"
PAGE = ROOT / "book" / "did_it_reproduce.md"
PACKAGES = "numpy scipy opencv-python-headless numba pandas torch open3d-cpu open3d matplotlib papermill snakemake jupyter-book"
SOURCE = re.compile(r"(?:glue:([\w-]+)|file:([^#]+)#([^\[]+))(?:\[(\d+)\])?$")
NUMBER = re.compile(r"(?<![\w.])[+-]?\d[\d,]*\.?\d*(?:e[+-]?\d+)?")
WITHIN, OUTSIDE, MISSING, SKIPPED = "within", "OUTSIDE", "MISSING", "needs real data"


@dataclass(frozen=True)
class Row:
    """One number of the table: its reference entry, what this build has, and the result."""

    entry: dict
    found: float | None
    tolerance: float
    result: str
    fault: str = ""

    def cells(self) -> list[str]:
        """List the cells that the terminal and the page share: name, reference, this build, tolerance, result."""
        numbers = [self.entry["value"], self.found]
        shown = ["none" if number is None else f"{number:.5g}" for number in numbers]
        return [self.entry["name"], *shown, f"{self.tolerance:.2g}", self.result]

    def told(self) -> str:
        """Name the chapter, the number, and its fault or the reason for its tolerance."""
        fault = self.fault or f"`{self.entry['from']}`; {self.entry['reason']}"
        return f"{self.result}: {self.entry['chapter']}, {self.entry['name']}: {fault}"


# ---- values of a build ----------------------------------------------------------------------------------------


def glued_value(path: Path, name: str) -> str:
    """Read what an executed notebook glued under a name."""
    for cell in json.loads(read_text(path))["cells"]:
        for output in cell.get("outputs", []):
            if output.get("metadata", {}).get("scrapbook", {}).get("name") == name:
                return "".join(next(iter(output["data"].values())))
    raise KeyError(name)


def filed_value(path: Path, key: str) -> object:
    """Read a key of a JSON file, or the mean of a column of a CSV file."""
    text = read_text(path)
    if path.suffix == ".csv":
        return fmean(float(row[key]) for row in csv.DictReader(text.splitlines()))
    return json.loads(text)[key]


def find_value(entry: dict, out_dir: str | Path) -> float:
    """Find the value of a reference entry in a build.

    Raises
    ------
    ChapterError
        If the source is gone or is no number; the message names the file and the key.
    """
    match = SOURCE.match(entry["from"])
    if not match:
        raise ChapterError(f"`{entry['from']}` is neither glue:NAME nor file:PATH#KEY")
    name, file, key, index = match.groups()
    run = Run(entry["chapter"], entry.get("session", ""), entry.get("method", ""))
    path = Path(out_dir, file) if file else run.path(out_dir)
    try:
        told = str(filed_value(path, key) if file else glued_value(path, name))
        value = float(NUMBER.findall(told)[int(index or 0)].replace(",", ""))
    except FileNotFoundError:
        raise ChapterError(f"no file {path} for `{entry['from']}`") from None
    except (KeyError, IndexError, TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise ChapterError(f"{path} holds no number `{entry['from']}`")
    return value


# ---- comparison -----------------------------------------------------------------------------------------------


def read_reference(profile: str) -> dict:
    """Read the reference of a profile: `profile`, `seed`, `machine` and the list `numbers`."""
    path = REFERENCE / f"{profile}.json"
    try:
        return json.loads(read_text(path))
    except FileNotFoundError:
        raise ChapterError(f"{path.relative_to(ROOT)}: there is no reference for this profile") from None
    except ValueError as error:
        raise ChapterError(f"{path.relative_to(ROOT)}: not readable as JSON ({error})") from error


def compare(entry: dict, out_dir: str | Path, has_real: bool, other_seed: bool = False) -> Row:
    """Compare one reference entry with a build.

    Parameters
    ----------
    entry : dict
        Entry of ``numbers``.
    out_dir : path
        Results of the build.
    has_real : bool
        Whether the real data is present; without it, an entry with ``real`` is skipped.
    other_seed : bool
        Whether the build has another seed than the reference, so that ``seed_tol`` applies.
    """
    value = math.nan if entry["value"] is None else entry["value"]  # before it is renewed for the first time
    allowed = max(entry.get("abs_tol", 0.0), entry.get("rel_tol", 0.0) * abs(value))
    allowed = max(allowed, entry.get("seed_tol", 0.0) * other_seed)
    if entry.get("real", False) and not has_real:
        return Row(entry, None, allowed, SKIPPED)
    try:
        found = find_value(entry, out_dir)
    except ChapterError as error:
        return Row(entry, None, allowed, MISSING, str(error))
    return Row(entry, found, allowed, WITHIN if abs(found - value) <= allowed else OUTSIDE)


def compare_build(config: dict) -> list[Row]:
    """Compare all numbers of a profile with its build."""
    entries = read_reference(config["profile"])["numbers"]
    has_real = find_real_root(config.get("real_root", "")) is not None
    return [compare(entry, config["out_dir"], has_real) for entry in entries]


def compare_run(reference: dict, path: str | Path) -> list[Row]:
    """Compare the metrics.json of one rerun with the reference of its session and method.

    Raises
    ------
    ChapterError
        If the file is not a metrics.json or no reference belongs to its session and method.
    """
    try:
        metrics = json.loads(read_text(path))
        session, method, seed = (metrics[key] for key in ("session", "method", "seed"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ChapterError(f"{path}: not a readable metrics.json ({error!r})") from error
    entries = [e for e in reference["numbers"] if f"/{session}/{method}/metrics.json#" in e["from"]]
    if not entries:
        raise ChapterError(f"{path}: no reference for session {session}, method {method}")
    other = seed != reference["seed"]
    spread = "; compared within the spread between seeds" if other else ""
    print(f"{path}: {session}, {method}, seed {seed} (reference: seed {reference['seed']}{spread})")
    own = [e | {"from": f"file:{Path(path).name}#{e['from'].partition('#')[2]}"} for e in entries]
    return [compare(entry, Path(path).parent, True, other) for entry in own]


def renew(config: dict) -> None:
    """Replace the values of a profile's reference by those of its build; names, tolerances and reasons stay."""
    reference, rows = read_reference(config["profile"]), compare_build(config)
    gone = [row.told() for row in rows if row.result == MISSING]
    if gone:
        raise ChapterError("nothing is renewed\n" + "\n".join(gone))
    for entry, row in zip(reference["numbers"], rows, strict=True):
        if row.found is not None:
            entry["value"] = float(f"{row.found:.6g}")
    reference |= {"seed": config["seed"], "machine": machine()}
    path = REFERENCE / f"{config['profile']}.json"
    write_text(path, json.dumps(reference, indent=1, ensure_ascii=False) + "\n")
    kept = count_results(rows)[SKIPPED]
    renewed = f"renewed: {len(rows) - kept} values of {path.relative_to(ROOT)}"
    print(f"{renewed}; kept: {kept}, which need real data")


# ---- machine --------------------------------------------------------------------------------------------------


def machine() -> dict[str, str]:
    """Describe what can make numbers differ: processor, bf16, system, Python and versions of packages."""
    from rol.pix2pix import has_bf16

    info = Path("/proc/cpuinfo")
    models = re.findall(r"^model name\s*: (.+)$", read_text(info), re.MULTILINE) if info.is_file() else []
    installed = {package.name: package.version for package in importlib.metadata.distributions()}
    return {
        "Processor": models[0] if models else platform.processor() or platform.machine(),
        "Cores": str(os.cpu_count()),
        "bf16 instructions": "yes" if has_bf16() else "no",
        "System": f"{platform.system()} {platform.machine()}",
        "Python": platform.python_version(),
        **{name: installed[name] for name in PACKAGES.split() if name in installed},
    }


# ---- output ---------------------------------------------------------------------------------------------------


def print_table(rows: list[Row]) -> None:
    """Print the table, then every miss with its reason and what to look at."""
    cells = [["ch.", "number", "reference", "this build", "tolerance", "result"]]
    cells += [[row.entry["chapter"][:2], *row.cells()] for row in rows]
    widths = [max(len(line[column]) for line in cells) for column in range(6)]
    for line in cells:
        print("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
    look_at = dict(re.findall(r"^(\w+)\n: (.+)$", read_text(PAGE), re.MULTILINE))
    misses = [row for row in rows if row.result in (OUTSIDE, MISSING)]
    for row in misses:
        print(row.told())
    for kind in sorted({row.entry["kind"] for row in misses if row.result == OUTSIDE}):
        print(f"\nWhat to look at ({kind}): {look_at[kind]}")
    counts = ", ".join(f"{n} {result}" for result, n in count_results(rows).items())
    print(f"\n{len(rows)} numbers: {counts}")


def count_results(rows: list[Row]) -> dict[str, int]:
    """Count the results."""
    results = [row.result for row in rows]
    return {result: results.count(result) for result in (WITHIN, OUTSIDE, MISSING, SKIPPED)}


def main() -> int:
    """Run the command line; 1 if a number is outside its tolerance or missing."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("config", help="profile, such as config/demo.yaml")
    parser.add_argument("--run", help="metrics.json of one rerun")
    parser.add_argument("--renew", action="store_true", help="take the values of this build as the reference")
    arguments = parser.parse_args()
    config = load_config(arguments.config)
    if not arguments.run and not Path(config["out_dir"], "notebooks").is_dir():
        raise ChapterError(f"{config['out_dir']}: no build of this profile; run `make book` first")
    if arguments.renew:
        renew(config)
        return 0
    reference = read_reference(config["profile"])
    rows = compare_run(reference, arguments.run) if arguments.run else compare_build(config)
    print_table(rows)
    return int(any(row.result in (OUTSIDE, MISSING) for row in rows))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except ChapterError as error:
        sys.exit(f"ERROR: {error}")
