"""sRGB: 8-bit codes of pictures, and the linear light that they stand for. Reference: IEC 61966-2-1."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_CODE = np.arange(256) / 255.0
LINEAR = np.where(_CODE <= 0.04045, _CODE / 12.92, ((_CODE + 0.055) / 1.055) ** 2.4).astype(np.float32)
"""Linear light of each 8-bit sRGB code. Reference: IEC 61966-2-1."""


def srgb_to_linear(srgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the linear light of 8-bit sRGB values, in [0, 1], the same shape."""
    return LINEAR[srgb]


def linear_to_srgb8(linear: Any) -> NDArray[np.uint8]:
    """Encode linear light in [0, 1] as 8-bit sRGB, rounded. Reference: IEC 61966-2-1."""
    value = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    encoded = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1.0 / 2.4) - 0.055)
    return (encoded * 255.0 + 0.5).astype(np.uint8)
