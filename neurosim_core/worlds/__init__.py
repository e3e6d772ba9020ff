"""Many worlds with one vehicle each, stepped together, for learning: everything stays on the device."""

from neurosim_core.worlds.observation import ImuRows, Observation, VehicleStates
from neurosim_core.worlds.parameters import Rig
from neurosim_core.worlds.scenes import SceneSource
from neurosim_core.worlds.world_events import WorldEvents
from neurosim_core.worlds.worlds import Worlds, make_worlds

__all__ = [
    "ImuRows",
    "Observation",
    "Rig",
    "SceneSource",
    "VehicleStates",
    "WorldEvents",
    "Worlds",
    "make_worlds",
]
