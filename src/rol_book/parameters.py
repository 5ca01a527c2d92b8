"""Check the parameters of a chapter's notebook before it runs: names, types, and the folders that it reads.

Papermill sets whatever it is given: text in place of a number, a name that no cell uses, a folder that is not
there. A notebook calls `check_parameters` in its first cell below the parameters, so that such a run ends
there.
"""

from __future__ import annotations

import ast
import json
import math
import os
from collections.abc import Iterable, MutableMapping
from pathlib import Path
from typing import Any

WORDS = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "text",
    list: "a list",
    dict: "a mapping",
}
MAKERS = {  # parameter -> how to get what it names
    "sessions_root": "`make book` makes those of the demo, and book/rerun.md shows how to make one",
    "in_dir": "the chapters before this one write it, `make book` runs all",
    "real_root": "`make real` gets the real data",
}
FROM_REPOSITORY = "it comes with the repository"
CHOICES: dict[str, tuple[Any, ...]] = {  # parameter -> all its values
    "bf16": ("auto", True, False),
    "device": ("cpu", "cuda"),
    "method": ("paper", "robust"),
    "motion": ("none", "corrected"),
    "place": ("oxford", "kaist", "dcc", "riverside"),
    "points_source": ("raw", "fake", "real", "fake-corrected"),
}
MAY_BE_ZERO = ("seed", "counterpart_seed", "scan_number", "kidnapped_at", "gap_scans", "steps", "n_blocks")
NETWORKS = ("network", "compared", "networks")  # parameters that name networks


class ParameterError(ValueError):
    """Parameters with which a notebook cannot run; the message names the notebook and each fault."""


def check_parameters(
    notebook: str, namespace: MutableMapping[str, Any], optional: Iterable[str] = ()
) -> None:
    """Check the parameters of a notebook, and go to the root of the repository if it runs in `notebooks/`.

    Parameters
    ----------
    notebook : str
        Name of the notebook's file without its ending, such as "01_sessions".
    namespace : mapping
        ``globals()`` of the notebook. Names are compared with the parameters at the first call only; later
        ones find those of other cells as well.
    optional : iterable of str
        Parameters whose file or folder may be missing.

    Raises
    ------
    ParameterError
        If the notebook is not found, or a parameter is unknown, missing, of another type than its default,
        out of range, none of its choices, or names a file, folder, session or network to read that is not
        there.
    """
    if Path.cwd().name == "notebooks":
        os.chdir("..")
    defaults, faults = read_parameters(Path("notebooks", f"{notebook}.ipynb")), []
    if "_rol_checked" not in namespace:
        faults += [f"{name}: unknown parameter" for name in _literal_names(namespace) if name not in defaults]
    for name, default in defaults.items():
        if name not in namespace:
            faults.append(f"{name}: missing, its default is {default!r}")
        elif (
            fault := _type_fault(namespace[name], default)
            or _range_fault(name, namespace[name], default)
            or (name not in optional and _path_fault(name, namespace[name], default))
        ):
            faults.append(f"{name}: {fault}")
    if not faults:
        given = {name: namespace[name] for name in defaults}
        faults = _session_faults(given) + _network_faults(given)
    if faults:
        known = f" (parameters: {', '.join(defaults)})" if any("unknown" in fault for fault in faults) else ""
        raise ParameterError(f"notebooks/{notebook}.ipynb: {'; '.join(faults)}{known}")
    namespace["_rol_checked"] = True


def read_parameters(path: Path | str) -> dict[str, Any]:
    """Read the parameters of a notebook with their defaults.

    Parameters
    ----------
    path : path
        Notebook with a cell tagged ``parameters`` that assigns literals and nothing else.

    Returns
    -------
    parameters : dict
        Name -> default.

    Raises
    ------
    ParameterError
        If there is no such notebook or cell.
    """
    try:
        cells = json.loads(Path(path).read_text(encoding="utf-8"))["cells"]
    except FileNotFoundError as error:
        raise ParameterError(
            f"{path}: not found in {Path.cwd()}; run it in the root of the repository"
        ) from error
    for cell in cells:
        if "parameters" in cell["metadata"].get("tags", []):
            nodes = ast.parse("".join(cell["source"])).body
            return {node.targets[0].id: ast.literal_eval(node.value) for node in nodes}  # type: ignore[attr-defined]
    raise ParameterError(f"{path}: has no cell tagged `parameters`")


