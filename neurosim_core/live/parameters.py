"""What can be changed while a simulation runs."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping

from neurosim_core.config import ConfigError, SimulationConfig, load_config

Value = bool | int | float | str | None

CHANGEABLE = (
    "live.real_time_factor",
    "live.overrun",
    "live.command_timeout_s",
    "live.fail_safe",
    "live.command_deadline_s",
    "links.NAME.SETTING",
    "control.gains.GAIN",
    "vehicles.NAME.links.NAME.SETTING",
    "vehicles.NAME.control.gains.GAIN",
)
"""Keys of `set_parameters`; words in capitals stand for any name."""

_PATTERNS = tuple(re.compile(re.sub("[A-Z]{2,}", r"\\w+", key.replace(".", r"\."))) for key in CHANGEABLE)


def change(config: SimulationConfig, values: Mapping[str, Value]) -> SimulationConfig:
    """Return a configuration with other values.

    Args:
        config: What holds now.
        values: New values by dotted key; see `CHANGEABLE`.

    Raises:
        ValueError: A key cannot be changed while it runs, or a value is not allowed.
    """
    for key, value in values.items():
        if not any(pattern.fullmatch(key) for pattern in _PATTERNS):
            close = difflib.get_close_matches(key, CHANGEABLE, n=1, cutoff=0.8)
            hint = f" (did you mean {close[0]}?)" if close else ""
            raise ValueError(
                f"{key} cannot be changed while it runs{hint}; what can: {', '.join(CHANGEABLE)}"
            )
        if value is None:
            raise ValueError(f"{key}: no value is given")
    try:
        return load_config(config.model_dump(mode="json"), overrides=dict(values))
    except ConfigError as error:
        reasons = str(error).splitlines()[1:]
        raise ValueError("; ".join(line.strip() for line in reasons)) from None
