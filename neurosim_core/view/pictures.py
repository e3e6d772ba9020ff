"""Packets as colour pictures, for Rerun and for the overview.

Events: a brighter pixel is red, a darker one blue, one without events white. The last event of a pixel
chooses the hue, the number of its events the strength: a pixel with n events has covered 1 - 0.4^n of the
white, up to n = 4. Each label has a colour. The components of a normal, -1 to 1, are red, green and blue. The
direction of optical flow is the hue, its length the saturation.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from neurosim_core.packets import EventArrays, Packet, as_numpy, join_events, schema_of

PictureKind = Literal["colour", "values", "depth", "segmentation", "normals", "flow"]
_KINDS: dict[str, PictureKind] = {
    "rgb8": "colour",
    "mono8": "colour",
    "rgb16": "colour",
    "mono16": "colour",
    **{f"bayer_{order}{bits}": "colour" for order in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)},
    "32FC1": "depth",
    "32FC2": "flow",
    "32FC3": "normals",
    "32SC1": "segmentation",
}
"""What pictures of an encoding show."""
_NOTHING_SRGB = (233, 236, 239)

BACKGROUND_SRGB = (255, 255, 255)
ON_SRGB = (200, 16, 32)
OFF_SRGB = (24, 60, 190)
_STRENGTHS = tuple(1.0 - 0.4**n for n in range(1, 5))


_WHITE = np.array(BACKGROUND_SRGB, dtype=np.float64)
_SHADES = [_WHITE + part * (np.array(color) - _WHITE) for color in (OFF_SRGB, ON_SRGB) for part in _STRENGTHS]

PALETTE = np.round([_WHITE, *_SHADES]).astype(np.uint8)
"""sRGB colour of each class, shape [9, 3]: 0 no event, 1-4 last event darker, 5-8 brighter, by count."""


def picture_of(packet: Packet) -> tuple[PictureKind, NDArray[Any]]:
    """Return what the picture of a packet shows, and its pixels, shape [H, W] or [H, W, C].

    The packet's class declares it by `display`; "image" goes by the field `encoding` if there is one, else
    uint8 is a picture in colour or grey, and numbers of other types are values.
    """
    schema = schema_of(type(packet))
    names = [f.name for f in schema.fields if len(f.shape) >= 2 and not f.varying]
    if not names:
        raise ValueError(f"a packet of type {schema.name!r} has no field of shape [H, W]")
    data = as_numpy(getattr(packet, names[0]))
    kind: Any = schema.display
    if kind == "image":
        encoding = getattr(packet, "encoding", None)
        if encoding is not None and encoding not in _KINDS:
            raise ValueError(f"cannot show a picture of encoding {encoding!r}, known: {', '.join(_KINDS)}")
        if data.dtype == np.uint16:
            data = (data >> 8).astype(np.uint8)
        kind = _KINDS[encoding] if encoding else "colour" if data.dtype == np.uint8 else "values"
    return kind, data


def color_picture(kind: PictureKind, data: NDArray[Any]) -> NDArray[np.uint8]:
    """Return pixels as sRGB, uint8 [H, W, 3]; for all kinds but depth and values."""
    if kind == "segmentation":
        hue = (np.maximum(data, 0) * 0.618034) % 1.0  # steps of the golden ratio keep neighbours apart
        value = np.where(data == 0, 0.9, 0.85 - 0.25 * (np.maximum(data, 0) % 3 == 1))  # 0: mostly none
        return _on_nothing(_hsv(hue, 0.65 * (data != 0), value), data >= 0)
    if kind == "normals":
        return _on_nothing(127.5 * (data + 1.0), np.isfinite(data).all(axis=-1) & (data != 0.0).any(axis=-1))
    if kind == "flow":
        known = np.isfinite(data).all(axis=-1)
        x, y = np.where(known[..., None], data, 0.0).astype(np.float64).transpose(2, 0, 1)
        length = np.hypot(x, y)
        long = max(1e-9, float(np.quantile(length, 0.98)))  # a few near pixels would leave the others white
        return _on_nothing(_hsv(np.arctan2(y, x) / (2.0 * np.pi), np.minimum(length / long, 1.0), 1.0), known)
    return data if data.ndim == 3 else np.repeat(data[..., None], 3, axis=-1)


def _hsv(hue: NDArray[Any], saturation: Any, value: Any) -> NDArray[np.float64]:
    """Return colours in 0 to 255 of a hue (1: a full turn), shape [..., 3]."""
    phase = (np.asarray(hue)[..., None] + np.array([0.0, 2.0 / 3.0, 1.0 / 3.0])) % 1.0
    pure = np.clip(np.abs(6.0 * phase - 3.0) - 1.0, 0.0, 1.0)
    share = np.asarray(saturation)[..., None]
    colors: NDArray[np.float64] = 255.0 * np.asarray(value)[..., None] * (1.0 - share + share * pure)
    return colors


def _on_nothing(colors: NDArray[Any], known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    shown = np.where(known[..., None], np.nan_to_num(colors), _NOTHING_SRGB)
    picture: NDArray[np.uint8] = shown.clip(0.0, 255.0).round().astype(np.uint8)
    return picture


def event_classes(events: EventArrays, *, width: int, height: int) -> NDArray[np.uint8]:
    """Draw events as class numbers of `PALETTE`.

    `events`: events in the order of time; those of one pixel must lie inside the picture. `width`: columns of
    the sensor [px]. `height`: rows of the sensor [px]. Returns classes, shape [H, W].
    """
    pixel = events.y.astype(np.int64) * width + events.x
    count = np.bincount(pixel, minlength=width * height)
    last = np.zeros(width * height, dtype=np.uint8)
    last[pixel] = events.polarity  # of equal indices the last assignment stays
    classes = np.minimum(count, len(_STRENGTHS)) + len(_STRENGTHS) * last
    return classes.astype(np.uint8).reshape(height, width)


def event_picture(events: EventArrays, *, width: int, height: int) -> NDArray[np.uint8]:
    """Draw events as an sRGB picture, shape [H, W, 3]. Arguments as for `event_classes`."""
    return PALETTE[event_classes(events, width=width, height=height)]


class EventWindow:
    """Collects the packets of one event camera and cuts them into windows of equal length.

    Memory is bounded by the events of one window and one packet. A packet that does not continue the current
    window (after a loss or a reset) begins a new one; what was collected for the old one is let go.
    """

    def __init__(self, *, length_ns: int) -> None:
        """Make an empty collector.

        `length_ns`: length of a window [ns]; window k covers (k length, (k + 1) length].
        """
        self._length_ns = length_ns
        self._parts: list[EventArrays] = []
        self._end_ns: int | None = None

    def add(self, events: EventArrays, *, start_ns: int, stamp_ns: int) -> list[tuple[int, EventArrays]]:
        """Add the events of a packet; return each window that it completes, as (end [ns], events).

        `events`: events of the packet; copied. `start_ns`: start of the packet's window [ns]. `stamp_ns`: end
        of the packet's window [ns].
        """
        if self._end_ns is None or not self._end_ns - self._length_ns <= start_ns < self._end_ns:
            self._end_ns = (start_ns // self._length_ns + 1) * self._length_ns
            self._parts = []
        done: list[tuple[int, EventArrays]] = []
        while stamp_ns >= self._end_ns:
            cut = int(np.searchsorted(events.t, self._end_ns // 1000, side="right"))
            self._parts.append(events.rows(slice(0, cut)))
            done.append((self._end_ns, join_events(self._parts)))
            self._parts = []
            events = events.rows(slice(cut, None))
            self._end_ns += self._length_ns
        if len(events.t):
            self._parts.append(join_events([events]))
        return done
