"""The contents of a scene file before it becomes a scene: parts in file units and file axes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.scene import LinearRgb, Material

if TYPE_CHECKING:
    from PIL import Image

Axis = Literal["x", "y", "z"]


class SceneError(ValueError):
    """A scene file cannot be used; the message names the file, what is wrong and what would do."""


@dataclass(kw_only=True, eq=False)
class Part:
    """Triangles that share a material and belong to one instance."""

    name: str
    positions: NDArray[np.float64]
    """In the part's own frame and file units, shape [V, 3]."""
    faces: NDArray[np.int64]
    """Vertex indices, shape [F, 3]."""
    matrix: NDArray[np.float64]
    """Takes positions to the frame of the file, shape [4, 4]."""
    normals: NDArray[np.float64] | None = None
    """Of each vertex, in the part's own frame, shape [V, 3]; None: the file has none."""
    uv: NDArray[np.float64] | None = None
    """v = 1 is the top row of the texture, shape [V, 2]."""
    corner_color: NDArray[np.float64] | None = None
    """Linear colour of each corner of each face, multiplies the material, shape [F, 3, 3]."""
    material: int = 0
    """Index into `Source.materials`."""
    instance: int = 0
    """Index into `Source.instance_names`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Lamp:
    """A light as the file has it."""

    kind: Literal["point", "directional"]
    vector: NDArray[np.float64]
    """Position in file units (point) or direction in which the light travels (directional), shape [3]."""
    intensity: LinearRgb
    """In the file's own unit: candela (point), lux (directional)."""


@dataclass(kw_only=True, eq=False)
class Source:
    """Everything that was read from one file."""

    parts: list[Part] = field(default_factory=list)
    materials: list[Material] = field(default_factory=list)
    instance_names: list[str] = field(default_factory=list)
    instance_labels: dict[str, str] = field(default_factory=dict)
    """Classes of instances, by name, as far as the file says them."""
    lamps: list[Lamp] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    unit_m: float = 1.0
    """Metres per file unit."""
    unit_reason: str = ""
    up_axis: Axis | None = None
    """The up axis that the file itself states; None: it states none."""
    up_default: Axis = "z"
    """The up axis of the format, where neither the file states one nor a building shows it."""
    up_reason: str = ""
    """Why `up_axis` is believed, or what `up_default` rests on."""


def decode_picture(data: bytes | Image.Image, *, file: str, name: str) -> NDArray[np.uint8]:
    """Decode a picture to sRGB texels, uint8 [H, W, 3]. Alpha is dropped; 16-bit grey is scaled to 8 bits.

    Raises:
        SceneError: If the bytes are no picture, or a truncated one.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data)) if isinstance(data, bytes) else data as picture:
            if picture.mode.startswith("I"):  # convert("RGB") would clip 16 bits at 255
                grey = (np.asarray(picture, dtype=np.float64) / 257.0 + 0.5).clip(0, 255).astype(np.uint8)
                return np.repeat(grey[:, :, None], 3, axis=2)
            return np.ascontiguousarray(np.asarray(picture.convert("RGB"), dtype=np.uint8))
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise SceneError(
            f"{file}: texture {name!r} cannot be decoded ({error}); PNG, JPEG and the like will do"
        ) from error


def rgb(value: Sequence[float] | NDArray[np.float64]) -> LinearRgb:
    """Return the first three elements as a colour."""
    return float(value[0]), float(value[1]), float(value[2])


def unique_name(name: str, taken: set[str]) -> str:
    """Return `name`, with a number behind it if it is taken, and take it."""
    candidate, count = name, 1
    while candidate in taken:
        count += 1
        candidate = f"{name}.{count}"
    taken.add(candidate)
    return candidate
