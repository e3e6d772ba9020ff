"""Videos without loss and folders of pictures, made for a test."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image


def write_folder(folder: Path, pictures: Sequence[NDArray[Any]]) -> Path:
    """Write pictures as frame0.png, frame1.png, ...: the order of their names as texts is another."""
    folder.mkdir()
    for number, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"frame{number}.png")
    return folder


def write_video(
    path: Path,
    pictures: Sequence[NDArray[Any]],
    stamps_ms: Sequence[int],
    *,
    pixels: str = "bgr0",
    given: str = "rgb24",
    **tags: int,
) -> Path:
    """Write pictures with FFV1, which loses nothing.

    Args:
        path: The file, .mkv.
        pictures: Arrays as PyAV takes them for the pixel format `given`.
        stamps_ms: When each is shown.
        pixels: Pixel format that is stored.
        given: Pixel format of the arrays.
        tags: color_trc, colorspace, color_range, color_primaries, as numbers of H.273.
    """
    import av

    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("ffv1", rate=1000)
        frames = [av.VideoFrame.from_ndarray(np.ascontiguousarray(p), format=given) for p in pictures]
        stream.width, stream.height, stream.pix_fmt = frames[0].width, frames[0].height, pixels
        for name, value in tags.items():
            setattr(stream.codec_context, name, value)
        stream.codec_context.time_base = Fraction(1, 1000)
        for frame, stamp_ms in zip(frames, stamps_ms, strict=True):
            frame.pts, frame.time_base = stamp_ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
