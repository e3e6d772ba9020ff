"""Frames of light with their times: videos through FFmpeg, and folders of pictures."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from neurosim_core.clock import Rate
from neurosim_core.convert.light import BT2020_PRIMARIES, TRANSFERS, transfer_of
from neurosim_core.convert.luminance import LightTables, LumaDecoder, matrix_of
from neurosim_core.install import need

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
"""Names of pictures in a folder end so, in lower or upper case."""
TIME_UNITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
"""Units of a file of time stamps, and the power of ten that makes nanoseconds of them."""

_GRAY_MODES = ("1", "L", "I;16", "I;16B", "I;16L", "F")
_CONVERTED_MODES = ("P", "PA", "LA", "RGBA", "RGBX", "CMYK", "YCbCr")
_FULL_RANGE = 2
_LIMITED_RANGE = 1


class Frame(NamedTuple):
    """The picture of the camera at an instant."""

    stamp_ns: int
    """As the source tells it, from any origin [ns]."""
    luminance: NDArray[np.float32]
    """Linear, white is 1, shape [H, W]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Description:
    """Properties of a source that are known before its frames are read."""

    name: str
    width: int
    """[px]."""
    height: int
    """[px]."""
    frame_count: int | None
    """As far as the source tells."""
    light: str
    """The conversion of its numbers to light, in words."""
    codes: NDArray[np.float64]
    """Luminance of all numbers that a grey may have, in their order; none if light itself is stored."""
    notes: tuple[str, ...] = ()
    """Assumptions and omissions, one sentence each."""


def open_source(
    path: Path, *, fps: float | None = None, stamps_ns: Sequence[int] | None = None, transfer: str = "auto"
) -> Source:
    """Open a video, or a folder of pictures.

    `path`: the file or folder. Pictures are taken in the natural order of their names: 2 comes before 10.
    `fps`: frames a second; for a video instead of the times in it [Hz]. `stamps_ns`: times of the frames
    [ns], in place of `fps`. `transfer`: name of the transfer function; auto: what the file says, else sRGB.
    """
    if not path.exists():
        raise FileNotFoundError(f"no file or folder {path}")
    clock = _Clock(fps=fps, stamps_ns=stamps_ns, path=path)
    return FolderSource(path, clock, transfer) if path.is_dir() else VideoSource(path, clock, transfer)


def read_stamps(path: Path, *, unit: str = "s") -> list[int]:
    """Read times, one a line, exactly [ns].

    The first word of a line counts (what follows, such as a file name, does not); empty lines and lines that
    begin with # are left out. `unit`: what its numbers are in: s, ms, us or ns.
    """
    if unit not in TIME_UNITS:
        raise ValueError(f"unit must be one of {', '.join(TIME_UNITS)}, got {unit!r}")
    stamps = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            stamps.append(round(Fraction(Decimal(words[0])) * 10 ** TIME_UNITS[unit]))
        except (InvalidOperation, ValueError, OverflowError):
            raise ValueError(f"{path}, line {number}: must begin with a time, got {words[0]!r}") from None
    return stamps


@dataclass(kw_only=True)
class _Clock:
    """Gives frames their times."""

    fps: float | None
    stamps_ns: Sequence[int] | None
    path: Path
    _rate: Rate | None = field(init=False)

    def __post_init__(self) -> None:
        if self.fps is not None and self.stamps_ns is not None:
            raise ValueError("frames have a rate or a list of times, not both")
        self._rate = None if self.fps is None else Rate(self.fps)

    def stamp_ns(self, frame: int, *, shown_s: Fraction | None = None) -> int:
        """Return the time of a frame, given the time that the file has for it."""
        if self._rate is not None:
            return self._rate.stamp_ns(frame)
        if self.stamps_ns is not None:
            if frame >= len(self.stamps_ns):
                raise ValueError(
                    f"{self.path} has more frames than the {len(self.stamps_ns)} times that are given"
                )
            return self.stamps_ns[frame]
        if shown_s is None:
            raise ValueError(f"{self.path}: frame {frame} has no time; give --fps or --timestamps")
        return round(shown_s * 1_000_000_000)


def _require_size(path: Path, what: str, found: tuple[int, int], wanted: tuple[int, int]) -> None:
    if found != wanted:
        raise ValueError(
            f"{path}: {what} is {found[0]}x{found[1]}, must be {wanted[0]}x{wanted[1]} as the first"
        )


