"""Convert point echoes to the bytes of a CTS350-X scan: point spread, speckle, noise, leakage, codes.

All constants here were measured on real scans. Columns are range bins, rows azimuths in the order of the
turn. The field is complex: echoes add with their phases, so speckle and its correlation come out by
themselves.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rol.compiled import compiled
from rol.oxford import N_AZIMUTHS, N_BINS
from rol.radar import MEASURED

# A Hann window over the chirp, its spectrum padded: one cell of the bare spectrum is this many bins.
HANN_BINS = 5.9
NOISE_STEP = 5  # the noise is limited to 1/5.9 of the band, so every fifth bin determines the others
NOISE_RANGES_M = np.array([0.0, 3.0, 6.0, 28.0, 41.0, 80.0, 106.0, 145.0, 165.0])
# Mean noise power at these ranges, from the fraction of code 0 in quiet bins.
NOISE_POWERS = np.array([0.7, 0.75, 1.55, 2.25, 2.35, 2.1, 1.85, 1.55, 1.5])
# The integer power is floor(power + 0.72): with exponential noise this fits the fractions of codes 0, 6, 9,
# 12, ...
ROUNDING = 0.72

# Two-way antenna pattern in azimuth, in rows of 0.9 deg.
PATTERN_ROWS = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 5.5])
PATTERN_DB = np.array([0.0, -1.7, -7.0, -13.5, -20.0, -29.0, -38.0, -42.0, -60.0])
PATTERN_REACH = 5.5

LOG_SCALE = 20.0 * np.log10(2.0)
GREATEST = 6.8e6  # code 136, the greatest ever seen
CLIP_AMPLITUDE = 2020.0  # the receiver clips tones stronger than code 132; 4 / pi of it is code 136
# Amplitude of the second harmonic per square of the echo's: code 32 beside an echo of code 119, 48 beside
# 127.
SECOND_HARMONIC = 7.0e-6

BLOCK = 16  # bins over which the streak a strong echo draws along its row is taken as constant
SKIRT_DB, FAR_SKIRT_DB, TAIL_DB = -47.0, -62.0, -52.0

# Mean code of the leakage close by, at these bins.
LEAKAGE_BINS = np.array([0, 4, 6, 9, 12, 16, 20, 24, 28, 30, 34, 38, 44, 48, 54, 60, 66, 72, 80, 100])
LEAKAGE_CODES = np.array(
    [27, 27, 33, 37, 42, 46, 44, 42, 38, 32, 22, 19, 19, 18, 11, 1, -12, -25, -40, -60.0]
)
N_LEAKAGE, N_COPIES = 100, 5

KERNEL_HALF, KERNEL_STEPS = 48, 16


def power_to_codes(powers: np.ndarray) -> np.ndarray:
    """Convert integer powers to the sensor's half-dB codes.

    The sensor takes its logarithm from the position of the leading one and a straight line through the bits
    below it: p = round(20 log10(2) * (e + m)) for n = 2^e (1 + m). On real scans this gives exactly the
    codes that occur.

    Parameters
    ----------
    powers : array, any shape
        Powers n; below 1 counts as 1.

    Returns
    -------
    codes : array, same shape, uint8
        Codes, 0 for n <= 1.
    """
    mantissa, exponent = np.frexp(np.maximum(np.floor(powers), 1.0))
    return np.floor(LOG_SCALE * (exponent - 1 + 2.0 * mantissa - 1.0) + 0.5).astype(np.uint8)


def codes_to_power(codes: np.ndarray) -> np.ndarray:
    """Convert codes to the power in their middle.

    Parameters
    ----------
    codes : array, any shape
        Half-dB codes.

    Returns
    -------
    powers : array, same shape, float64
        Powers n (real numbers).
    """
    exponent = np.asarray(codes) / LOG_SCALE
    whole = np.floor(exponent)
    return 2.0**whole * (1.0 + exponent - whole)


def range_to_bins(ranges_m: np.ndarray) -> np.ndarray:
    """Convert ranges to fractional bins.

    Parameters
    ----------
    ranges_m : array, any shape
        True ranges [m].

    Returns
    -------
    bins : array, same shape
        Fractional bin, an integer at the middle of a bin.
    """
    return (ranges_m - MEASURED.offset_m) / MEASURED.resolution_m - 0.5


def range_response(bins: np.ndarray) -> np.ndarray:
    """Compute the range response: amplitude of a point some bins away.

    Parameters
    ----------
    bins : array, any shape
        Distance from the point in bins.

    Returns
    -------
    amplitude : array, same shape
        Spectrum of the Hann window, 1 at the point; -3 dB at 4.2 bins, side lobes at -31 dB.
    """
    x = np.asarray(bins, dtype=np.float64) / HANN_BINS
    return 0.5 * (2.0 * np.sinc(x) + np.sinc(x - 1.0) + np.sinc(x + 1.0))


def echoes_to_codes(
    rows: np.ndarray,
    bins: np.ndarray,
    powers: np.ndarray,
    rng: np.random.Generator,
    *,
    noise_scale: float = 1.0,
    streak_scale: float = 1.0,
    interference_rate: float = 0.3,
) -> np.ndarray:
    """Simulate the sensor's record of point echoes.

    Parameters
    ----------
    rows, bins : array, shape (n,)
        Place of every echo in rows and range bins (fractional).
    powers : array, shape (n,)
        Power n at the middle of each echo, before speckle.
    rng : np.random.Generator
        Source of phases, noise and interference.
    noise_scale : float
        Factor on the power of the noise.
    streak_scale : float
        Factor on the power of the streaks that strong echoes draw along their row.
    interference_rate : float
        Mean number of other radars that disturb some rows.

    Returns
    -------
    codes : array, shape (400, 3768), uint8
        Half-dB power codes.
    """
    phases = rng.random(len(rows), dtype=np.float32) * np.float32(2.0 * np.pi)
    field = np.zeros((2, N_AZIMUTHS, N_BINS), dtype=np.float32)
    single = (np.ascontiguousarray(a, dtype=np.float32) for a in (rows, bins, np.sqrt(powers)))
    _splat(field, *single, phases, *_kernels())
    _saturate(field, _kernels()[0])
    n_white = N_BINS // NOISE_STEP + _noise_taps().shape[1] + 1
    white = rng.standard_normal((2, N_AZIMUTHS, n_white), dtype=np.float32)
    floor = streak_scale * _block_energies(field) @ _streak_matrix() + noise_scale * _block_noise()
    leakage = _leakage_field() * (1.0 + 0.2 * rng.standard_normal((2, N_AZIMUTHS, 1), dtype=np.float32))
    field[:, :, :N_LEAKAGE] += leakage
    _add_interference(field, rng, interference_rate)
    codes = np.empty((N_AZIMUTHS, N_BINS), dtype=np.uint8)
    _digitize(field, white, np.sqrt(floor).astype(np.float32), _noise_taps(), _code_table(), codes)
    codes[:, : N_COPIES - 1] = codes[:, N_COPIES - 1 : N_COPIES]
    return codes


def _add_interference(field: np.ndarray, rng: np.random.Generator, rate: float) -> None:
    """Add the interference of other radars to some rows: smooth, bright, along the whole row (in place).

    Parameters
    ----------
    field : array, shape (2, 400, 3768), float32
        Field (real and imaginary plane); changed in place.
    rng : np.random.Generator
        Source of chance.
    rate : float
        Mean number of such radars.
    """
    along, places = np.linspace(0.0, 11.0, N_BINS), np.arange(12)
    for _ in range(rng.poisson(rate)):
        spread = rng.normal(0.0, 5.0, rng.integers(1, 8)).round().astype(int)
        for row in np.unique((rng.integers(N_AZIMUTHS) + spread) % N_AZIMUTHS):
            level = 10.0 ** (rng.uniform(18.0, 42.0) / 40.0)  # amplitude of a code between 18 and 42
            phase = rng.normal(0.0, 5.0, 12) + np.linspace(0.0, rng.normal(0.0, 150.0), 12)
            phase = np.interp(along, places, phase)
            size = level * 10.0 ** np.interp(along, places, rng.normal(0.15, 0.35, 12))
            field[0, row] += (size * np.cos(phase)).astype(np.float32)
            field[1, row] += (size * np.sin(phase)).astype(np.float32)


def _block_energies(field: np.ndarray) -> np.ndarray:
    """Energy of every 16 bins, shape (400, 236); a single echo gives the power at its middle."""
    energies = np.empty((N_AZIMUTHS, -(-N_BINS // BLOCK)), dtype=np.float32)
    _sum_blocks(field, energies)
    return energies / np.float32(np.square(range_response(np.arange(-200, 201))).sum())


@lru_cache(maxsize=1)
def _block_noise() -> np.ndarray:
    ranges = (np.arange(-(-N_BINS // BLOCK)) + 0.5) * BLOCK * MEASURED.resolution_m
    return np.interp(ranges, NOISE_RANGES_M, NOISE_POWERS).astype(np.float32)


@lru_cache(maxsize=1)
def _streak_matrix() -> np.ndarray:
    """What an echo in block i adds to the floor of block j, as a fraction of its power."""
    blocks = np.arange(-(-N_BINS // BLOCK))
    away = (blocks[None, :] - blocks[:, None]) * float(BLOCK)
    skirt = 10.0 ** (SKIRT_DB / 10.0) / (1.0 + (np.abs(away) / 50.0) ** 1.5) + 10.0 ** (FAR_SKIRT_DB / 10.0)
    tail = np.where(away > 0, 10.0 ** (TAIL_DB / 10.0) * np.exp(-np.maximum(away, 0.0) / 350.0), 0.0)
    return (skirt + tail).astype(np.float32)


@lru_cache(maxsize=1)
def _kernels() -> tuple[np.ndarray, np.ndarray]:
    """Range responses for every 1/16 bin, and the antenna pattern as amplitude for every 1/16 row."""
    shifts = np.arange(KERNEL_STEPS)[:, None] / KERNEL_STEPS
    response = range_response(np.arange(-KERNEL_HALF, KERNEL_HALF + 2)[None, :] - shifts)
    rows = np.arange(int(PATTERN_REACH * 16) + 2) / 16.0
    pattern = 10.0 ** (np.interp(rows, PATTERN_ROWS, PATTERN_DB) / 20.0)
    return response.astype(np.float32), pattern.astype(np.float32)


@lru_cache(maxsize=1)
def _noise_taps() -> np.ndarray:
    """Weights that spread white noise of every fifth bin over all bins, shape (5, taps); unit power."""
    reach = 3
    away = np.arange(NOISE_STEP)[:, None] - NOISE_STEP * np.arange(-reach + 1, reach + 1)[None, :]
    taps = range_response(away)
    return (taps / np.sqrt(2.0 * np.square(taps).sum(axis=1, keepdims=True))).astype(np.float32)


@lru_cache(maxsize=1)
def _code_table() -> np.ndarray:
    return power_to_codes(np.arange(4096))


@lru_cache(maxsize=1)
def _leakage_field() -> np.ndarray:
    """The sensor's own leakage, a fixed pattern over azimuth and range, shape (2, 400, 100)."""
    rng = np.random.default_rng(350)
    size = np.sqrt(codes_to_power(np.interp(np.arange(N_LEAKAGE), LEAKAGE_BINS, LEAKAGE_CODES)))
    smooth = np.zeros((2, N_AZIMUTHS, N_LEAKAGE))
    along_rows, along_bins = np.fft.fftfreq(N_AZIMUTHS)[:, None], np.fft.fftfreq(N_LEAKAGE)[None, :]
    for rows, share in ((25.0, 0.45), (3.0, 0.3)):
        window = np.exp(-2.0 * np.pi**2 * ((along_rows * rows) ** 2 + (along_bins * 4.0) ** 2))
        part = np.fft.ifft2(np.fft.fft2(rng.standard_normal(smooth.shape)) * window).real
        smooth += share * part / part.std()
    # Two paths of opposite phase cancel in a dark line near bin 32.
    smooth[0] += np.tanh((32.0 - np.arange(N_LEAKAGE)) / 3.0)
    return (size * smooth).astype(np.float32)


