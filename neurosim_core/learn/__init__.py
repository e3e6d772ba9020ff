"""Learning to fly: environments of many worlds for PyTorch, tasks, training, and what flies a policy.

Needs the extra `learn`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from neurosim_core.install import install_hint

if TYPE_CHECKING:
    from neurosim_core.learn.env import Env, make_env
    from neurosim_core.learn.episodes import Randomisation, StartConfig
    from neurosim_core.learn.surfaces import Counts, LeakySurface, TimeSurface, VoxelGrid
    from neurosim_core.learn.task import Task, View

_HOMES = {
    "neurosim_core.learn.env": ("Env", "make_env"),
    "neurosim_core.learn.episodes": ("Randomisation", "StartConfig"),
    "neurosim_core.learn.surfaces": ("Counts", "LeakySurface", "TimeSurface", "VoxelGrid"),
    "neurosim_core.learn.task": ("Task", "View"),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Counts",
    "Env",
    "LeakySurface",
    "Randomisation",
    "StartConfig",
    "Task",
    "TimeSurface",
    "View",
    "VoxelGrid",
    "make_env",
]


def need(*modules: str) -> Any:
    """Import libraries of the extra, and return the first.

    Raises:
        ImportError: One is not installed; says how to install it.
    """
    try:
        found = [importlib.import_module(module) for module in modules]
        return found[0]
    except ImportError as error:
        raise ImportError(f"{error}: learning needs {', '.join(modules)}; {install_hint('learn')}") from None


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}, known: {', '.join(__all__)}")
    need("torch")
    return getattr(importlib.import_module(_HOME[name]), name)
