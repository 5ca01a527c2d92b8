"""Write files whole or not at all, read text, and keep folders of images with their settings."""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
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
        If the file cannot be written. The message names it and says when the disk is full; no temporary file
        is left.
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


@dataclass(frozen=True)
class ImageFolder:
    """Images of one session that all depend on the same settings, as ``<microseconds>.png``.

    ``settings.json`` is written first and tells which settings the images belong to, so that an interrupted
    run can be resumed. The listing is written last; without it the folder is incomplete.

    Attributes
    ----------
    folder : path
        Folder of the images of one session.
    listing : str
        Name of the file that lists the images once all are there.
    subfolders : tuple of str
        Where the images are, "." for the folder itself.
    """

    folder: Path | str
    listing: str
    subfolders: tuple[str, ...] = (".",)

    def path(self, stamp_us: int, subfolder: str = ".") -> Path:
        """Return the path of the image of a stamp [us]."""
        return Path(self.folder) / subfolder / f"{int(stamp_us)}.png"

    def prepare(self, settings: dict[str, Any]) -> set[int]:
        """Prepare the folder for images of these settings and remove images of other settings.

        Parameters
        ----------
        settings : dict
            Everything that the images depend on, JSON values only.

        Returns
        -------
        stamps_us : set of int
            Names of the images that are in every subfolder [us].

        Raises
        ------
        ValueError
            If the folder is not empty and its ``settings.json`` does not name this listing, or images with
            other settings lie behind a symbolic link. The folder is left as it is.
        """
        folder = Path(self.folder)
        marker, wanted = folder / "settings.json", {"listing": self.listing, "settings": settings}
        found = read_marker(marker)
        if found.get("listing") != self.listing and is_used(folder):
            raise ValueError(
                f"{folder}: not empty, and not made for {self.listing} (no settings.json that says so); nothing"
                " was removed. Choose another folder, or delete this one if its content is not needed"
            )
        is_other = found != json.loads(json.dumps(wanted))
        places = [folder / name for name in self.subfolders]
        for linked in (place for place in places if is_other and place.is_symlink()):
            raise ValueError(f"{linked}: a symbolic link; images of other settings in it were not removed")
        (folder / self.listing).unlink(missing_ok=True)
        for leftover in (path for place in places for path in place.glob(".*.png.*.tmp")):
            leftover.unlink()  # of a run that was killed
        images = [{path for path in place.glob("*.png") if path.stem.isdecimal()} for place in places]
        if not is_other:
            return {int(stem) for stem in set.intersection(*({path.stem for path in one} for one in images))}
        for path in set.union(*images):
            path.unlink()
        write_text(marker, json.dumps(wanted, indent=1, sort_keys=True))
        return set()

    def describe(self, settings: dict[str, Any], stamps_us: Sequence[int], **more: Any) -> str:
        """Compose the text of the listing, see `finish`."""
        about = {"settings": settings, "stamps_us": [int(stamp) for stamp in stamps_us], **more}
        return json.dumps(about, indent=1, sort_keys=True)

    def finish(self, settings: dict[str, Any], stamps_us: Sequence[int], **more: Any) -> None:
        """Write the listing, which marks the folder as complete.

        Parameters
        ----------
        settings : dict
            As given to `prepare`.
        stamps_us : sequence of int
            Names of the images in the order of time [us].
        **more
            Further entries, JSON values only.

        Raises
        ------
        ValueError
            If an image is missing; the message names it.
        """
        for path in (self.path(stamp, name) for stamp in stamps_us for name in self.subfolders):
            if not path.is_file():
                raise ValueError(f"{path}: missing, the images of {self.listing} are not complete")
        write_text(Path(self.folder) / self.listing, self.describe(settings, stamps_us, **more))

    def read(self) -> dict[str, Any]:
        """Read the listing.

        Returns
        -------
        about : dict
            ``stamps_us`` (list of int), ``settings`` (dict) and what else was given to `finish`.

        Raises
        ------
        ValueError
            If the listing is missing or broken; the message names it.
        """
        path = Path(self.folder) / self.listing
        if not path.is_file():
            raise ValueError(f"{path}: missing; it is written when all images of the session are there")
        try:
            about = dict(json.loads(read_text(path)))
            stamps_us = [int(stamp) for stamp in about["stamps_us"]]
            return {**about, "stamps_us": stamps_us, "settings": dict(about["settings"])}
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: not a list of images ({error!r})") from error


def read_marker(path: Path | str) -> dict[str, Any]:
    """Read a ``settings.json``; return an empty dict if it is missing or not a JSON object."""
    try:
        found = json.loads(read_text(path))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def is_used(folder: Path | str) -> bool:
    """Check whether a folder holds any file or folder that is not hidden; False where it is absent."""
    return Path(folder).exists() and any(not path.name.startswith(".") for path in Path(folder).iterdir())
