"""Settings that are given on a command line: `--set KEY=VALUE`."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

import yaml


def add_set_option(parser: argparse.ArgumentParser, help_text: str) -> None:
    """Let a command take `--set KEY=VALUE`, as often as needed; the texts are in `settings`."""
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings", help=help_text
    )


def set_options(settings: Mapping[str, Any] | None) -> dict[str, str]:
    """Return what the user wrote for each key of `read_settings`, for error messages."""
    return {key: f"--set {key}" for key in settings or {}}


def read_settings(texts: Sequence[str]) -> dict[str, Any]:
    """Return values by dotted key; a value is read as YAML."""
    settings: dict[str, Any] = {}
    for text in texts:
        key, separator, value = text.partition("=")
        if not separator or not key:
            raise ValueError(f"--set takes KEY=VALUE, got {text!r}")
        try:
            settings[key] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"--set {key}: the value {value!r} is not YAML: {reason}") from None
    return settings
