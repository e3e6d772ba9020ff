"""Settings that are given on a command line: a file, `--set KEY=VALUE`, and options of their own."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

if TYPE_CHECKING:
    from neurosim_core.config import SimulationConfig

_OPTIONS = {"duration_s": "duration", "seed": "seed", "device": "device", "live.real_time_factor": "factor"}
"""Settings that have an option of their own."""


def add_settings(parser: argparse.ArgumentParser, *, default: str = "a generated apartment") -> None:
    """Let a command take what decides about a flight, which `load_settings` reads.

    `default`: what it flies in without settings, for its help.
    """
    parser.add_argument("config", nargs="?", type=Path, help=f"settings file (YAML); default: {default}")
    parser.add_argument("--scene", type=Path, metavar="FILE", help="mesh file to fly in (.glb, .obj, ...)")
    parser.add_argument("--duration", type=float, metavar="S", help="simulated time [s]")
    parser.add_argument("--seed", type=int, help="seed of the sensor noise; data sets: of the first flight")
    parser.add_argument("--device", help="device to compute on: auto, cpu, cuda:0, ...")
    add_set_option(parser, "any setting by its dotted key, such as scene.seed=3; may be repeated")


def load_settings(arguments: argparse.Namespace) -> SimulationConfig:
    """Return the settings of a command line; errors name the options that were given."""
    from neurosim_core.config import load_config

    options = set_options(read_settings(arguments.settings))
    options |= {key: f"--{name}" for key, name in _given(arguments).items()}
    if arguments.scene is not None:
        options["scene"] = "--scene"
    return load_config(arguments.config, overrides=settings_of(arguments), options=options)


def settings_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what wins over the settings file, by dotted key."""
    settings: dict[str, Any] = {}
    if arguments.scene is not None:
        settings["scene"] = {"kind": "mesh", "file": str(arguments.scene.resolve())}
    settings |= read_settings(arguments.settings)
    settings |= {key: getattr(arguments, name) for key, name in _given(arguments).items()}
    if hasattr(arguments, "lockstep"):  # a live run
        if arguments.lockstep and arguments.factor is not None:
            raise ValueError(
                "--factor is for streaming; with --lockstep a run is as fast as its commands come"
            )
        settings |= {"live.mode": "lockstep"} if arguments.lockstep else {}
        settings |= {} if arguments.duration is None else {"live.run_on": False}
    return settings


def _given(arguments: argparse.Namespace) -> dict[str, str]:
    return {key: name for key, name in _OPTIONS.items() if getattr(arguments, name, None) is not None}


def add_set_option(parser: argparse.ArgumentParser, help_text: str) -> None:
    """Let a command take `--set KEY=VALUE`, as often as needed; the texts are in `settings`."""
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings", help=help_text
    )


def set_options(settings: Mapping[str, Any] | None) -> dict[str, str]:
    """Return what the user wrote for each key of `read_settings`, for error messages."""
    return {key: f"--set {key}" for key in settings or {}}


def read_settings(texts: Sequence[str], *, option: str = "--set") -> dict[str, Any]:
    """Return values by dotted key; a value is read as YAML. Errors name the option that the texts are of."""
    settings: dict[str, Any] = {}
    for text in texts:
        key, separator, value = text.partition("=")
        if not separator or not key:
            raise ValueError(f"{option} takes KEY=VALUE, got {text!r}")
        try:
            settings[key] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"{option} {key}: the value {value!r} is not YAML: {reason}") from None
    return settings
