"""Statistics of radar scans, real or virtual: how bright, how noisy, how sharp, how regular they are.

Every function takes the power codes of one scan, shape (400, 3768), or of several, shape (n, 400, 3768), and
pools what it finds. The same numbers from real and from virtual scans, side by side, tell how near the
simulator has come. Rows are azimuths and neighbours in time (the turn is not closed); columns are range bins.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

BRIGHTNESS_CODES = (40, 60, 80, 100, 120)
ZERO_RANGES_M = (3.0, 28.0, 41.0, 80.0, 106.0, 145.0)
NEAR_RANGES_M = (0.0, 0.86, 2.0, 3.0)
PEAK_EDGES = (0, 110, 130, 133, 256)
MEASURED_RANGE_RESOLUTION = 0.0438  # bins are named by bin * resolution here, as the measured figures are
QUIET_CODE = 30  # a piece of a row whose codes stay below this holds noise and little else
FAR_BIN = 3000


def forbidden_codes() -> np.ndarray:
    """List the codes that no scan can hold, because the sensor's powers are integers.

    Returns
    -------
    codes : array, shape (11,), uint8
        1-5, 7, 8, 10, 11, 13, 16: what round(6.0206 (e + m)) skips for n = 2**e (1 + m) = 1, 2, 3, ...
    """
    mantissa, exponent = np.frexp(np.arange(1.0, 64.0))
    reachable = np.round(20.0 * np.log10(2.0) * (exponent + 2.0 * mantissa - 2.0))
    return np.setdiff1d(np.arange(24), reachable).astype(np.uint8)


def brightness_shares(codes: np.ndarray, codes_from: tuple[int, ...] = BRIGHTNESS_CODES) -> dict[int, float]:
    """Give the share of pixels at or above each code.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    codes_from : tuple of int
        Codes to count from.

    Returns
    -------
    shares : dict
        Code -> share of all pixels [0..1].
    """
    counts = np.bincount(np.asarray(codes).ravel(), minlength=256)
    tail = counts[::-1].cumsum()[::-1] / counts.sum()
    return {code: float(tail[code]) for code in codes_from}


def zero_shares(codes: np.ndarray, ranges_m: tuple[float, ...] = ZERO_RANGES_M, half_bins: int = 15) -> dict:
    """Give the share of code 0 in quiet cells at several ranges.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    ranges_m : tuple of float
        Ranges, counted as bin * 0.0438 [m].
    half_bins : int
        Pieces of 2 * half_bins bins around a range are looked at; those that reach code 30 are left out.

    Returns
    -------
    shares : dict
        Range [m] -> share of zeros [0..1]; NaN where no piece is quiet.
    """
    scans = _rows(codes)
    shares = {}
    for range_m in ranges_m:
        middle = round(range_m / MEASURED_RANGE_RESOLUTION)
        piece = scans[:, max(middle - half_bins, 0) : middle + half_bins]
        quiet = piece[piece.max(axis=1) < QUIET_CODE]
        shares[range_m] = float((quiet == 0).mean()) if len(quiet) else float("nan")
    return shares


def noise_correlation(codes: np.ndarray, lags: int = 7, bins: tuple[int, int] = (700, 1100)) -> list[float]:
    """Measure how alike the codes of quiet cells are along the range.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    lags : int
        Greatest distance in bins.
    bins : tuple of int
        Range bins looked at; the quieter 30 % of the rows (by their greatest code there) are taken.

    Returns
    -------
    correlation : list of float
        Pearson correlation at lags 1..lags.
    """
    piece = _rows(codes)[:, slice(*bins)]
    greatest = piece.max(axis=1)
    quiet = piece[greatest <= np.percentile(greatest, 30)].astype(np.float64)
    quiet -= quiet.mean(axis=1, keepdims=True)
    power = float((quiet**2).mean())
    return [
        float((quiet[:, :-lag] * quiet[:, lag:]).mean() / max(power, 1e-12)) for lag in range(1, lags + 1)
    ]


def azimuth_correlation(codes: np.ndarray, bins: tuple[int, int] = (1500, 1900)) -> float:
    """Measure how alike the noise of neighbouring azimuths is.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    bins : tuple of int
        Range bins looked at; pairs of neighbours that are both among the quieter 30 % are taken.

    Returns
    -------
    correlation : float
        Pearson correlation of codes; NaN when no two quiet rows are neighbours.
    """
    scans = np.asarray(codes).reshape((-1,) + np.shape(codes)[-2:])[:, :, slice(*bins)]
    greatest = scans.max(axis=2)
    quiet = greatest <= np.percentile(greatest, 30)
    both = quiet[:, :-1] & quiet[:, 1:]
    if not both.any():
        return float("nan")
    return float(np.corrcoef(scans[:, :-1][both].ravel(), scans[:, 1:][both].ravel())[0, 1])


def near_field(codes: np.ndarray, ranges_m: tuple[float, ...] = NEAR_RANGES_M) -> dict[float, float]:
    """Give the mean code of the leakage close to the sensor.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    ranges_m : tuple of float
        Ranges, counted as bin * 0.0438 [m].

    Returns
    -------
    codes : dict
        Range [m] -> mean code over all rows.
    """
    scans = _rows(codes)
    return {r: float(scans[:, round(r / MEASURED_RANGE_RESOLUTION)].mean()) for r in ranges_m}


def floor_by_peak(codes: np.ndarray, edges: tuple[int, ...] = PEAK_EDGES) -> dict[str, float]:
    """Give the floor far out, for rows sorted by their strongest return.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    edges : tuple of int
        Edges of the classes of the strongest code beyond bin 60.

    Returns
    -------
    floors : dict
        "low-high" -> median over the rows of the median code beyond bin 3000; NaN for an empty class.
    """
    scans = _rows(codes)
    peaks, floors = scans[:, 60:].max(axis=1), np.median(scans[:, FAR_BIN:], axis=1)
    classes = {}
    for low, high in pairwise(edges):
        inside = floors[(peaks >= low) & (peaks < high)]
        classes[f"{low}-{high}"] = float(np.median(inside)) if len(inside) else float("nan")
    return classes


def point_spread(codes: np.ndarray, reach: tuple[int, int] = (5, 16)) -> dict[str, list[float]]:
    """Measure how a strong point is smeared over azimuth and range.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    reach : tuple of int
        How many rows and bins to each side.

    Returns
    -------
    spread : dict
        "azimuth_db" and "range_db": median level relative to the strongest cell at 0, 1, 2, ... rows or bins
        away [dB], both sides pooled, over peaks of code 116 and more; empty lists when there is none.
    """
    rows_off, bins_off = reach
    scans = np.asarray(codes).reshape((-1,) + np.shape(codes)[-2:]).astype(np.int16)
    column = scans[:, :, 60:-bins_off].argmax(axis=2) + 60
    azimuth, range_ = [], []
    for scan, row in np.argwhere(scans[:, :, 60:-bins_off].max(axis=2) >= 116):
        bin_ = column[scan, row]
        if not rows_off <= row < scans.shape[1] - rows_off:
            continue
        across = scans[scan, row - rows_off : row + rows_off + 1, bin_]
        if across.max() == across[rows_off]:
            azimuth.append(across - across[rows_off])
            range_.append(scans[scan, row, bin_ - bins_off : bin_ + bins_off + 1] - across[rows_off])
    return {"azimuth_db": _fold(azimuth), "range_db": _fold(range_)}


def scan_statistics(codes: np.ndarray) -> dict:
    """Measure all that one scan, or a few, can tell about its sensor.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.

    Returns
    -------
    statistics : dict
        "shares": code -> share of pixels at or above it; "zero_shares": range [m] -> share of code 0 in quiet
        cells; "range_correlation": of the noise at lags 1-7 bins; "azimuth_correlation"; "near_field": range
        [m] -> mean code; "near_copies": True when bins 0-4 are identical; "floors": class of peak -> far
        floor; "point_spread": levels [dB] by distance; "forbidden": number of pixels with a code that cannot
        be; "greatest": greatest code; "shares_40_by_range": share of codes >= 40 by range, edges [m] as keys.

    Raises
    ------
    ValueError
        If the last two axes are not azimuths x range bins of a full scan or the type is not uint8.
    """
    codes = np.asarray(codes)
    if codes.dtype != np.uint8 or codes.ndim < 2 or codes.shape[-1] < 3500:
        raise ValueError(f"codes: expected uint8 of shape (..., 400, 3768), got {codes.dtype} {codes.shape}")
    near = _rows(codes)[:, :5]
    return {
        "shares": brightness_shares(codes),
        "shares_40_by_range": shares_by_range(codes, 40),
        "zero_shares": zero_shares(codes),
        "range_correlation": noise_correlation(codes),
        "azimuth_correlation": azimuth_correlation(codes),
        "near_field": near_field(codes),
        "near_copies": bool((near == near[:, :1]).all()),
        "floors": floor_by_peak(codes),
        "point_spread": point_spread(codes),
        "forbidden": int(np.isin(codes, forbidden_codes()).sum()),
        "greatest": int(codes.max()),
    }


def shares_by_range(
    codes: np.ndarray, code: int, edges_m: tuple[float, ...] = (2.5, 5, 10, 20, 30, 50, 80, 110, 165)
) -> dict:
    """Give the share of pixels at or above a code, ring by ring.

    Parameters
    ----------
    codes : array, shape (..., 400, 3768), uint8
        Scans.
    code : int
        Code to count from.
    edges_m : tuple of float
        Edges of the rings, counted as bin * 0.0438 [m].

    Returns
    -------
    shares : dict
        "low-high" [m] -> share [0..1].
    """
    scans, bins = _rows(codes), [round(edge / MEASURED_RANGE_RESOLUTION) for edge in edges_m]
    names = [f"{low:g}-{high:g}" for low, high in pairwise(edges_m)]
    shares = [float((scans[:, low:high] >= code).mean()) for low, high in pairwise(bins)]
    return dict(zip(names, shares, strict=True))


def _rows(codes: np.ndarray) -> np.ndarray:
    return np.asarray(codes).reshape(-1, np.shape(codes)[-1])


def _fold(profiles: list[np.ndarray]) -> list[float]:
    """Median of both sides of profiles in half dB around their middle, in dB by distance from it."""
    if not profiles:
        return []
    both = np.asarray(profiles)
    middle = both.shape[1] // 2
    folded = [np.median(both[:, [middle - k, middle + k]]) / 2.0 for k in range(middle + 1)]
    return [float(level) for level in folded]
