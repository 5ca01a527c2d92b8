"""Generate the lidar images of one session; the slow part of chapter 05, as a job of its own for each session.

    python workflow/generate_images.py build/demo/pairs/NAME data/weights/unet.safetensors build/demo/fake/NAME

A run that was stopped goes on with the missing images. Chapter 05 makes the same images where they are missing.
"""

from __future__ import annotations

import argparse
import sys

import torch

import rol_beyond.unet  # noqa: F401 (registers the architecture)
from rol_beyond.generated import generate_session
from rol_book.parameters import positive

BF16 = {"auto": "auto", "true": True, "false": False}


def main(words: list[str] | None = None) -> int:
    """Generate the images; return 0, or 1 after a fault, which is printed on stderr."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pairs", help="folder of the pairs of the session")
    parser.add_argument("weights", help="file of the network")
    parser.add_argument("out", help="folder of the generated images of the session")
    parser.add_argument("--threshold", type=int, default=0, help="grey value; 0: that of the network")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="cpu or cuda")
    parser.add_argument("--bf16", choices=BF16, default="auto", help="use bfloat16; auto: where possible")
    parser.add_argument("--threads", type=positive, default=1, help="threads of the processor")
    given = parser.parse_args(words)
    torch.set_num_threads(given.threads)
    options = {"threshold": given.threshold, "device": given.device, "bf16": BF16[given.bf16]}
    try:
        n_images = sum(1 for _ in generate_session(given.weights, given.pairs, given.out, **options))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{n_images} images in {given.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
