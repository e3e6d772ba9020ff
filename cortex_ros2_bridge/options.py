"""Options of routes: what each must be, and what holds without it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple


class Option(NamedTuple):
    """One option."""

    default: Any
    fits: Callable[[Any], bool]
    must: str
    """What it must be, for people."""


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _not_negative(default: float | None) -> Option:
    if default is None:
        return Option(None, lambda v: v is None or (_is_number(v) and v > 0.0), "a number > 0 or null")
    return Option(default, lambda v: _is_number(v) and v >= 0.0, "a number >= 0")


def _one_of(*values: str) -> Option:
    return Option(values[0], lambda value: value in values, " or ".join(values))


OPTIONS: Mapping[str, Option] = MappingProxyType(
    {
        "queue": Option(
            None,
            lambda v: v is None or (isinstance(v, int) and not isinstance(v, bool) and 1 <= v <= 65_536),
            "an integer from 1 to 65536 or null",
        ),
        "encoding": _one_of("evt3", "mono"),
        "period_s": _not_negative(1.0 / 30.0),
        "angular_velocity_std_rad_s": _not_negative(0.0),
        "linear_acceleration_std_m_s2": _not_negative(0.0),
        "position_std_m": _not_negative(0.0),
        "orientation_std_rad": _not_negative(0.0),
        "velocity_std_m_s": _not_negative(0.0),
        "stale_s": Option(0.5, lambda v: v is None or (_is_number(v) and v > 0.0), "a number > 0 or null"),
        "stamp": _one_of("header", "now"),
        "max_speed_rad_s": _not_negative(None),
        "max_thrust_n": _not_negative(None),
        "max_speed_m_s": _not_negative(None),
        "max_rate_rad_s": _not_negative(None),
        "max_position_m": _not_negative(None),
        "beyond": Option(None, lambda v: v in (None, "clamp", "refuse"), "clamp, refuse or null"),
        "frame": Option(
            "base_footprint", lambda v: isinstance(v, str) and bool(v), "the name of a frame, such as map"
        ),
        "depth_max_m": _not_negative(None),
        "compression": _one_of("jpeg", "png"),
        "stick_speed_m_s": _not_negative(2.0),
        "stick_rate_rad_s": _not_negative(1.0),
    }
)
"""All options, by name; README.md says what they do. A conversion knows some of them: `convert.OPTIONS`."""


def check_option(name: str, value: Any) -> None:
    """Raise `ValueError` unless an option is what it must be."""
    if not OPTIONS[name].fits(value):
        raise ValueError(f"option {name} must be {OPTIONS[name].must}, got {value!r}")
