"""Tables in YAML files beside the modules that use them."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import yaml

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # PyYAML may be built without libyaml


@functools.cache
def read_table(module_file: str, name: str) -> dict[str, Any]:
    """Return the table `name`.yaml beside a module, whose `__file__` is given."""
    table: dict[str, Any] = yaml.load(Path(module_file).with_name(f"{name}.yaml").read_bytes(), _LOADER)
    return table
