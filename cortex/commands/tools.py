"""`cortex keys` and `cortex cpp`."""

from __future__ import annotations

import argparse
import importlib
import os
import sys

from cortex.commands.session import CommandError, UsageError, hint
from cortex.cppgen import generate
from cortex.message import is_message
from cortex.security import AUTHORIZED_FILE, default_directory, new_keys


def make_keys(options: argparse.Namespace) -> int:
    """`cortex keys new`."""
    directory = options.dir or default_directory()
    try:
        keys = new_keys(directory)
    except FileExistsError as error:
        raise CommandError(str(error)) from error
    print(keys.public)
    hint(
        f"made in {directory}; the line above is the public key. Add it to {AUTHORIZED_FILE} of those that "
        f"shall talk to us, and theirs to {directory / AUTHORIZED_FILE}, then use --keys {directory}"
    )
    return 0


def write_cpp(options: argparse.Namespace) -> int:
    """`cortex cpp`."""
    sys.path.insert(0, os.getcwd())
    sys.stdout.write(generate([_find_type(name) for name in options.type], namespace=options.namespace))
    return 0


def _find_type(name: str) -> type:
    module_name, separator, type_name = name.partition(":")
    if not separator or not module_name or not type_name:
        raise UsageError(f"a type is named like robot.messages:Scan, got {name!r}")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise
        raise CommandError(f"there is no module {module_name} here or on the path of Python") from error
    found = getattr(module, type_name, None)
    if not isinstance(found, type) or not is_message(found):
        known = sorted(
            key for key, value in vars(module).items() if isinstance(value, type) and is_message(value)
        )
        raise CommandError(
            f"{module_name} has no message type {type_name}; it has {', '.join(known) if known else 'none'}"
        )
    return found
