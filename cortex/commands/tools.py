"""`cortex keys`, `cortex schema` and `cortex cpp`."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from enum import Enum
from pathlib import Path

from cortex.commands.session import CommandError, UsageError, hint, look_around
from cortex.cppgen import generate, write_headers
from cortex.evolution import differences, is_evolved
from cortex.message_types import is_message
from cortex.schema import EnumType, Schema, nested, schema_of
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
        f"The line above is the public key. The keys are in {directory}.\n"
        f"1. Add it to the file {AUTHORIZED_FILE} of each that shall talk to us.\n"
        f"2. Add their public keys to {directory / AUTHORIZED_FILE}, and its host behind the registry's.\n"
        f"3. Use --keys {directory}, or set CORTEX_KEYS to it."
    )
    return 0


def compare(options: argparse.Namespace) -> int:
    """`cortex schema diff`: 0 if the two are the same or can read each other, else 1."""
    old, new = (_find_schema(name, options) for name in (options.old, options.new))
    for line in differences(old, new):
        print(line)
    if old == new:
        print(f"the same: {old.name} ({old.fingerprint:016x})")
    elif is_evolved(old, new):
        print("compatible: a Python subscriber of either reads the other; what is absent is None")
    else:
        print("incompatible: only fields that are optional may be added, and only at the end")
    return int(old != new and not is_evolved(old, new))


def _find_schema(name: str, options: argparse.Namespace) -> Schema:
    path, _, topic = name.rpartition(":")
    if topic.startswith("/") and path:
        from cortex.log import open_log

        with open_log(path) as log:
            found = {entry.topic: entry.schema for entry in log.topics}
    elif topic.startswith("/"):
        node = look_around(options)
        if node is None:
            raise CommandError(f"{name} is not published")
        with node:
            infos = [info for info in node.topics() if info.schema]
        found = {info.topic: Schema.from_json(info.schema) for info in infos}
    else:
        sys.path.insert(0, os.getcwd())
        return schema_of(_find_type(name))
    if topic not in found:
        raise CommandError(f"there is no type of {topic}; there are {', '.join(sorted(found)) or 'none'}")
    return found[topic]


def write_cpp(options: argparse.Namespace) -> int:
    """`cortex cpp`."""
    if options.include_dir:
        if options.type:
            raise UsageError(f"--include-dir takes no type, got {' '.join(options.type)}")
        print(Path(__file__).resolve().parents[1] / "cpp" / "include")
        return 0
    if options.headers is not None:
        write_headers(options.headers)
        return 0
    if not options.type:
        raise UsageError("name message types, like robot.messages:Scan, or give --headers or --include-dir")
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
    if isinstance(found, type) and is_message(found):
        return found
    known = {
        key: value for key, value in vars(module).items() if isinstance(value, type) and is_message(value)
    }
    if isinstance(found, type) and issubclass(found, Enum):
        users = sorted(
            key
            for key, value in known.items()
            if any(isinstance(kind, EnumType) and kind.name == type_name for kind in nested(schema_of(value)))
        )
        use = f"name one of {', '.join(users)}" if users else f"in {module_name} none does"
        raise CommandError(f"{type_name} is an enum, which comes with the messages that use it: {use}")
    raise CommandError(
        f"{module_name} has no message type {type_name}; it has {', '.join(sorted(known)) or 'none'}"
    )
