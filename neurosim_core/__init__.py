"""Neurosim: event cameras, RGB, depth and IMU on agile multirotors.

Everything is imported on first use: `import neurosim_core` starts no device and loads no heavy library.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neurosim_core.config import SimulationConfig, load_config
    from neurosim_core.sim.model import make_model
    from neurosim_core.sim.rollout import run, step
    from neurosim_core.sim.simulation import Simulation
    from neurosim_core.sim.state import make_state

__version__ = "0.1.0"

__all__ = ["Simulation", "SimulationConfig", "load_config", "make_model", "make_state", "run", "step"]

_HOME = {
    "SimulationConfig": "neurosim_core.config",
    "load_config": "neurosim_core.config",
    "Simulation": "neurosim_core.sim.simulation",
    "make_model": "neurosim_core.sim.model",
    "make_state": "neurosim_core.sim.state",
    "run": "neurosim_core.sim.rollout",
    "step": "neurosim_core.sim.rollout",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'neurosim_core' has no attribute {name!r}, known: {__all__}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