@compiled(fastmath=True)
def _splat(field, rows, bins, amplitudes, phases, response, pattern):  # pragma: no cover (compiled)
    n_rows, n_bins = field.shape[1], field.shape[2]
    for i in range(len(rows)):
        base = int(np.floor(bins[i]))
        if base < 0 or base >= n_bins:
            continue
        step = int((bins[i] - base) * KERNEL_STEPS)
        first = max(int(np.ceil(rows[i] - PATTERN_REACH)), 0)
        last = min(int(np.floor(rows[i] + PATTERN_REACH)), n_rows - 1)
        for row in range(first, last + 1):
            amplitude = amplitudes[i] * pattern[int(abs(row - rows[i]) * 16.0 + 0.5)]
            if amplitude * amplitude < 0.05:
                continue
            half = 12 if amplitude * amplitude < 1000.0 else KERNEL_HALF
            low, high = max(base - half, 0), min(base + half + 1, n_bins - 1)
            real, imaginary = amplitude * np.cos(phases[i]), amplitude * np.sin(phases[i])
            weights = response[step, low - base + KERNEL_HALF : high - base + KERNEL_HALF + 1]
            reals, imaginaries = field[0, row, low : high + 1], field[1, row, low : high + 1]
            for k in range(high - low + 1):
                reals[k] += weights[k] * real
                imaginaries[k] += weights[k] * imaginary


