"""What a controller commands for states on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim_core.control import Controller
from neurosim_core.vehicle.arrays import allocate_arrays


def command_of(
    controller: Controller, setpoint: ArrayLike | None = None, *, stamp_ns: int = 0, **state: ArrayLike
) -> NDArray[np.float64]:
    """Return rotor speed commands [rad/s], shape [N, R], for a state: rows of all vehicles, or one row."""
    arrays: Any = allocate_arrays(controller.count, controller.rotor_count, controller.device)
    for name, value in state.items():
        array = getattr(arrays, name)
        array.assign(np.broadcast_to(np.asarray(value, dtype=np.float64), array.numpy().shape))
    arrays.stamp_ns.fill_(stamp_ns)
    if setpoint is not None:
        controller.set(setpoint)
    controller.update(arrays)
    return np.array(arrays.rotor_speed_command.numpy())
