"""The input of an event camera: frames and stamps, converted, or an error that says why they are refused."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.clock import NS_PER_US
from neurosim_core.sensors.event_scan import LOG_RADIANCE_MAX


def as_frames(value: Any, shape: tuple[int, ...], device: Any) -> Any:
    """Return an array as a contiguous float32 Warp array of this shape on a device.

    Raises:
        ValueError: Shape, dtype or device is another.
    """
    if not isinstance(value, wp.array):
        on_device = hasattr(value, "__cuda_array_interface__")
        value = wp.array(value) if on_device else np.asarray(value)
    dtype = wp.dtype_to_numpy(value.dtype) if isinstance(value, wp.array) else value.dtype
    if tuple(value.shape) != shape or dtype != np.float32:
        raise ValueError(
            f"log_radiance must be float32 of shape {list(shape)},"
            f" got {np.dtype(dtype).name} of shape {list(value.shape)}"
        )
    if isinstance(value, wp.array):
        if value.device != device:
            raise ValueError(f"log_radiance must be on {device}, got {value.device}")
        return value.contiguous()
    flat = np.ascontiguousarray(value).reshape(-1)  # axes of length 1 may have had any stride
    return wp.array(flat, dtype=wp.float32, shape=shape, device=device, copy=False)


def check_stack(
    log_radiance: Any, stamps: NDArray[np.int64], shape: tuple[int, int], device: Any, *, after_ns: int
) -> None:
    """Refuse a Warp array that is no stack of frames for a camera, or stamps [ns] not after a stamp."""
    count = len(stamps)
    fits = log_radiance.ndim == 3 and log_radiance.shape[1:] == shape
    if not (fits and 1 <= count <= log_radiance.shape[0] and log_radiance.is_contiguous):
        raise ValueError(
            f"log_radiance must be contiguous of shape [>= {count}, {shape[0]}, {shape[1]}] for {count} >= 1 "
            f"stamps, got {list(log_radiance.shape)} with strides {list(log_radiance.strides)}"
        )
    if log_radiance.dtype != wp.float32 or log_radiance.device != device:
        raise ValueError(
            f"log_radiance must be float32 on {device},"
            f" got {log_radiance.dtype.__name__} on {log_radiance.device}"
        )
    if stamps[0] <= after_ns:
        raise ValueError(f"stamps_ns must be later than {after_ns}, got {stamps[0]}")


def check_reference(log_radiance: NDArray[np.float32]) -> None:
    """Refuse a frame, shape [H, W], that has values of which pixels cannot start."""
    valid = np.abs(log_radiance) <= LOG_RADIANCE_MAX
    if not valid.all():
        row, col = (int(index) for index in np.argwhere(~valid)[0])
        raise ValueError(invalid_message(int((~valid).sum()), f"[{row}, {col}]"))


def as_stamps(stamps_ns: Any) -> NDArray[np.int64]:
    """Return times of frames [ns] as int64, shape [K].

    Raises:
        ValueError: They are no integers, of another shape, or do not increase strictly.
    """
    stamps = np.asarray(stamps_ns)
    if stamps.size == 0:
        stamps = stamps.astype(np.int64)
    if stamps.ndim != 1 or stamps.dtype.kind not in "iu":
        raise ValueError(
            f"stamps_ns must be integers of shape [K], got {stamps.dtype} of shape {list(stamps.shape)}"
        )
    stamps = stamps.astype(np.int64)
    if len(stamps) > 1 and (falls := stamps[1:] <= stamps[:-1]).any():
        index = int(np.argmax(falls))
        raise ValueError(
            f"stamps_ns must be strictly increasing, got {stamps[index + 1]} after {stamps[index]}"
        )
    return stamps


def check_ends(ends_ns: Sequence[int], *, start_ns: int, now_ns: int) -> None:
    """Refuse ends of windows [ns] that do not increase from a stamp, or lie after the newest frame."""
    bounds = [start_ns, *ends_ns]
    if bounds[-1] > now_ns or any(b - a < NS_PER_US for a, b in itertools.pairwise(bounds)):
        raise ValueError(
            f"ends_ns must increase by at least 1000 from {start_ns} and not pass {now_ns}, got {ends_ns}"
        )


def check_span(stamp_ns: int, *, origin_us: int, span_max_ns: int) -> None:
    """Refuse a frame that is too far from the origin of the keys' time, that of the last window."""
    span_us = stamp_ns // NS_PER_US - origin_us
    if span_us * NS_PER_US >= span_max_ns:
        raise ValueError(
            f"stamps_ns must be within {span_max_ns / 1e9:g} s of the last window, got {span_us / 1e6:g} s"
        )


def invalid_message(count: int, first: str) -> str:
    """Say how many values of log radiance cannot be used, and where the first of them is."""
    return (
        f"log_radiance must be finite and within +-{LOG_RADIANCE_MAX:g}:"
        f" {count} values are not, the first at {first}"
    )
