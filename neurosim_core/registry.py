"""The registry: a table kind -> class for each category, which plug-ins extend through entry points.

A package registers its sensors, vehicles, ... in a module, and names that module in an entry point of the
group `neurosim.plugins`. The registry imports the module when settings use a kind that is not built in:

    [project.entry-points."neurosim.plugins"]
    my_sensors = "my_package.sensors"

A script only has to import or define the class before it loads the settings.
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
"""Group of entry points that name modules of plug-ins."""

CATEGORIES = ("sensor", "vehicle", "controller", "renderer", "scene", "sink", "noise", "task")
"""Categories of classes that can be registered."""

_BUILT_IN = {
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
"""Modules of built-in kinds, by one kind of each module. Modules of sensors are named for their kind."""

Registered = TypeVar("Registered", bound=type)

_logger = logging.getLogger(__name__)
_tables: dict[str, dict[str, type]] = {category: {} for category in CATEGORIES}
_loaded = False


def register(category: str, kind: str) -> Callable[[Registered], Registered]:
    """Return a decorator that adds a class to a table.

    Args:
        category: One of `CATEGORIES`.
        kind: Name of the class in settings, such as "depth".

    Raises:
        TypeError: The class lacks a member that its category requires.
        ValueError: There is no such category, the kind is taken, or the field `kind` of the class differs.
    """
    table = _table(category)

    def add(cls: Registered) -> Registered:
        if not cls.__module__.startswith("neurosim_core."):
            _import_built_in(category)  # built-in kinds are taken, even if they are not imported yet
            load_plugins()
        known = table.get(kind)
        if known is not None and (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise ValueError(
                f"the {category} kind {kind!r} is taken by {known.__module__}.{known.__qualname__}: "
                f"give {cls.__module__}.{cls.__qualname__} another"
            )
        own = getattr(cls, "model_fields", {}).get("kind")
        if category not in ("noise", "task") and not isinstance(getattr(own, "default", None), str):
            raise TypeError(f'{cls.__qualname__} needs a field `kind: Literal["{kind}"] = "{kind}"`')
        if own is not None and own.default != kind:
            raise ValueError(
                f"{cls.__qualname__} is registered as {category} kind {kind!r}, but its field `kind` is "
                f"{own.default!r}: give both the same name"
            )
        check: Callable[[], None] | None = getattr(cls, "check_class", None)
        if check is not None:
            check()
        table[kind] = cls
        return cls

    return add


def kinds(category: str) -> Mapping[str, type]:
    """Return the classes of a category by kind, including those of installed plug-ins.

    Raises:
        ValueError: There is no such category.
    """
    table = registered(category)
    _import_built_in(category)
    load_plugins()
    return table


def registered(category: str) -> Mapping[str, type]:
    """Return the classes of a category by kind that are imported so far.

    Raises:
        ValueError: There is no such category.
    """
    return MappingProxyType(_table(category))


def find(category: str, kind: str) -> type:
    """Return the class of a kind.

    Raises:
        ValueError: There is no such category or kind; the message lists the known ones.
    """
    table = _table(category)
    if kind not in table and kind in (modules := _built_in_modules(category)):
        importlib.import_module(modules[kind])
    if kind not in table:
        _import_built_in(category)
        load_plugins()
    if kind not in table:
        raise ValueError(f"unknown {category} kind {kind!r}, known: {sorted(table)}")
    return table[kind]


def load_plugins() -> None:
    """Import all modules that register kinds, built-in ones and those of entry points, once in a process.

    Built-in tasks are not imported, because they need PyTorch. A plug-in that fails to import is skipped with
    a warning, so that one broken package does not affect others; its registrations are undone.
    """
    global _loaded
    if _loaded:
        return
    _loaded = True
    from importlib.metadata import entry_points  # slow to import, and most runs do not need it

    for category in CATEGORIES:
        if category != "task":
            _import_built_in(category)
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        before = {category: dict(table) for category, table in _tables.items()}
        try:
            entry.load()
        except Exception as error:  # a plug-in may raise anything when it is imported
            for category, table in _tables.items():
                broken = [
                    kind
                    for kind in table.keys() - before[category].keys()
                    if table[kind].__module__ not in sys.modules
                ]
                for kind in broken:
                    del table[kind]
            _logger.warning("the plug-in %s (%s) cannot be loaded: %s", entry.name, entry.value, error)


def _import_built_in(category: str) -> None:
    for module in _built_in_modules(category).values():
        importlib.import_module(module)


def _built_in_modules(category: str) -> dict[str, str]:
    """Return the modules of built-in kinds; for sensors all modules, some of which register none."""
    if category == "sensor":
        sensors = importlib.import_module("neurosim_core.sensors")
        names = (module.name for module in pkgutil.iter_modules(sensors.__path__))
        return {name: f"{sensors.__name__}.{name}" for name in names}
    return {kind: f"neurosim_core.{module}" for kind, module in _BUILT_IN.get(category, {}).items()}


def _table(category: str) -> dict[str, type]:
    if category not in _tables:
        raise ValueError(f"unknown category {category!r}, known: {', '.join(CATEGORIES)}")
    return _tables[category]
