"""What the workflow knows of the chapters: which runs there are, their parameters, and when a run is out of date.

The Snakefile, the staging of the book, the renewing of the stored notebooks and the tests all read it here; no path of
an executed notebook is written anywhere else.
"""

from __future__ import annotations

import ast
import hashlib
import io
import json
import re
import shlex
import tokenize
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import nbformat
import yaml

from rol.files import read_text

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "notebooks"
SOURCE = ROOT / "src"  # of all packages
LOCK = ROOT / "requirements.lock"
HAVE_DOCSTRING = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
SIMULATOR = "rol_sim"  # writes a simulated session when it is run as a module

# How often a chapter runs: once in all, once for each session, or once for each localization session and method.
CHAPTERS = {
    "01_sessions": "once",
    "02_alignment": "session",
    "03_ground_removal": "session",
    "04_pix2pix": "once",
    "05_real_vs_fake": "once",
    "06_ground_truth": "once",
    "07_localization": "method",
    "08_results": "once",
    "09_real_pairs": "once",
    "10_real_radar": "once",
    "11_oxford_route": "once",
    "12_robust_filter": "once",
    "13_ablations": "once",
    "14_runtime": "once",
    "15_simulator": "once",
}
LISTS, FOLDERS = ("sessions", "methods"), ("sessions_root", "out_dir", "book_dir")
CONFIG_KEYS = {"profile", *LISTS, *FOLDERS, "seed", "notebooks", "simulated"}
OPTIONAL_KEYS = {"real_root"}
# Keys that are parameters of notebooks.
SHARED = ("sessions_root", "sessions", "methods", "out_dir", "seed", "real_root")


class ChapterError(ValueError):
    """A chapter, its parameters or its run is not as it must be; the message names the file and the fault."""


@dataclass(frozen=True)
class Run:
    """One run of a chapter: the chapter and, where it has them, its session and its method."""

    chapter: str
    session: str = ""
    method: str = ""

    def path(self, out_dir: str | Path) -> Path:
        """Return the path of the executed notebook."""
        parts = [part for part in (self.chapter, self.session, self.method) if part]
        return Path(out_dir, "notebooks", *parts[:-1], f"{parts[-1]}.ipynb")


def load_config(path: str | Path) -> dict:
    """Read a profile and check its keys.

    Raises
    ------
    ChapterError
        If a key is missing or nobody reads it, or a chapter named in it does not exist.
    """
    try:
        return check_config(yaml.safe_load(read_text(path, ChapterError)), str(path))
    except yaml.YAMLError as error:
        raise ChapterError(f"{path}: not YAML ({error})") from error


def check_config(config: dict, name: str) -> dict:
    """Check that a profile has every key that is needed, of the right type, and none that nobody reads."""
    if not isinstance(config, dict):
        raise ChapterError(f"{name}: holds no keys")
    missing, unknown = CONFIG_KEYS - set(config), set(config) - CONFIG_KEYS - OPTIONAL_KEYS
    if missing or unknown:
        raise ChapterError(f"{name}: missing keys {sorted(missing)}, unknown keys {sorted(unknown)}")
    for key in LISTS:
        words = config[key]
        if not words or not isinstance(words, list) or not all(w and isinstance(w, str) for w in words):
            raise ChapterError(f"{name}: `{key}` is no list of names, or empty")
    for key in FOLDERS:
        if not isinstance(config[key], str) or Path(config[key]) == Path("."):
            raise ChapterError(f"{name}: `{key}` names no folder of its own: {config[key]!r}")
    strangers = set(config["notebooks"] or {}) - set(CHAPTERS)
    if strangers:
        raise ChapterError(f"{name}: no such chapters: {sorted(strangers)}")
    if len(config["sessions"]) < 2 or len(set(config["sessions"])) != len(config["sessions"]):
        raise ChapterError(
            f"{name}: `sessions` needs two or more different names, the training session first"
        )
    return config


