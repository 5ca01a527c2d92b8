"""Files on disk: whole-or-nothing writing, reading of text, folders of images with their settings."""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))


def write_bytes(path: Path | str, data: bytes) -> None:
    """Write a file whole or not at all: under a temporary name beside it, then renamed.

    Parameters
    ----------
    path : path
        File to write; its folder is made if needed.
    data : bytes
        Content.

    Raises
    ------
    OSError
        If the file cannot be written. The message names it and says when the disk is full; no temporary file is
        left.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:
        reason = "the disk is full" if error.errno in FULL else error.strerror
        raise OSError(error.errno, f"cannot write this file: {reason}", str(path)) from error
    finally:
        with contextlib.suppress(OSError):  # a second error would hide the first
            temporary.unlink()


def write_text(path: Path | str, text: str) -> None:
    """Write a text file in UTF-8 whole or not at all, see `write_bytes`."""
    write_bytes(path, text.encode("utf-8"))


def read_text(path: Path | str, error_type: type[ValueError] = ValueError) -> str:
    """Read a text file in UTF-8 without the byte order mark that some editors put first.

    Parameters
    ----------
    path : path
        File to read.
    error_type : type
        Error to raise for bytes that are not UTF-8.

    Returns
    -------
    text : str
        Content.

    Raises
    ------
    ValueError
        If the bytes are not UTF-8; the message names the file and the place.
    OSError
        If there is no such file.
    """
    data = Path(path).read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        fault = f"line {line} is not UTF-8 text (byte 0x{data[error.start]:02x})"
        raise error_type(f"{path}: {fault}") from error


def prepare_images(
    folder: Path | str, settings: dict[str, Any], subfolders: Sequence[str], listing: str
) -> set[int]:
    """Prepare a folder of images that all depend on the same settings.

    The folder's ``settings.json`` names the listing and holds the settings. Images that were made with other
    settings are removed: ``<digits>.png`` in the subfolders, and no other file.

    Parameters
    ----------
    folder : path
        Folder of the images of one session; made if absent.
    settings : dict
        Everything that the images depend on, JSON values only.
    subfolders : sequence of str
        Where the images are, "." for the folder itself.
    listing : str
        Name of the file that is written once all images are there; it is removed.

    Returns
    -------
    stamps_us : set of int
        Names of the images that are in every subfolder [us].

    Raises
    ------
    ValueError
        If the folder is not empty and has no such ``settings.json``, or images with other settings lie behind a
        symbolic link. It is left as it is.
    """
    folder = Path(folder)
    marker, wanted = folder / "settings.json", {"listing": listing, "settings": settings}
    found = read_marker(marker)
    if found.get("listing") != listing and is_used(folder):
        raise ValueError(
            f"{folder}: not empty, and not made for {listing} (no settings.json that says so); nothing was"
            " removed. Choose another folder, or delete this one if its content is not needed"
        )
    is_other = found != json.loads(json.dumps(wanted))
    for linked in (folder / name for name in subfolders if is_other and (folder / name).is_symlink()):
        raise ValueError(f"{linked}: a symbolic link; the images of other settings in it were not removed")
    (folder / listing).unlink(missing_ok=True)
    for leftover in (path for name in subfolders for path in (folder / name).glob(".*.png.*.tmp")):
        leftover.unlink()  # of a run that was killed
    images = [
        {path.stem: path for path in (folder / name).glob("*.png") if path.stem.isdecimal()}
        for name in subfolders
    ]
    if is_other:
        for path in (path for there in images for path in there.values()):
            path.unlink()
        write_text(marker, json.dumps(wanted, indent=1, sort_keys=True))
        return set()
    return {int(stem) for stem in set.intersection(*map(set, images))}


def read_marker(path: Path | str) -> dict[str, Any]:
    """Read a ``settings.json``; an empty dict where it is missing or is not a JSON object."""
    try:
        found = json.loads(read_text(path))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def is_used(folder: Path | str) -> bool:
    """Check whether a folder holds any file or folder that is not hidden; False where it is absent."""
    return Path(folder).exists() and any(not path.name.startswith(".") for path in Path(folder).iterdir())
