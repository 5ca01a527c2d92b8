"""Generate the lidar images of a session with a trained network, as a folder that `rol.pairs` reads."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

from rol.pairs import generated_folder, pair_folder, read_image, save_image


def generate_session(
    weights: str | Path,
    pairs: str | Path,
    folder: str | Path,
    *,
    threshold: int = 0,
    device: str = "cpu",
    bf16: bool | str = "auto",
) -> Iterator[int]:
    """Generate the missing lidar images of a session; a complete folder is not changed.

    Parameters
    ----------
    weights : path
        File of the network.
    pairs : path
        Folder of the pairs of the session.
    folder : path
        Folder of the generated images of the session. Images of another network or of other pairs are
        removed.
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
    from rol.pix2pix import choose_bf16, generate, load_network

    recorded, images = pair_folder(pairs), generated_folder(folder)
    about = recorded.read()
    network = load_network(weights)
    points = network.points | ({"threshold": threshold} if threshold else {})
    checksum = hashlib.sha256(Path(weights).read_bytes()).hexdigest()
    settings = {"weights": checksum, "bf16": bf16, "pairs": about["settings"]}
    listing = Path(folder) / images.listing
    listed = images.describe(settings, about["stamps_us"], points=points)
    if listing.is_file() and listing.read_bytes() == listed.encode():
        yield from about["stamps_us"]
        return
    there, fast = images.prepare(settings), choose_bf16(bf16, device)
    generator = network.generator.to(device)
    for stamp in about["stamps_us"]:
        if stamp not in there:
            radar_image = read_image(recorded.path(stamp, "radar"))
            save_image(images.path(stamp), generate(generator, radar_image, bf16=fast))
        yield stamp
    images.finish(settings, about["stamps_us"], points=points)
