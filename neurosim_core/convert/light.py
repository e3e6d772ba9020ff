"""From the numbers in a picture to linear luminance: transfer functions and the weights of the primaries.

A transfer function is undone as the standard says that a file is tagged with: back to the light that fell on
the camera where the standard defines that (BT.709, BT.2020, SMPTE 240M, HLG), else to the light that a screen
gives off. Luminance 1 is white; in high dynamic range it is the reference white of ITU-R BT.2408, and
highlights are above it.

Reference: ITU-T H.273 (2021), tables 2 and 3 (numbers and functions); IEC 61966-2-1 (sRGB); ITU-R BT.709-6
and BT.2020-2; SMPTE ST 2084 and ITU-R BT.2100-2 (PQ, HLG); ITU-R BT.2408-7 (203 cd/m^2, and 75 % of HLG, are
white).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_PQ_WHITE = 203.0 / 10_000.0
_HLG_WHITE_CODE = 0.75


def _srgb(code: Floats) -> Floats:
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def _bt709(code: Floats) -> Floats:
    alpha, beta = 1.09929682680944, 0.018053968510807
    return np.where(code < 4.5 * beta, code / 4.5, ((code + alpha - 1.0) / alpha) ** (1.0 / 0.45))


def _smpte240m(code: Floats) -> Floats:
    return np.where(code < 4.0 * 0.0228, code / 4.0, ((code + 0.1115) / 1.1115) ** (1.0 / 0.45))


def _pq(code: Floats) -> Floats:
    m1, m2 = 2610.0 / 16384.0, 2523.0 / 4096.0 * 128.0
    c1, c2, c3 = 3424.0 / 4096.0, 2413.0 / 4096.0 * 32.0, 2392.0 / 4096.0 * 32.0
    power = code ** (1.0 / m2)
    return np.asarray((np.maximum(power - c1, 0.0) / (c2 - c3 * power)) ** (1.0 / m1) / _PQ_WHITE)


def _hlg_scene(code: Floats) -> Floats:
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(code <= 0.5, code**2 / 3.0, (np.exp((code - c) / a) + b) / 12.0)


def _hlg(code: Floats) -> Floats:
    return np.asarray(_hlg_scene(code) / _hlg_scene(np.array(_HLG_WHITE_CODE)))


def _log(decades: float) -> Callable[[Floats], Floats]:
    return lambda code: np.where(code > 0.0, 10.0 ** (decades * (code - 1.0)), 0.0)


def _power(gamma: float) -> Callable[[Floats], Floats]:
    return lambda code: code**gamma


TRANSFERS: Mapping[str, Callable[[Floats], Floats]] = MappingProxyType(
    {
        "srgb": _srgb,
        "bt709": _bt709,
        "linear": _power(1.0),
        "gamma22": _power(2.2),
        "gamma28": _power(2.8),
        "smpte240m": _smpte240m,
        "log100": _log(2.0),
        "log316": _log(2.5),
        "pq": _pq,
        "hlg": _hlg,
    }
)
"""Functions from a code in [0, 1] to light, 1 for white, by name."""

_TRANSFER_OF_NUMBER = {
    1: "bt709",
    4: "gamma22",
    5: "gamma28",
    6: "bt709",  # BT.601: the same function
    7: "smpte240m",
    8: "linear",
    9: "log100",
    10: "log316",
    11: "bt709",  # xvYCC: the same function, extended to negative light, which is taken as black
    13: "srgb",
    14: "bt709",  # BT.2020: the same function, with more digits
    15: "bt709",
    16: "pq",
    18: "hlg",
}

_WEIGHTS_709 = (0.2126, 0.7152, 0.0722)
_WEIGHTS_2020 = (0.2627, 0.6780, 0.0593)
BT2020_PRIMARIES = 9
"""Number of the primaries of BT.2020."""
UNSPECIFIED = 2
"""Number of a property that a file does not tell."""


def transfer_of(number: int) -> str | None:
    """Return the name of a transfer function by its number in H.273; None: the file does not tell."""
    if number in (0, UNSPECIFIED, 3):  # 0 and 3 are reserved
        return None
    if number not in _TRANSFER_OF_NUMBER:
        raise ValueError(
            f"transfer function {number} of ITU-T H.273 is not known, known: {sorted(_TRANSFER_OF_NUMBER)};"
            f" choose another one with --transfer"
        )
    return _TRANSFER_OF_NUMBER[number]


def luminance_weights(primaries: int) -> tuple[float, float, float]:
    """Return the weights of red, green and blue in luminance, by the number of the primaries in H.273.

    Those of BT.2020 for BT.2020, and those of BT.709 for all others, from which they differ little.
    """
    return _WEIGHTS_2020 if primaries == BT2020_PRIMARIES else _WEIGHTS_709


def code_step(codes: NDArray[np.float64], floor: float) -> float:
    """Return the largest change of log(luminance + floor) by one step of the stored numbers.

    `codes`: luminance of all numbers in their order, none if light is stored itself.
    """
    return float(np.diff(np.log(codes + floor)).max()) if len(codes) > 1 else 0.0


def find_floor(codes: NDArray[np.float64], step_max: float, *, least: float) -> float:
    """Return the smallest dark floor, at least `least`, with which `code_step` is at most `step_max`.

    It is rounded up to two digits; 1 if that is not enough.
    """
    low, high = least, 1.0
    if code_step(codes, low) <= step_max:
        return low
    while high / low > 1.001:
        middle = (low * high) ** 0.5
        low, high = (low, middle) if code_step(codes, middle) <= step_max else (middle, high)
    digit = 10.0 ** np.floor(np.log10(high) - 1.0)
    return float(min(1.0, round(np.ceil(high / digit) * digit, 12)))
