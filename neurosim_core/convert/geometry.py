"""Which part of a picture is taken, and how it gets another size."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

_SIZE = re.compile(r"(\d+)x(\d+)")
_CROP = re.compile(r"(\d+)x(\d+)\+(\d+)\+(\d+)")


@dataclass(frozen=True)
class Crop:
    """A rectangle of a picture."""

    width: int
    """[px]."""
    height: int
    """[px]."""
    x: int = 0
    """First column [px]."""
    y: int = 0
    """First row [px]."""

    def __str__(self) -> str:
        """Return it as `WxH+X+Y`."""
        return f"{self.width}x{self.height}+{self.x}+{self.y}"


def read_size(text: str) -> tuple[int, int]:
    """Return width and height of a text such as 346x260 [px]."""
    match = _SIZE.fullmatch(text)
    if match is None or "0" in match.groups():
        raise ValueError(f"size must be WIDTHxHEIGHT in pixels, such as 346x260, got {text!r}")
    return int(match[1]), int(match[2])


def read_crop(text: str) -> Crop:
    """Return the rectangle of a text such as 640x480+10+0: width, height, first column, first row [px]."""
    match = _CROP.fullmatch(text)
    if match is None or "0" in match.groups()[:2]:
        raise ValueError(f"crop must be WIDTHxHEIGHT+X+Y in pixels, such as 640x480+10+0, got {text!r}")
    return Crop(*map(int, match.groups()))


def largest_crop(crop: Crop, size: tuple[int, int]) -> Crop:
    """Return the largest rectangle in the middle of `crop` that has the shape of `size`, to the pixel."""
    width = max(1, min(crop.width, round(crop.height * size[0] / size[1])))
    height = max(1, min(crop.height, round(crop.width * size[1] / size[0])))
    return Crop(width, height, crop.x + (crop.width - width) // 2, crop.y + (crop.height - height) // 2)


class Resizer:
    """Takes a rectangle of a picture and gives it another size.

    An axis that becomes shorter is averaged over the areas of the larger pixels, exactly: a source pixel that
    lies in two pixels counts in each by the share of its area, so the mean is kept. An axis that becomes
    longer is interpolated linearly between the centres of the source pixels. `source`: width and height of
    the pictures [px]. `size`: width and height of the result [px].
    """

    def __init__(self, source: tuple[int, int], crop: Crop, size: tuple[int, int]) -> None:
        if crop.x + crop.width > source[0] or crop.y + crop.height > source[1]:
            raise ValueError(f"crop must lie inside the {source[0]}x{source[1]} pixels there are, got {crop}")
        self._span = np.s_[crop.y : crop.y + crop.height, crop.x : crop.x + crop.width]
        self._rows = _weights(crop.height, size[1])
        self._columns = _weights(crop.width, size[0])

    def resize(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a picture of light in the new size, shape [height, width]."""
        part = picture[self._span]
        if self._rows is not None:
            part = self._rows @ part
        if self._columns is not None:
            part = (self._columns @ part.T).T
        return np.ascontiguousarray(part)


def _weights(count: int, wanted: int) -> sparse.csr_array | None:
    """Return the matrix that makes `wanted` numbers of `count`; None: they are as many already."""
    if wanted == count:
        return None
    if wanted > count:
        place = ((np.arange(wanted) + 0.5) * (count / wanted) - 0.5).clip(0.0, count - 1.0)
        share = np.maximum(1.0 - np.abs(place[:, None] - np.arange(count)), 0.0)
    else:
        edges = np.arange(wanted + 1) * (count / wanted)
        cells = np.arange(count + 1)
        low = np.maximum(edges[:-1, None], cells[None, :-1])
        high = np.minimum(edges[1:, None], cells[None, 1:])
        share = np.maximum(high - low, 0.0)
    return sparse.csr_array((share / share.sum(axis=1, keepdims=True)).astype(np.float32))