class FolderSource:
    """The pictures of a folder, in the natural order of their names.

    Orientation (EXIF) is heeded. Greys of 8 and 16 bits, RGB of 8 bits and greys of 32-bit floats are read;
    the last are taken as linear light. See `open_source` for arguments.
    """

    def __init__(self, path: Path, clock: _Clock, transfer: str) -> None:
        self._files = sorted(
            (f for f in path.iterdir() if f.suffix.lower() in SUFFIXES and not f.name.startswith(".")),
            key=lambda file: _natural(file.name),
        )
        if not self._files:
            raise ValueError(f"{path} has no pictures; names must end in one of {', '.join(SUFFIXES)}")
        self._clock = clock
        if clock.fps is None and clock.stamps_ns is None:
            raise ValueError(f"{path} is a folder: its pictures have no times; give --fps or --timestamps")
        if clock.stamps_ns is not None and len(clock.stamps_ns) != len(self._files):
            raise ValueError(f"{path} has {len(self._files)} pictures, got {len(clock.stamps_ns)} times")
        transfer = "srgb" if transfer == "auto" else transfer
        self._tables = {bits: LightTables(transfer, bits=bits) for bits in (8, 16)}
        first = _read_picture(self._files[0])
        self._size = (first.shape[1], first.shape[0])
        light = "linear, 32-bit float" if first.dtype == np.float32 else f"{transfer}, BT.709 weights"
        self.description = Description(
            name=path.name or str(path),
            width=self._size[0],
            height=self._size[1],
            frame_count=len(self._files),
            light=light,
            codes=self._codes(first),
        )

    def frames(self) -> Iterator[Frame]:
        """Yield all frames, from the first."""
        for number, file in enumerate(self._files):
            picture = _read_picture(file)
            _require_size(file, "the picture", (picture.shape[1], picture.shape[0]), self._size)
            yield Frame(self._clock.stamp_ns(number), self._luminance(picture))

    def _codes(self, picture: NDArray[Any]) -> NDArray[np.float64]:
        if picture.dtype == np.float32:
            return np.zeros(0)
        return self._tables[8 * picture.dtype.itemsize].codes

    def _luminance(self, picture: NDArray[Any]) -> NDArray[np.float32]:
        if picture.dtype == np.float32:
            return picture
        return self._tables[8 * picture.dtype.itemsize].luminance(picture)


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Return what sorts frame2 before frame10."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(part), part) if part.isdigit() else (1, 0, part) for part in parts]


def _read_picture(file: Path) -> NDArray[Any]:
    """Return a picture as it is stored: [H, W] or [H, W, 3], uint8 or uint16, or [H, W] float32 of light."""
    try:
        with Image.open(file) as opened:
            _refuse_deep_colour(file, opened)
            picture: Image.Image = ImageOps.exif_transpose(opened)
            picture.load()
    except (OSError, SyntaxError) as error:
        raise ValueError(f"{file} is not a readable picture: {error}") from None
    if picture.mode not in (*_GRAY_MODES, "RGB"):
        if picture.mode not in _CONVERTED_MODES:
            raise ValueError(f"{file} has pixels of mode {picture.mode}, which cannot be read")
        if picture.has_transparency_data and np.asarray(picture.convert("RGBA"))[..., 3].min() < 255:
            raise ValueError(f"{file} has transparent pixels; pictures must be opaque")
        picture = picture.convert("L" if picture.mode == "LA" else "RGB")
    if picture.mode == "1":
        picture = picture.convert("L")
    values = np.asarray(picture)
    if picture.mode == "F":
        if not (np.isfinite(values).all() and values.min() >= 0.0):
            raise ValueError(f"{file} holds {values.min()} to {values.max()}; light must be finite and >= 0")
        return values.astype(np.float32)
    return values.astype(np.uint16) if picture.mode.startswith("I;16") else values


def _refuse_deep_colour(file: Path, picture: Image.Image) -> None:
    """Refuse colours of 16 bits, of which Pillow would drop half without a word."""
    tiles = getattr(picture, "tile", [])  # how the file stores its parts
    layout = str(tiles[0][3]) if tiles else ""
    if ";16" in layout and not picture.mode.startswith("I;16"):
        raise ValueError(
            f"{file} has colours of 16 bits, which can be read from a video only: make one without loss,"
            f" such as ffmpeg -i %d.png -c:v ffv1 -pix_fmt gbrp16 frames.mkv"
        )


