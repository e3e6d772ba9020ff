"""The sensors, one file for each kind; and what sensors of your own are made of."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neurosim_core.sensors.base import (
        FrameSensorConfig,
        ImageSensorConfig,
        RateHz,
        Sampler,
        SamplerContext,
        StateSensorConfig,
    )
    from neurosim_core.sensors.state_sampler import (
        ErrorConfig,
        Errors,
        LateConfig,
        Motion,
        Sampling,
        StateSampler,
        error_adder,
        make_errors,
        make_reader,
    )

_HOMES = {
    "neurosim_core.sensors.base": (
        "StateSensorConfig",
        "SamplerContext",
        "Sampler",
        "ImageSensorConfig",
        "FrameSensorConfig",
        "RateHz",
    ),
    "neurosim_core.sensors.state_sampler": (
        "StateSampler",
        "Motion",
        "Sampling",
        "LateConfig",
        "ErrorConfig",
        "Errors",
        "make_errors",
        "make_reader",
        "error_adder",
    ),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "ErrorConfig",
    "Errors",
    "FrameSensorConfig",
    "ImageSensorConfig",
    "LateConfig",
    "Motion",
    "RateHz",
    "Sampler",
    "SamplerContext",
    "Sampling",
    "StateSampler",
    "StateSensorConfig",
    "error_adder",
    "make_errors",
    "make_reader",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'neurosim_core.sensors' has no attribute {name!r}, known: {__all__}")
    return getattr(importlib.import_module(_HOME[name]), name)