@compiled
def _saturate(field, response):  # pragma: no cover (compiled)
    """Clip each row's strongest echo and add its harmonics at 2, 3, 5 and 7 times its bin, in place."""
    for row in range(field.shape[1]):
        peak, power = _strongest_bin(field, row)
        if peak < 0:
            continue
        amplitude = np.sqrt(power)
        place = _interpolate_peak(field, row, peak, amplitude)
        phase = np.arctan2(field[1, row, peak], field[0, row, peak])
        half_angle = np.arcsin(min(CLIP_AMPLITUDE / amplitude, 1.0))
        gain = 2.0 / np.pi * (half_angle + 0.5 * np.sin(2.0 * half_angle))  # of the clipped fundamental
        for b in range(field.shape[2]):
            field[0, row, b] *= gain
            field[1, row, b] *= gain
        for order in (2, 3, 5, 7):
            level = _harmonic_amplitude(order, amplitude, gain, half_angle)
            centre = int(np.floor(order * place + 0.5 * (order - 1)))
            if level >= 0.3:
                _add_tone(field, row, centre, level, order * phase, response)


@compiled
def _strongest_bin(field, row):  # pragma: no cover (compiled)
    """Bin and power of a row's strongest echo beyond the leakage; bin -1 if none comes near saturation."""
    power, peak = np.float32(2e4), -1
    for b in range(8, field.shape[2] - 1):
        here = field[0, row, b] ** 2 + field[1, row, b] ** 2
        if here > power:
            power, peak = here, b
    return peak, power