def positive(text: str) -> int:
    """Read a whole number of at least 1, as ``type`` of an argument of `argparse`.

    Raises
    ------
    ValueError
        If the text is no such number.
    """
    if int(text) < 1:
        raise ValueError
    return int(text)


def _literal_names(namespace: MutableMapping[str, Any]) -> list[str]:
    """List names of plain values that a person or papermill has set, without IPython's own."""
    kinds = (bool, int, float, str, list, dict, tuple, type(None))
    return [
        name
        for name, value in namespace.items()
        if not name.startswith("_") and name not in ("In", "Out") and type(value) in kinds
    ]


def _type_fault(value: Any, default: Any) -> str:
    """Describe what is wrong with the type of a value; empty if nothing is.

    A whole number passes for any number; where the default is "auto", True and False pass too.
    """
    kind = type(default)
    accepted = (int, float) if kind is float else (str, bool) if default == "auto" else (kind,)
    if type(value) not in accepted:
        hint = {str: "; papermill passes text by -r"}.get(kind, "")
        hint = "; papermill passes it by -p or -y, text by -r" if isinstance(value, str) else hint
        return f"expected {WORDS[kind]} such as {default!r}, got {value!r}{hint}"
    if isinstance(value, float) and math.isnan(value):
        return "nan is not a number to run with"
    if kind is list and default:
        faults = [fault for item in value if (fault := _type_fault(item, default[0]))]
        return f"in the list: {faults[0]}" if faults else "" if value else "the list is empty"
    return ""


def _range_fault(name: str, value: Any, default: Any) -> str:
    """Describe why a value of the right type is out of range; empty if it is not.

    Only numbers with a negative default may be negative. Counts, whole numbers with a default above 0, start
    at 1.
    """
    if name in CHOICES:
        known = ", ".join(map(repr, CHOICES[name]))
        return "" if value in CHOICES[name] else f"{value!r} is none of {known}"
    if name == "max_scans" and value == 1:
        return "one scan is no path; 0 uses all"
    if value == "" != default:
        return f"must not be empty; its default is {default!r}"
    if isinstance(default, (int, float)) and value < 0 <= default:
        return f"must not be negative, got {value}"
    is_count = type(default) is int and default > 0 and name not in MAY_BE_ZERO
    return f"must be at least 1, got {value}" if is_count and value < 1 else ""


def _path_fault(name: str, value: Any, default: Any) -> str:
    """Describe a file or folder that is missing; empty if it exists or the parameter names none to read."""
    is_path = isinstance(default, str) and ("/" in default or name.endswith("_root")) and name != "out_dir"
    if not is_path or value == default == "":
        return ""
    kind, exists = ("file", Path.is_file) if Path(default).suffix else ("folder", Path.is_dir)
    return (
        "" if exists(Path(value)) else f"{kind} {value!r} does not exist; {MAKERS.get(name, FROM_REPOSITORY)}"
    )


def _session_faults(parameters: dict[str, Any]) -> list[str]:
    """List that the session is none of the sessions, or has no folder."""
    session, root = parameters.get("session", "all"), parameters.get("sessions_root")
    if session == "all" or root is None:
        return []
    known = parameters.get("sessions", [session])
    there = sorted(path.name for path in Path(root).iterdir() if path.is_dir())
    if session not in known:
        return [f"session: {session!r} is none of the sessions {', '.join(known)}"]
    return (
        []
        if session in there
        else [f"session: {session!r} is not in {root}; there are: {', '.join(there) or 'none'}"]
    )


def _network_faults(parameters: dict[str, Any]) -> list[str]:
    """List the networks that have no file in the folder of the weights; "chapter 4" trains its own."""
    if "weights_root" not in parameters:
        return []
    root, faults = Path(parameters["weights_root"]), []
    for name in [name for name in NETWORKS if name in parameters]:
        value = parameters[name]
        faults += [
            f"{name}: {network!r} has no file {root / f'{network}.safetensors'}; there are: "
            + (", ".join(sorted(path.stem for path in root.glob("[!.]*.safetensors"))) or "none")
            + (", and the network of 'chapter 4'" if name == "network" else "")
            for network in ([value] if isinstance(value, str) else value)
            if network != "chapter 4" and not (root / f"{network}.safetensors").is_file()
        ]
    return faults