def all_runs(config: dict) -> list[Run]:
    """List every run of a profile in the order of the chapters."""
    runs = []
    for chapter, often in CHAPTERS.items():
        if often == "once":
            runs.append(Run(chapter))
        elif often == "session":
            runs += [Run(chapter, session) for session in config["sessions"]]
        else:
            runs += [Run(chapter, s, m) for s in config["sessions"][1:] for m in config["methods"]]
    return runs


def book_pages(config: dict) -> list[Run]:
    """List the runs that the book shows, one for each chapter: that of the first session and method which it has."""
    first: dict[str, Run] = {}
    for run in all_runs(config):
        first.setdefault(run.chapter, run)
    return list(first.values())


# ---- parameters -----------------------------------------------------------------------------------------------


def read_notebook(path: str | Path) -> nbformat.NotebookNode:
    """Read a notebook; an unreadable one is an error that names the file."""
    try:
        return nbformat.read(path, as_version=4)
    except (OSError, nbformat.reader.NotJSONError, nbformat.ValidationError) as error:
        raise ChapterError(f"{path}: not a readable notebook ({error})") from error


def tagged_cells(notebook: nbformat.NotebookNode, tag: str) -> list[nbformat.NotebookNode]:
    """List the cells that carry a tag."""
    return [cell for cell in notebook.cells if tag in cell.metadata.get("tags", [])]


def literal_assignments(source: str, name: str) -> dict:
    """Read a cell of plain assignments of literals; anything else in it is an error."""
    values = {}
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign) or not isinstance(node.targets[0], ast.Name):
            raise ChapterError(f"{name}: line {node.lineno} of the parameters cell is not `name = literal`")
        try:
            values[node.targets[0].id] = ast.literal_eval(node.value)
        except ValueError as error:
            raise ChapterError(f"{name}: parameter `{node.targets[0].id}` is not a plain literal") from error
    return values


def notebook_parameters(path: str | Path) -> dict:
    """Return the parameters of a notebook with their defaults.

    Raises
    ------
    ChapterError
        If there is not exactly one cell tagged ``parameters``, it is not the first code cell, or it holds more than
        literals.
    """
    notebook = read_notebook(path)
    cells = tagged_cells(notebook, "parameters")
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    if len(cells) != 1 or not code or code[0] is not cells[0]:
        raise ChapterError(f"{path}: needs exactly one cell tagged `parameters`, as its first code cell")
    return literal_assignments(cells[0].source, str(path))


def run_parameters(config: dict, run: Run, notebooks: Path = NOTEBOOKS) -> dict:
    """Return what papermill passes to a run.

    The common settings go to every notebook that asks for them; the parameters of the profile and the session and method
    of the run must be parameters of the notebook (papermill itself would only print a line and go on).

    Raises
    ------
    ChapterError
        If a name is not a parameter of the notebook, or a profile sets the session or method of a run.
    """
    path = notebooks / f"{run.chapter}.ipynb"
    known = notebook_parameters(path)
    common = {key: config[key] for key in SHARED if key in config} | {"in_dir": config["out_dir"]}
    of_run = {key: value for key, value in (("session", run.session), ("method", run.method)) if value}
    own = (config["notebooks"] or {}).get(run.chapter) or {}
    refused = ", ".join(sorted(set(own) - (set(known) - set(of_run)) | set(of_run) - set(known)))
    if refused:
        raise ChapterError(f"{path}: a profile cannot set {refused}; parameters: {', '.join(sorted(known))}")
    return {key: value for key, value in (common | own | of_run).items() if key in known}


