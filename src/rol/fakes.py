"""The fakes room: one fake lidar image per radar scan, made from a folder of pairs and kept as files.

A folder holds ``<us>.png`` named by the radar's stamp, ``settings.json`` from the start and ``fake.json``
once all is there, so a run that was stopped goes on, and a folder that is not whole is not taken for whole.
Images are uint8 (h, w), 0 empty to 255 occupied, row 0 farthest forward, column 0 farthest left.
"""

from __future__ import annotations

import hashlib
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
    from .pix2pix import Generator


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


def translate_session(
    weights: str | Path,
    pairs: str | Path,
    folder: str | Path,
    *,
    threshold: int = 0,
    device: str = "cpu",
    bf16: bool | str = "auto",
) -> Iterator[int]:
    """Generate the lidar images of a session that are missing; a complete folder is not touched.

    Parameters
    ----------
    weights : path
        File of the network.
    pairs : path
        Folder of the pairs of the session.
    folder : path
        Folder of the generated images of the session. Images of another network or of other pairs are removed.
    threshold : int
        Smallest grey value that counts as a point, 1 to 255; 0 for the one that comes with the weights.
    device : str
        Where the network runs, "cpu" or "cuda".
    bf16 : bool or "auto"
        Whether to multiply in bfloat16, see `rol.pix2pix.choose_bf16`.

    Yields
    ------
    stamp_us : int
        Radar stamp of each image that is there, in the order of time [us].

    Raises
    ------
    ValueError
        If the weights or a radar image cannot be used; the message names the file.
    """
    from .pairs import list_pairs
    from .pix2pix import choose_bf16, load_network

    stamps_us = list_pairs(pairs)
    described = _read_settings(Path(pairs) / "pairs.json")
    network = load_network(weights)
    points = network.points | ({"threshold": threshold} if threshold else {})
    checksum = hashlib.sha256(Path(weights).read_bytes()).hexdigest()
    settings = {"weights": checksum, "bf16": bf16, "pairs": described}
    whole = Path(folder) / "fake.json"
    if whole.is_file() and whole.read_bytes() == _describe_fakes(settings, stamps_us, points).encode():
        yield from stamps_us
        return
    there, fast = prepare_fakes(folder, settings), choose_bf16(bf16, device)
    generator = network.generator.to(device)
    for stamp in stamps_us:
        yield from [stamp] if stamp in there else write_fakes(generator, pairs, folder, [stamp], bf16=fast)
    finish_fakes(folder, settings, stamps_us, points)


def write_fakes(
    generator: Generator,
    pairs: str | Path,
    folder: str | Path,
    stamps_us: Sequence[int],
    *,
    bf16: bool = False,
) -> Iterator[int]:
    """Generate and save the fake lidar images of some scans, one after the other.

    Parameters
    ----------
    generator : Generator
        The trained network.
    pairs : path
        Folder of the pairs of the session; only its radar images are read.
    folder : path
        Folder of the fakes of the session.
    stamps_us : sequence of int
        Radar stamps of the scans [us].
    bf16 : bool
        Multiply in bfloat16, see `rol.pix2pix.generate`.

    Yields
    ------
    stamp_us : int
        Radar stamp of each fake written [us].
    """
    from .pix2pix import generate

    for stamp in stamps_us:
        radar = read_image(Path(pairs) / "radar" / f"{int(stamp)}.png")
        fake = generate(generator, radar, bf16=bf16)
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
    write_text(Path(folder) / "fake.json", _describe_fakes(settings, stamps_us, points))


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


def read_points(
    folder: str | Path, stamps_us: Sequence[int], twists: Sequence[Sequence[float]] | None = None
) -> Iterator[np.ndarray]:
    """Read the generated points of scans, one scan after the other.

    Parameters
    ----------
    folder : path
        Complete folder of the generated images of one session.
    stamps_us : sequence of int
        Radar stamps of the scans [us].
    twists : sequence of (vx, vy, yaw rate), optional
        Body velocity in each scan [m/s, m/s, rad/s]. With it points are moved to mid-scan, see
        `rol.radar.compensate_points`; points of images that are motion-compensated already stay where they are.

    Yields
    ------
    points : array, shape (n, 2)
        Points in the radar frame [m].

    Raises
    ------
    ValueError
        If the folder is not complete or an image cannot be read; the message names the file.
    """
    from .bev import image_to_points
    from .radar import ScanMotion, compensate_points

    folder = Path(folder)
    how = list_fakes(folder)[1]
    pairs = _read_settings(folder / "fake.json").get("pairs", {})
    if twists is None or pairs.get("motion") == "corrected":
        twists = [None] * len(stamps_us)
    for stamp, twist in zip(stamps_us, twists, strict=True):
        points = image_to_points(read_image(folder / f"{int(stamp)}.png"), **how)
        yield points if twist is None else compensate_points(points, ScanMotion(twist))


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


def _read_settings(path: Path) -> dict[str, Any]:
    """Read the settings that a ``pairs.json`` or ``fake.json`` holds."""
    try:
        return dict(json.loads(read_text(path))["settings"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: holds no settings ({error})") from error


def _describe_fakes(settings: dict[str, Any], stamps_us: Sequence[int], points: dict[str, Any]) -> str:
    """Put down what ``fake.json`` holds."""
    about = {"settings": settings, "points": points, "stamps_us": [int(stamp) for stamp in stamps_us]}
    return json.dumps(about, indent=1, sort_keys=True)
