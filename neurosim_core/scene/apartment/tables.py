"""The tables that the apartment is made from."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import yaml

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # PyYAML may be built without libyaml


@functools.cache
def read_table(name: str) -> dict[str, Any]:
    """Return the table `name`.yaml beside this module."""
    table: dict[str, Any] = yaml.load(Path(__file__).with_name(f"{name}.yaml").read_bytes(), _LOADER)
    return table
