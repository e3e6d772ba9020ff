"""Message definitions: those of a ROS 2 distribution, as `rosbags` has them, and those in `definitions/`."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore


class Distro(NamedTuple):
    """What differs between distributions of ROS 2."""

    store: Stores
    """Its message definitions, in rosbags."""
    gid_bytes: int = 16
    """Length of an endpoint's id in `ros_discovery_info`."""
    shows_type_hash: bool = True
    """Whether endpoints show the hash of their type in discovery."""
    range_variable: str = "ROS_AUTOMATIC_DISCOVERY_RANGE"
    """Environment variable by which nodes keep to this host."""


DISTROS = {
    "humble": Distro(Stores.ROS2_HUMBLE, 24, shows_type_hash=False, range_variable="ROS_LOCALHOST_ONLY"),
    "iron": Distro(Stores.ROS2_IRON),
    "jazzy": Distro(Stores.ROS2_JAZZY),
    "kilted": Distro(Stores.ROS2_KILTED),
    "lyrical": Distro(Stores.ROS2_LYRICAL),
    "rolling": Distro(Stores.LATEST),
}
"""Distributions that are known. The messages that the bridge sends are the same in all of them."""
DEFAULT_DISTRO = "jazzy"


class UnknownTypeError(ValueError):
    """No message type has this name."""


@functools.cache
def typestore(distro: str = DEFAULT_DISTRO) -> Typestore:
    """Return the message types of a distribution, and ours; always the same object.

    Raises:
        ValueError: The distribution is unknown.
    """
    if distro not in DISTROS:
        raise ValueError(f"unknown ROS distribution {distro!r}, known: {', '.join(DISTROS)}")
    store = get_typestore(DISTROS[distro].store)
    for name, text in {**definitions(), **_added}.items():
        _register(store, name, text)
    _stores.append(store)
    return store


def define(type_name: str, text: str) -> None:
    """Make a type such as "my_robot/msg/Battery" known that no distribution has, by the text of a .msg file.

    Raises:
        ValueError: The text is no definition, or the type is known with another one.
    """
    if _added.get(type_name, text) != text or (
        type_name in typestore().fielddefs and type_name not in _added
    ):
        raise ValueError(f"{type_name} is defined already, otherwise")
    _added[type_name] = text
    for store in _stores:
        if type_name not in store.fielddefs:
            _register(store, type_name, text)


def _register(store: Typestore, name: str, text: str) -> None:
    message = name.replace("/srv/", "/msg/")  # as which rosbags reads the halves of a service
    try:
        (definition,) = get_types_from_msg(text, message).values()
        store.register({name: definition})
    except TypesysError as error:
        raise ValueError(f"definition of {name}: {error}") from error


_added: dict[str, str] = {}
_stores: list[Typestore] = []


@functools.cache
def definitions() -> dict[str, str]:
    """Return the text of each definition that the bridge brings along, by its type's name."""
    found = {}
    for path in Path(__file__).with_name("definitions").glob("*/*/*"):
        package, text = path.parts[-3], path.read_text(encoding="utf-8")
        if path.suffix == ".msg":
            found[f"{package}/msg/{path.stem}"] = text
        elif path.suffix == ".srv":
            halves = service_types(f"{package}/srv/{path.stem}")
            found |= zip(halves, re.split("^---\n", text, flags=re.MULTILINE), strict=True)
    return dict(sorted(found.items()))


def service_types(type_name: str) -> tuple[str, str]:
    """Return the types of a service's request and response; they are messages of their own."""
    return f"{type_name}_Request", f"{type_name}_Response"


def check_type(type_name: str, distro: str = DEFAULT_DISTRO) -> None:
    """Raise `UnknownTypeError` unless a distribution has a message type of this name."""
    known = typestore(distro).fielddefs
    if type_name in known:
        return
    package, _, base = type_name.rpartition("/")
    near = sorted(name for name in known if name.rpartition("/")[2] == base)
    hint = f"; is it {' or '.join(near)}?" if near else "; a .msg file in definitions/ would define it"
    if not package.endswith("/msg"):
        hint = f"; names are written such as sensor_msgs/msg/Imu{hint}"
    raise UnknownTypeError(f"unknown message type {type_name!r} in ROS {distro}{hint}")


@functools.cache
def type_hash(type_name: str, distro: str = DEFAULT_DISTRO) -> str:
    """Return the hash by which nodes since Iron recognise a message type, such as "RIHS01_7d9a...".

    Raises:
        UnknownTypeError: There is no such type.
    """
    check_type(type_name, distro)
    return _rosidl_store(distro).hash_rihs01(type_name)


@functools.cache
def _rosidl_store(distro: str) -> Typestore:
    """Return the types as rosidl describes them: it makes `char` of a .msg file a uint8."""

    def described(desc: Any) -> Any:
        kind, what = desc
        if kind == Nodetype.NAME:
            return desc
        if kind == Nodetype.BASE:
            return (kind, ("uint8", what[1])) if what[0] == "char" else desc
        return kind, (described(what[0]), what[1])

    store = Typestore()
    store.fielddefs = {
        name: (constants, [(field, described(desc)) for field, desc in fields])
        for name, (constants, fields) in typestore(distro).fielddefs.items()
    }
    return store