def translation(config: dict, notebooks: Path = NOTEBOOKS) -> dict[str, str]:
    """Return the network that generates the images and the options of `generate_images.py`, as chapter 05 has them.

    Returns
    -------
    translation : dict
        ``weights``: file of the network; ``options``: arguments, quoted for the shell.
    """
    chapter = "05_real_vs_fake"
    path = notebooks / f"{chapter}.ipynb"
    known = notebook_parameters(path) | run_parameters(config, Run(chapter), notebooks)
    weights = Path(known["weights_root"], f"{known['network']}.safetensors")
    if known["network"] == "chapter 4":
        weights = Path(config["out_dir"], "pix2pix", "generator.safetensors")
    elif not weights.is_file():
        raise ChapterError(f"{chapter}: network: no file {weights}; that of chapter 4 is named 'chapter 4'")
    options = [f"--{name}={str(known[name]).lower()}" for name in ("threshold", "device", "bf16")]
    return {"weights": str(weights), "options": shlex.join(options)}


def papermill_arguments(parameters: dict) -> str:
    """Write parameters as papermill's arguments, quoted for the shell.

    Strings go by ``-r``, since ``-p`` turns 007 into 7; all else goes as YAML by ``-y``.
    """
    words = []
    for name, value in parameters.items():
        if isinstance(value, str):
            words += ["-r", name, value]
        else:
            words += ["-y", yaml.safe_dump({name: value}, default_flow_style=True, width=10**6).strip()]
    return shlex.join(words)


# ---- digests --------------------------------------------------------------------------------------------------


@cache  # chapters share most of their modules
def code_text(source: str) -> str:
    """Reduce Python source to what can change a result: without comments, docstrings and blank lines."""
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, HAVE_DOCSTRING) and ast.get_docstring(node):
            first, last = node.body[0].lineno, node.body[0].end_lineno
            lines[first - 1 : last] = [""] * (last - first + 1)
    return "\n".join(line.rstrip() for line in lines if line.strip())