class VideoSource:
    """The frames of a video, at their presentation times; see `open_source` for arguments."""

    def __init__(self, path: Path, clock: _Clock, transfer: str) -> None:
        self._av = need("videos need PyAV", "video", "av")
        self._path = path
        self._clock = clock
        with self._open() as container:
            stream = container.streams.video[0]
            first = next(self._decoded(container), None)
            if first is None:
                raise ValueError(f"{path} has no frame that can be decoded")
            self._turns = round(getattr(first, "rotation", 0) / 90.0) % 4
            self._decoder = decoder = _make_decoder(first, stream.codec_context, transfer, path)
            size = (first.width, first.height)
            if self._turns % 2:
                size = size[::-1]
            count = stream.frames or _estimate(stream, container)
        self._format, self._size = first.format.name, (first.width, first.height)
        self.description = Description(
            name=path.name,
            width=size[0],
            height=size[1],
            frame_count=count,
            light=decoder.light,
            codes=decoder.codes,
            notes=decoder.notes,
        )

    def frames(self) -> Iterator[Frame]:
        """Yield all frames, from the first."""
        with self._open() as container:
            for number, frame in enumerate(self._decoded(container)):
                _require_size(self._path, f"frame {number}", (frame.width, frame.height), self._size)
                if frame.format.name != self._format:
                    raise ValueError(
                        f"{self._path}: frame {number} is {frame.format.name}, must be {self._format}"
                        " as the first"
                    )
                shown_s = None if frame.pts is None else frame.pts * Fraction(frame.time_base)
                luminance = np.rot90(self._decoder.luminance(frame), self._turns)
                yield Frame(self._clock.stamp_ns(number, shown_s=shown_s), np.ascontiguousarray(luminance))

    def _open(self) -> Any:
        try:
            container = self._av.open(str(self._path))
        except self._av.error.FFmpegError as error:
            raise ValueError(f"{self._path} is not a readable video: {error.strerror}") from None
        if not container.streams.video:
            container.close()
            raise ValueError(f"{self._path} has no video stream")
        container.streams.video[0].thread_type = "AUTO"
        return container

    def _decoded(self, container: Any) -> Iterator[Any]:
        number = 0
        try:
            for frame in container.decode(container.streams.video[0]):
                yield frame
                number += 1
        except self._av.error.FFmpegError as error:
            raise ValueError(f"{self._path}: frame {number} cannot be decoded: {error.strerror}") from None


def _estimate(stream: Any, container: Any) -> int | None:
    """Return about how many frames there are, for a progress bar."""
    length_s = None
    if stream.duration is not None and stream.time_base is not None:
        length_s = stream.duration * stream.time_base
    elif container.duration is not None:
        length_s = Fraction(container.duration, 1_000_000)
    return None if length_s is None or not stream.average_rate else round(length_s * stream.average_rate)


class _Decoder(NamedTuple):
    """The conversion from the frames of a video to luminance."""

    luminance: Callable[[Any], NDArray[np.float32]]
    light: str
    """How, in words."""
    codes: NDArray[np.float64]
    """See `Description`."""
    notes: tuple[str, ...]
    """Assumptions and omissions."""


def _make_decoder(frame: Any, codec: Any, transfer: str, path: Path) -> _Decoder:
    """Return what makes luminance of the frames of a video, by what the first says of itself."""
    named = transfer_of(int(codec.color_trc or 0)) if transfer == "auto" else transfer
    notes = _notes(frame, untold=named is None)
    named = named or "srgb"
    layout = frame.format
    bits = 8 if layout.has_palette else max(8, *(c.bits for c in layout.components))
    if bits > 16:
        raise ValueError(f"{path} has pixels of format {layout.name}; at most 16 bits a number can be read")
    primaries = int(codec.color_primaries or 0)
    weights = "BT.2020" if primaries == BT2020_PRIMARIES else "BT.709"
    light = f"{layout.name}, {bits} bits, {named}, {weights} weights"
    gray = layout.name.startswith(("gray", "ya", "mono"))
    if layout.is_rgb or layout.has_palette or (gray and frame.color_range != _LIMITED_RANGE):
        wanted = ("gray", "gray16le") if gray else ("rgb24", "rgb48le")
        tables = LightTables(named, bits=8 if bits == 8 else 16, primaries=primaries)
        return _Decoder(
            lambda f: tables.luminance(f.to_ndarray(format=wanted[bits > 8])),
            light,
            TRANSFERS[named](np.linspace(0.0, 1.0, 1 << bits)),
            notes,
        )
    full = layout.name.startswith("yuvj") or frame.color_range == _FULL_RANGE
    matrix = matrix_of(int(frame.colorspace), frame.height)
    decoder = LumaDecoder(named, bits=bits, matrix=matrix, primaries=primaries, limited=not full)
    levels = "full range" if full else "video levels"
    return _Decoder(lambda f: decoder.luminance(_planes(f)), f"{light}, {levels}", decoder.codes, notes)


def _notes(frame: Any, *, untold: bool) -> tuple[str, ...]:
    notes = []
    if untold:
        notes.append("the video does not name its transfer function: taken as sRGB (--transfer changes it)")
    if any(c.is_alpha for c in frame.format.components):
        notes.append("transparency is ignored")
    if frame.interlaced_frame:
        notes.append("the video is interlaced, and frames are taken as they are: deinterlace it first")
    return tuple(notes)


def _planes(frame: Any) -> NDArray[np.uint16]:
    """Return Y', C_b, C_r at full resolution, highest bit first, shape [H, W, 3].

    The same range at both ends leaves the numbers alone: they are moved to the highest bits, and colour
    differences are interpolated.
    """
    picture: NDArray[np.uint16] = frame.to_ndarray(
        format="yuv444p16le", src_color_range=_FULL_RANGE, dst_color_range=_FULL_RANGE
    )
    return picture


Source: TypeAlias = FolderSource | VideoSource
"""Frames in the order of time."""