@compiled
def _interpolate_peak(field, row, peak, amplitude):  # pragma: no cover (compiled)
    """Fractional bin of a peak, from the amplitudes of its two neighbours."""
    before = np.hypot(field[0, row, peak - 1], field[1, row, peak - 1])
    after = np.hypot(field[0, row, peak + 1], field[1, row, peak + 1])
    return peak + 0.5 * (after - before) / max(2.0 * amplitude - before - after, 1e-3)


@compiled
def _harmonic_amplitude(order, amplitude, gain, half_angle):  # pragma: no cover (compiled)
    """Compute a harmonic's amplitude: square law for the second, a clipped sine's for the odd ones."""
    if order == 2:
        return SECOND_HARMONIC * (gain * amplitude) ** 2
    below = np.sin((order - 1) * half_angle) / (order - 1)
    above = np.sin((order + 1) * half_angle) / (order + 1)
    clipped = np.cos(order * half_angle) / order * min(CLIP_AMPLITUDE, amplitude)
    return 4.0 / np.pi * abs(0.5 * amplitude * (below - above) + clipped)


@compiled
def _add_tone(field, row, centre, level, phase, response):  # pragma: no cover (compiled)
    """Add the range response of one tone to a row, if it lies within the scan."""
    if centre + KERNEL_HALF >= field.shape[2]:
        return
    for k in range(-KERNEL_HALF, KERNEL_HALF + 1):
        if centre + k >= 0:
            weight = level * response[0, k + KERNEL_HALF]
            field[0, row, centre + k] += weight * np.cos(phase)
            field[1, row, centre + k] += weight * np.sin(phase)


