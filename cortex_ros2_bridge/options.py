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


_STANDARD_DEVIATIONS = (
    *("angular_velocity_std_rad_s", "linear_acceleration_std_m_s2"),
    *("position_std_m", "orientation_std_rad", "velocity_std_m_s"),
)
_LIMITS = (
    *("max_speed_rad_s", "max_thrust_n", "max_speed_m_s", "max_rate_rad_s"),
    *("max_position_m", "depth_max_m"),
)

OPTIONS: Mapping[str, Option] = MappingProxyType(
    {
        "queue": Option(
            None,
            lambda v: v is None or (isinstance(v, int) and not isinstance(v, bool) and 1 <= v <= 65_536),
            "an integer from 1 to 65536 or null",
        ),
        **dict.fromkeys(_STANDARD_DEVIATIONS, _not_negative(0.0)),
        **dict.fromkeys(_LIMITS, _not_negative(None)),
        "encoding": _one_of("evt3", "mono"),
        "packet_rate_hz": _not_negative(None),
        "period_s": _not_negative(1.0 / 30.0),
        "stale_s": Option(0.5, lambda v: v is None or (_is_number(v) and v > 0.0), "a number > 0 or null"),
        "stamp": _one_of("header", "now"),
        "beyond": Option(None, lambda v: v in (None, "clamp", "refuse"), "clamp, refuse or null"),
        "frame": Option(
            "base_footprint", lambda v: isinstance(v, str) and bool(v), "the name of a frame, such as map"
        ),
        "compression": _one_of("jpeg", "png"),
        "stick_speed_m_s": _not_negative(2.0),
        "stick_rate_rad_s": _not_negative(1.0),
    }
)
"""All options, by name; README.md says what they do. A conversion knows some of them: `Rule.options`."""


def check_option(name: str, value: Any) -> None:
    """Raise `ValueError` unless an option is what it must be."""
    if not OPTIONS[name].fits(value):
        raise ValueError(f"option {name} must be {OPTIONS[name].must}, got {value!r}")
