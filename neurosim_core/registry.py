"""What can be extended: a table kind -> class for each seam, to which other packages add by an entry point.

A package adds its own sensors, vehicles, ... by registering classes in a module that an entry point of the
group `neurosim.plugins` names; the module is imported when a table is first looked at:

    [project.entry-points."neurosim.plugins"]
    my_sensors = "my_package.sensors"

In a script, importing or defining the class before the settings are loaded is enough.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import logging
import pkgutil
import sys
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TypeVar

ENTRY_POINT_GROUP = "neurosim.plugins"
"""Entry points whose modules register what they bring."""

SEAMS = ("sensor", "vehicle", "controller", "renderer", "scene", "sink", "noise", "task")
"""What can be registered."""

Registered = TypeVar("Registered", bound=type)

_logger = logging.getLogger(__name__)
_tables: dict[str, dict[str, type]] = {seam: {} for seam in SEAMS}
_listeners: list[Callable[[str], None]] = []
_loaded = False


def register(seam: str, kind: str) -> Callable[[Registered], Registered]:
    """Return a decorator that adds a class to a table.

    Args:
        seam: One of `SEAMS`.
        kind: The name under which settings ask for the class, such as "depth".

    Raises:
        TypeError: The class lacks what every class of the seam has.
        ValueError: There is no such seam, another class has this kind, or the class says that it has another.
    """
    table = _table(seam)

    def add(cls: Registered) -> Registered:
        if not cls.__module__.startswith("neurosim_core."):
            load_plugins()  # a kind of our own is taken, whoever comes first
        known = table.get(kind)
        if known is not None and (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise ValueError(
                f"the {seam} kind {kind!r} is taken by {known.__module__}.{known.__qualname__}: "
                f"give {cls.__module__}.{cls.__qualname__} another"
            )
        own = getattr(cls, "model_fields", {}).get("kind")
        if own is not None and own.default != kind:
            raise ValueError(
                f"{cls.__qualname__} is registered as the {seam} kind {kind!r}, and its field `kind` says "
                f"{own.default!r}: give both the same name"
            )
        check: Callable[[], None] | None = getattr(cls, "check_class", None)
        if check is not None:
            check()
        table[kind] = cls
        _tell(seam)
        return cls

    return add


def kinds(seam: str) -> Mapping[str, type]:
    """Return the classes of a seam by kind, those of installed plug-ins included.

    Raises:
        ValueError: There is no such seam.
    """
    table = _table(seam)
    load_plugins()
    return MappingProxyType(table)


def find(seam: str, kind: str) -> type:
    """Return the class of a kind.

    Raises:
        ValueError: There is no such seam or kind; the message has those that are known.
    """
    table = kinds(seam)
    if kind not in table:
        raise ValueError(f"unknown {seam} kind {kind!r}, known: {sorted(table)}")
    return table[kind]


def on_change(listener: Callable[[str], None]) -> None:
    """Call `listener` with the seam's name whenever a class is registered from now on."""
    _listeners.append(listener)


def load_plugins() -> None:
    """Import every module of `neurosim_core.sensors`, and those that entry points name, once in a process.

    A foreign module that cannot be imported is left out with a warning: one broken package must not take the
    others down. What it has registered before it failed is forgotten.
    """
    global _loaded
    if _loaded:
        return
    _loaded = True
    sensors = importlib.import_module("neurosim_core.sensors")
    for module in pkgutil.iter_modules(sensors.__path__, f"{sensors.__name__}."):
        importlib.import_module(module.name)
    for entry in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP):
        before = {seam: dict(table) for seam, table in _tables.items()}
        try:
            entry.load()
        except Exception as error:  # whatever a foreign module raises when it is imported
            for seam, table in _tables.items():
                broken = [
                    kind
                    for kind in table.keys() - before[seam].keys()
                    if table[kind].__module__ not in sys.modules
                ]
                for kind in broken:
                    del table[kind]
                if broken:
                    _tell(seam)
            _logger.warning("the plug-in %s (%s) cannot be loaded: %s", entry.name, entry.value, error)


def _tell(seam: str) -> None:
    for listener in _listeners:
        listener(seam)


def _table(seam: str) -> dict[str, type]:
    if seam not in _tables:
        raise ValueError(f"unknown seam {seam!r}, known: {', '.join(SEAMS)}")
    return _tables[seam]