@compiled(fastmath=True)
def _sum_blocks(field, energies):  # pragma: no cover (compiled)
    n_bins = field.shape[2]
    for row in range(energies.shape[0]):
        for block in range(energies.shape[1]):
            total = np.float32(0.0)
            for b in range(block * BLOCK, min((block + 1) * BLOCK, n_bins)):
                total += field[0, row, b] ** 2 + field[1, row, b] ** 2
            energies[row, block] = total


@compiled(fastmath=True)
def _digitize(field, white, floors, taps, table, codes):  # pragma: no cover (compiled)
    """Add the receiver's noise to the field and write the codes of its power, row by row."""
    n_bins = codes.shape[1]
    noise = np.empty((2, -(-n_bins // NOISE_STEP) * NOISE_STEP), dtype=np.float32)
    powers = np.empty(n_bins, dtype=np.float32)
    for row in range(codes.shape[0]):
        for part in range(2):
            _spread_noise(white[part, row], taps, noise[part])
        _detect(field[0, row], field[1, row], noise, floors[row], powers)
        _encode(powers, table, codes[row])


@compiled(fastmath=True)
def _spread_noise(white, taps, noise):  # pragma: no cover (compiled)
    """Interpolate white noise of every fifth bin, shape (n,), to all bins by the 5 x 6 filter taps."""
    for phase in range(NOISE_STEP):
        a, b, c, d, e, f = taps[phase]
        for g in range(len(noise) // NOISE_STEP):
            early = a * white[g] + b * white[g + 1] + c * white[g + 2]
            noise[g * NOISE_STEP + phase] = early + d * white[g + 3] + e * white[g + 4] + f * white[g + 5]


@compiled(fastmath=True)
def _detect(real, imaginary, noise, floors, powers):  # pragma: no cover (compiled)
    """Power of a row's field with noise, whose amplitude runs linearly between the blocks of 16 bins."""
    n_bins, n_blocks = len(powers), len(floors)
    for block in range(n_blocks - 1):
        floor = floors[block]
        slope = (floors[block + 1] - floor) / np.float32(BLOCK)
        for k in range(2 * BLOCK if block == n_blocks - 2 else BLOCK):
            b = block * BLOCK + k
            if b < n_bins:
                amplitude = floor + slope * np.float32(k)
                x = noise[0, b] * amplitude + real[b]
                y = noise[1, b] * amplitude + imaginary[b]
                powers[b] = min(x * x + y * y + np.float32(ROUNDING), np.float32(GREATEST))


@compiled(fastmath=True)
def _encode(powers, table, codes):  # pragma: no cover (compiled)
    """Codes of powers, as in `power_to_codes`; those of small powers from a table."""
    for b in range(len(codes)):
        n = int(powers[b])
        if n < len(table):
            codes[b] = table[n]
        else:
            exponent = 12
            while (n >> exponent) > 1:
                exponent += 1
            codes[b] = int(LOG_SCALE * (exponent + n / (1 << exponent) - 1.0) + 0.5)
