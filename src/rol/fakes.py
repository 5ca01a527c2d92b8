"""The fakes room: one fake lidar image per radar scan, made from a folder of pairs and kept as files.

A folder holds ``<us>.png`` named by the radar's stamp, ``settings.json`` from the start and ``fake.json``
once all is there, so a run that was stopped goes on, and a folder that is not whole is not taken for whole.
Images are uint8 (h, w), 0 empty to 255 occupied, row 0 farthest forward, column 0 farthest left.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

try:
    from .files import prepare_images, read_text, write_bytes, write_text
except ImportError:  # this file was copied on its own
    from files import prepare_images, read_text, write_bytes, write_text

if TYPE_CHECKING:
    from .pix2pix import ResnetGenerator


def prepare_fakes(folder: str | Path, settings: dict[str, Any]) -> set[int]:
    """Prepare a folder for generated images of these settings and list those it already holds.

    Images made with other settings are removed.

    Parameters
    ----------
    folder : path
        Folder of the fakes of one session; made if absent.
    settings : dict
        Everything the images depend on, JSON values only; the weights go in as their checksum.

    Returns
    -------
    stamps_us : set of int
        Radar stamps of the images that are there [us].

    Raises
    ------
    ValueError
        If the folder is not empty and was not prepared by this function; nothing is removed.
    """
    return prepare_images(folder, settings, (".",), "fake.json")


def write_fakes(
    generator: ResnetGenerator, pairs: str | Path, folder: str | Path, stamps_us: Sequence[int]
) -> Iterator[int]:
    """Generate and save the fake lidar images of some scans, one after the other.

    Parameters
    ----------
    generator : ResnetGenerator
        The trained network.
    pairs : path
        Folder of the pairs of the session; only its radar images are read.
    folder : path
        Folder of the fakes of the session.
    stamps_us : sequence of int
        Radar stamps of the scans [us].

    Yields
    ------
    stamp_us : int
        Radar stamp of each fake written [us].
    """
    from .pix2pix import generate

    for stamp in stamps_us:
        fake = generate(generator, read_image(Path(pairs) / "radar" / f"{int(stamp)}.png"))
        write_bytes(Path(folder) / f"{int(stamp)}.png", cv2.imencode(".png", fake)[1].tobytes())
        yield int(stamp)


def finish_fakes(
    folder: str | Path, settings: dict[str, Any], stamps_us: Sequence[int], points: dict[str, Any]
) -> None:
    """Write ``fake.json``, which makes a folder of fakes whole; every fake must be there.

    Parameters
    ----------
    folder : path
        Folder of the fakes of one session.
    settings : dict
        As given to `prepare_fakes`.
    stamps_us : sequence of int
        Radar stamps in the order of time [us].
    points : dict
        How those who read the fakes make points of them: arguments of `rol.bev.image_to_points`.

    Raises
    ------
    ValueError
        If one is missing; the message names it.
    """
    for stamp in stamps_us:
        path = Path(folder) / f"{int(stamp)}.png"
        if not path.is_file():
            raise ValueError(f"{path}: missing, the fakes are not complete")
    stamps = [int(stamp) for stamp in stamps_us]
    about = {"settings": settings, "points": points, "stamps_us": stamps}
    write_text(Path(folder) / "fake.json", json.dumps(about, indent=1, sort_keys=True))


def list_fakes(folder: str | Path) -> tuple[list[int], dict[str, Any]]:
    """List the radar stamps of a complete folder of fakes, and say how points are made of them.

    Parameters
    ----------
    folder : path
        Folder of the fakes of one session.

    Returns
    -------
    stamps_us : list of int
        Radar stamps in the order of time [us].
    points : dict
        Arguments of `rol.bev.image_to_points`.

    Raises
    ------
    ValueError
        If ``fake.json`` is missing or broken; the message names it.
    """
    path = Path(folder) / "fake.json"
    if not path.is_file():
        raise ValueError(f"{path}: missing; chapter 05 writes it when all fakes of the session are there")
    try:
        about = json.loads(read_text(path))
        return [int(stamp) for stamp in about["stamps_us"]], dict(about["points"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a list of fakes ({error})") from error


def read_image(path: str | Path) -> np.ndarray:
    """Read a grey PNG.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    image : array, shape (h, w), uint8
        The image.

    Raises
    ------
    ValueError
        If the file is missing or holds no grey image of 8 bits; the message names it.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: the image is missing")
    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if image is None or image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"{path}: not a readable grey image of 8 bits")
    return image
