"""The registry of plug-ins: a table kind -> class for each category; others are added by entry points.

A package adds its own sensors, vehicles, ... by registering classes in a module that an entry point of the
group `neurosim.plugins` names; the module is imported when a kind is asked for that is not of Neurosim:

    [project.entry-points."neurosim.plugins"]
    my_sensors = "my_package.sensors"

In a script, importing or defining the class before the settings are loaded is enough.
"""

from __future__ import annotations

import importlib
import logging
import pkgutil
import sys
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TypeVar

ENTRY_POINT_GROUP = "neurosim.plugins"
"""Entry points whose modules register what they bring."""

CATEGORIES = ("sensor", "vehicle", "controller", "renderer", "scene", "sink", "noise", "task")
"""What can be registered."""

_OWN = {
    "vehicle": {"multirotor": "vehicle.multirotor"},
    "controller": {"se3": "control.base"},
    "scene": {"apartment": "scene.apartment", "hall": "scene.hall", "mesh": "scene.mesh"},
    "renderer": {
        "warp": "render.renderer",
        "pyrender": "render.pyrender_renderer",
        "synthetic": "render.synthetic_renderer",
        "remote": "live.remote_renderer",
    },
    "sink": {"hdf5": "sinks", "cortex": "live.sink"},
    "noise": {"leak": "sensors.event_config"},
    "task": {"hover": "learn.tasks"},
}
"""Modules by one of the kinds that they register; those of sensors are named for their kind."""

Registered = TypeVar("Registered", bound=type)

_logger = logging.getLogger(__name__)
_tables: dict[str, dict[str, type]] = {category: {} for category in CATEGORIES}
_loaded = False


def register(category: str, kind: str) -> Callable[[Registered], Registered]:
    """Return a decorator that adds a class to a table.

    Args:
        category: One of `CATEGORIES`.
        kind: The name under which settings ask for the class, such as "depth".

    Raises:
        TypeError: The class lacks what every class of the category has.
        ValueError: No such category, the kind is of another class, or the class says that it has another.
    """
    table = _table(category)

    def add(cls: Registered) -> Registered:
        if not cls.__module__.startswith("neurosim_core."):
            _import_own(category)  # a kind of our own is taken, whoever comes first
            load_plugins()
        known = table.get(kind)
        if known is not None and (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise ValueError(
                f"the {category} kind {kind!r} is taken by {known.__module__}.{known.__qualname__}: "
                f"give {cls.__module__}.{cls.__qualname__} another"
            )
        own = getattr(cls, "model_fields", {}).get("kind")
        if own is not None and own.default != kind:
            raise ValueError(
                f"{cls.__qualname__} is registered as {category} kind {kind!r}, and its field `kind` says "
                f"{own.default!r}: give both the same name"
            )
        check: Callable[[], None] | None = getattr(cls, "check_class", None)
        if check is not None:
            check()
        table[kind] = cls
        return cls

    return add


def kinds(category: str) -> Mapping[str, type]:
    """Return the classes of a category by kind, those of installed plug-ins included.

    Raises:
        ValueError: There is no such category.
    """
    table = registered(category)
    _import_own(category)
    load_plugins()
    return table


def registered(category: str) -> Mapping[str, type]:
    """Return the classes of a category by kind that have been imported until now.

    Raises:
        ValueError: There is no such category.
    """
    return MappingProxyType(_table(category))


def find(category: str, kind: str) -> type:
    """Return the class of a kind.

    Raises:
        ValueError: There is no such category or kind; the message has those that are known.
    """
    table = _table(category)
    if kind not in table and kind in (own := _own_modules(category)):
        importlib.import_module(own[kind])
    if kind not in table:
        _import_own(category)
        load_plugins()
    if kind not in table:
        raise ValueError(f"unknown {category} kind {kind!r}, known: {sorted(table)}")
    return table[kind]


def load_plugins() -> None:
    """Import every module of ours that registers a kind, and those that entry points name, once in a process.

    Tasks are left out: they need PyTorch. A foreign module that cannot be imported is left out with a
    warning: one broken package must not take the others down. What it has registered before it failed is
    forgotten.
    """
    global _loaded
    if _loaded:
        return
    _loaded = True
    from importlib.metadata import entry_points  # which is slow to import, and few runs need

    for category in CATEGORIES:
        if category != "task":
            _import_own(category)
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        before = {category: dict(table) for category, table in _tables.items()}
        try:
            entry.load()
        except Exception as error:  # whatever a foreign module raises when it is imported
            for category, table in _tables.items():
                broken = [
                    kind
                    for kind in table.keys() - before[category].keys()
                    if table[kind].__module__ not in sys.modules
                ]
                for kind in broken:
                    del table[kind]
            _logger.warning("the plug-in %s (%s) cannot be loaded: %s", entry.name, entry.value, error)


def _import_own(category: str) -> None:
    for module in _own_modules(category).values():
        importlib.import_module(module)


def _own_modules(category: str) -> dict[str, str]:
    """Return the modules of our own kinds of a category; of sensors all, some of which have none."""
    if category == "sensor":
        sensors = importlib.import_module("neurosim_core.sensors")
        names = (module.name for module in pkgutil.iter_modules(sensors.__path__))
        return {name: f"{sensors.__name__}.{name}" for name in names}
    return {kind: f"neurosim_core.{module}" for kind, module in _OWN.get(category, {}).items()}


def _table(category: str) -> dict[str, type]:
    if category not in _tables:
        raise ValueError(f"unknown category {category!r}, known: {', '.join(CATEGORIES)}")
    return _tables[category]
