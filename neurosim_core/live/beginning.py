"""How a run begins: seeds, and where everybody starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from cortex.messages import Reset
from neurosim_core.config import SimulationConfig
from neurosim_core.live.craft import Craft
from neurosim_core.simulation import StartState, State


class Beginning(NamedTuple):
    """The beginning of a run, by vehicle."""

    states: dict[str, State]
    seeds: dict[str, int]


def make_beginning(crafts: Sequence[Craft], config: SimulationConfig, request: Reset) -> Beginning:
    """Return the beginning of the run that is asked for.

    Args:
        crafts: The vehicles.
        config: Says what is not asked for.
        request: Seed, and where one vehicle starts.

    Raises:
        ValueError: There is no such vehicle, a seed is negative, or a start is not finite.
    """
    names = [craft.name for craft in crafts]
    starts = {
        key: value
        for key in ("position", "orientation", "velocity", "body_rate")
        if (value := getattr(request, key)) is not None
    }
    if request.vehicle and request.vehicle not in names:
        raise ValueError(f"unknown vehicle {request.vehicle!r}, known: {', '.join(names)}")
    if starts and not request.vehicle and len(names) > 1:
        raise ValueError(f"say which vehicle starts elsewhere: one of {', '.join(names)}")
    if request.seed is not None:
        if request.seed < 0:
            raise ValueError(f"seed must be 0 or more, got {request.seed}")
        config = config.model_copy(update={"seed": request.seed})
    start = StartState(**starts)
    states, seeds = {}, {}
    for craft in crafts:
        seeds[craft.name] = config.of(craft.name).seed
        moved = request.vehicle in ("", craft.name)
        states[craft.name] = craft.make_state(
            seed=seeds[craft.name], start=start if starts and moved else None
        )
    return Beginning(states, seeds)