def own_code(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    """List a notebook's code cells, without empty ones and the one that papermill put in."""
    injected = tagged_cells(notebook, "injected-parameters")
    cells = [cell for cell in notebook.cells if cell.cell_type == "code" and cell.source.strip()]
    return [cell for cell in cells if cell not in injected]


def code_cells(notebook: nbformat.NotebookNode) -> list[str]:
    """List the sources of a notebook's code cells, without empty ones and the one that papermill put in."""
    return [cell.source for cell in own_code(notebook)]


@cache
def imported_names(source: str, package: tuple[str, ...] = ()) -> frozenset[tuple[str, ...]]:
    """List the absolute names that a piece of source imports, as paths such as ``("rol", "mcl", "localize")``.

    Parameters
    ----------
    source : str
        Python source; lines of IPython's magic are left out.
    package : tuple of str
        Package that the source belongs to, to resolve relative imports.
    """
    plain = "\n".join(line for line in source.splitlines() if not line.lstrip().startswith(("%", "!")))
    found = set()
    for node in ast.walk(ast.parse(plain)):
        if isinstance(node, ast.Import):
            found |= {tuple(alias.name.split(".")) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            base += tuple(node.module.split(".")) if node.module else ()
            found |= {(*base, alias.name) for alias in node.names}
    return frozenset(found)


def files_of_import(name: tuple[str, ...]) -> list[Path]:
    """List the files that an import runs, packages first; none if the module or the name in it is missing."""
    files: list[Path] = []
    place = SOURCE
    for n, part in enumerate(name):
        place = place / part
        found = [file for file in (place / "__init__.py", place.with_suffix(".py")) if file.is_file()]
        if not found:  # `part` is a name in the last file, or missing
            known = ["*", *re.findall(r"\w+", code_text(read_text(files[-1])))] if files else []
            return files if n == len(name) - 1 and part in known else []
        files.append(found[0])
    return files


def module_files(sources: Iterable[str], user: str) -> list[Path]:
    """List the files under ``src`` that pieces of source use, directly or through one another.

    Every folder of ``src`` with an ``__init__.py`` is a package. A name that begins with ``rol`` is always taken for
    one, so that a package that has been moved or renamed is an error and not left out.

    Parameters
    ----------
    sources : iterable of str
        Python source.
    user : str
        File that the sources belong to, for the message of an error.

    Raises
    ------
    ChapterError
        If an import of a package of this project leads to no file; names the importing file and the import.
    """
    packages = {file.parent.name for file in SOURCE.glob("[!.]*/__init__.py")}
    found: set[Path] = set()
    waiting = [(user, name) for source in sources for name in imported_names(source)]
    while waiting:
        user, name = waiting.pop()
        if name[0] not in packages and not name[0].startswith("rol"):
            continue
        files = files_of_import(name)
        if not files:
            raise ChapterError(
                f"{user}: imports `{'.'.join(name)}`, which is no module or name under {SOURCE.name}"
            )
        for file in set(files) - found:
            found.add(file)
            package = file.parent.relative_to(SOURCE).parts
            waiting += [(str(file), used) for used in imported_names(read_text(file), package)]
    return sorted(found)


def digest(texts: Iterable[str]) -> str:
    """Compute a short digest of several texts and of the versions in the lock file."""
    versions = [line for line in read_text(LOCK).splitlines() if not line.startswith("#")]
    return hashlib.sha256("\0".join([*texts, *versions]).encode()).hexdigest()[:16]


def code_of(files: Iterable[Path]) -> list[str]:
    """Read the code of files, without comments and docstrings."""
    return [code_text(read_text(file)) for file in files]


def chapter_digest(path: str | Path) -> str:
    """Compute the digest of a notebook's code, the modules it uses and the lock file; text and outputs do not count."""
    cells = code_cells(read_notebook(path))
    return digest([*cells, *code_of(module_files(cells, str(path)))])


def module_digest(name: str) -> str:
    """Compute the digest of a module of the packages, the modules it uses and the lock file."""
    return digest(code_of(module_files([f"import {name}"], "workflow/chapters.py")))


def script_digest(name: str) -> str:
    """Compute the digest of a script of the workflow, the modules it uses and the lock file."""
    script = ROOT / "workflow" / name
    return digest(code_of([script, *module_files([read_text(script)], f"workflow/{name}")]))


def stored_digest(notebook: nbformat.NotebookNode, config: dict) -> str:
    """Compute the digest that a stored notebook carries: of its code, all packages, the lock file and its profile."""
    packages = code_of(sorted(SOURCE.rglob("[!.]*.py")))
    return digest([*code_cells(notebook), *packages, json.dumps(config, sort_keys=True)])


# ---- executed notebooks ---------------------------------------------------------------------------------------


def faults_of_run(notebook: nbformat.NotebookNode) -> list[str]:
    """List what is wrong with an executed notebook: a cell that did not run, an error, or words on stderr."""
    faults = []
    for number, cell in enumerate(notebook.cells):
        if cell.cell_type != "code" or not cell.source.strip():
            continue
        if cell.execution_count is None:
            faults.append(f"cell {number} did not run")
        for output in cell.outputs:
            if output.output_type == "error":
                faults.append(f"cell {number} raised {output.ename}: {output.evalue}")
            elif output.get("name") == "stderr":
                faults.append(f"cell {number} wrote to stderr: {output.text.strip()[:200]}")
    return faults


def load_run(path: str | Path, source: str | Path) -> nbformat.NotebookNode:
    """Load an executed notebook with the text of its source as it is now.

    Text cells may have changed since the run and are taken from the source; code cells must be the same.

    Raises
    ------
    ChapterError
        If the run has a fault or its code is not that of the source.
    """
    executed, current = read_notebook(path), read_notebook(source)
    faults = faults_of_run(executed)
    if faults:
        raise ChapterError(f"{path}: " + "; ".join(faults))
    if code_cells(executed) != code_cells(current):
        raise ChapterError(f"{path}: its code is not that of {source}; run the chapter again")
    for cell, done in zip(own_code(current), own_code(executed), strict=True):
        cell.outputs, cell.execution_count = done.outputs, done.execution_count
    injected = tagged_cells(executed, "injected-parameters")
    place = 1 + current.cells.index(tagged_cells(current, "parameters")[0]) if injected else 0
    current.cells[place:place] = injected
    current.metadata.setdefault("papermill", {}).update(executed.metadata.get("papermill", {}))
    return current
