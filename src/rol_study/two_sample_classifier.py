"""Compare simulated with real scans by a two-sample classifier.

A small convolutional network classifies patches of 16 azimuths x 64 range bins as real or simulated. It is
evaluated on held-out scans. An area under the ROC curve of 0.5 means that the two cannot be separated, 1 that
they always can.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import rankdata

from rol.radar import MEASURED

ROWS, BINS = 16, 64  # size of a patch


@dataclass(frozen=True)
class ClassifierResult:
    """Result of classifiers on held-out scans.

    Attributes
    ----------
    auc : float
        Area under the curve over all patches.
    fold_aucs : array, shape (folds,)
        The same for each held-out group of scans.
    scores : array, shape (2, n, 25, 58)
        Score of each patch ("real" is high), of real and of simulated scans, by scan, azimuth and range.
    """

    auc: float
    fold_aucs: np.ndarray
    scores: np.ndarray


def cut_patches(codes: np.ndarray) -> np.ndarray:
    """Cut scans into non-overlapping patches.

    Parameters
    ----------
    codes : array, shape (n, 400, 3768), uint8
        Scans.

    Returns
    -------
    patches : array, shape (n, 25, 58, 16, 64), uint8
        By scan, azimuth and range; the incomplete patches at the far end are discarded.
    """
    n, rows, bins = len(codes), codes.shape[1] // ROWS, codes.shape[2] // BINS
    cut = codes[:, : rows * ROWS, : bins * BINS].reshape(n, rows, ROWS, bins, BINS)
    return np.ascontiguousarray(cut.transpose(0, 1, 3, 2, 4))


def area_under_curve(real: np.ndarray, simulated: np.ndarray) -> float:
    """Compute the area under the ROC curve: the probability that a real patch scores higher; ties count half.

    Parameters
    ----------
    real, simulated : array, any shape
        Scores.

    Returns
    -------
    auc : float
        Between 0 and 1; 0.5 if the scores do not separate the two.
    """
    real, simulated = np.ravel(real), np.ravel(simulated)
    ranks = rankdata(np.concatenate([real, simulated]))[: len(real)]
    return float((ranks.sum() - 0.5 * len(real) * (len(real) + 1)) / (len(real) * len(simulated)))


def train_classifier(
    real: np.ndarray,
    simulated: np.ndarray,
    rng: np.random.Generator,
    *,
    folds: int = 3,
    epochs: int = 4,
    bf16: bool = False,
) -> ClassifierResult:
    """Train real-or-simulated classifiers by cross-validation over groups of scans.

    Parameters
    ----------
    real, simulated : array, shape (n, 400, 3768), uint8
        Scans; scan i of both is always on the same side of the split, so that a place that
        both show helps neither.
    rng : numpy.random.Generator
        Draws first weights and the order of the patches.
    folds : int
        Groups of neighbouring scans; each is held out once and scored by a network trained on the others.
    epochs : int
        Passes over the patches.
    bf16 : bool
        Multiply in bfloat16, see `rol.pix2pix.has_bf16`; takes half the time there.

    Returns
    -------
    result : ClassifierResult

    Raises
    ------
    ValueError
        If there are not as many real as simulated scans, or fewer scans than groups.
    """
    if len(real) != len(simulated) or not 2 <= folds <= len(real):
        raise ValueError(
            f"{len(real)} real and {len(simulated)} simulated scans cannot be split into {folds}"
        )
    patches = np.stack([cut_patches(real), cut_patches(simulated)])
    scores, aucs = np.empty(patches.shape[:4]), []
    for held_out in np.array_split(np.arange(len(real)), folds):
        trained_on = np.setdiff1d(np.arange(len(real)), held_out)
        classifier = _train(patches[:, trained_on], rng, epochs, bf16)
        scores[:, held_out] = _score(classifier, patches[:, held_out], bf16)
        aucs.append(area_under_curve(*scores[:, held_out]))
    return ClassifierResult(area_under_curve(*scores), np.array(aucs), scores)


def auc_by_group(
    result: ClassifierResult, real: np.ndarray, simulated: np.ndarray
) -> dict[str, dict[str, float]]:
    """Compute the area under the curve for groups of patches.

    Parameters
    ----------
    result : ClassifierResult
        From `train_classifier`.
    real, simulated : array, shape (n, 400, 3768), uint8
        The scans that it was trained and evaluated on.

    Returns
    -------
    aucs : dict
        "range": area under the curve of patches by range "low-high" [m]; "brightest": by the brightest code
        in the patch. 0.5 where the two cannot be separated.
    """
    peaks = np.stack([cut_patches(real), cut_patches(simulated)]).max(axis=(-1, -2))
    range_m = np.broadcast_to((np.arange(peaks.shape[3]) + 0.5) * BINS * MEASURED.resolution_m, peaks.shape)
    found: dict[str, dict[str, float]] = {}
    cases = (
        ("range", range_m, (0, 3, 10, 25, 50, 80, 110, 170)),
        ("brightest", peaks, (0, 24, 34, 50, 70, 90, 256)),
    )
    for name, values, edges in cases:
        found[name] = {}
        for low, high in pairwise(edges):
            inside = (values >= low) & (values < high)
            if inside[0].any() and inside[1].any():
                auc = area_under_curve(result.scores[0][inside[0]], result.scores[1][inside[1]])
                found[name][f"{low}-{high}"] = auc
    return found


def _train(patches: np.ndarray, rng: np.random.Generator, epochs: int, bf16: bool):
    """A network of 3 convolutions, trained by Adam; `patches` has shape (2, n, rows, bins, 16, 64)."""
    import torch
    from torch import nn

    torch.manual_seed(int(rng.integers(2**31)))
    classifier = nn.Sequential(
        nn.Conv2d(1, 16, 5, padding=2),
        nn.MaxPool2d(2),
        nn.ReLU(),  # on a quarter of the values
        nn.Conv2d(16, 32, 3, padding=1),
        nn.MaxPool2d(2),
        nn.ReLU(),
        nn.Conv2d(32, 48, 3, padding=1),
        nn.ReLU(),
        nn.AdaptiveAvgPool2d(1),
        nn.Flatten(),
        nn.Linear(48, 32),
        nn.ReLU(),
        nn.Linear(32, 1),
    ).to(memory_format=torch.channels_last)
    flat = patches.reshape(2, -1, 1, ROWS, BINS)
    images = torch.from_numpy(flat.reshape(-1, 1, ROWS, BINS))
    labels = torch.cat([torch.ones(flat.shape[1]), torch.zeros(flat.shape[1])])
    optimiser = torch.optim.Adam(classifier.parameters(), lr=1e-3)
    n_batches = -(-len(images) // 256)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=epochs * n_batches)
    for _ in range(epochs):
        for batch in np.array_split(rng.permutation(len(images)), n_batches):
            with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
                logits = classifier(_scale(images[batch]))[:, 0]
            loss = nn.functional.binary_cross_entropy_with_logits(logits.float(), labels[batch])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return classifier.eval()


def _score(classifier, patches: np.ndarray, bf16: bool) -> np.ndarray:
    import torch

    images = torch.from_numpy(patches.reshape(-1, 1, ROWS, BINS))
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        scores = [classifier(_scale(part))[:, 0].float() for part in images.split(2048)]
    return torch.cat(scores).numpy().reshape(patches.shape[:4])


def _scale(images):
    import torch

    return (images.float() / 32.0 - 0.5).contiguous(memory_format=torch.channels_last)
