# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,valid-type"
"""Where vehicles begin, and the kernels that put them there."""

# No `from __future__ import annotations`: Warp needs the annotations of structures as objects.

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.frames import normalised
from neurosim_core.sim.scene_table import SceneTable
from neurosim_core.sim.trace import WorldArrays
from neurosim_core.vehicle.arrays import STATUS_OK

wp.set_module_options({"enable_backward": False})


@wp.struct
class Start:
    """Where vehicles begin, one row for each world."""

    position: wp.array2d[wp.float64]  # p_WB [m], [N, 3]
    velocity: wp.array2d[wp.float64]  # v_WB in W [m/s], [N, 3]
    orientation: wp.array2d[wp.float64]  # q_WB, xyzw, [N, 4], of unit length
    body_rate: wp.array2d[wp.float64]  # w_WB in B [rad/s], [N, 3]


def begin_of_paths(scenes: SceneTable) -> dict[str, NDArray[np.float64]]:
    """Return where the vehicle of each world begins as configured, by name, shape [N, ...]."""
    begins = [model.path.evaluate([0]) for model in scenes.models]
    half_yaw = [0.5 * begin.yaw[0] for begin in begins]
    of_scene: dict[str, NDArray[np.float64]] = {
        "position": np.array([np.ravel(begin.position) for begin in begins]),
        "velocity": np.array([np.ravel(begin.velocity) for begin in begins]),
        "orientation": np.array([[0.0, 0.0, np.sin(half), np.cos(half)] for half in half_yaw]),
        "body_rate": np.zeros((len(begins), 3)),
    }
    rows = {name: values[list(scenes.scene_of_world)] for name, values in of_scene.items()}
    rows["orientation"] = normalised(rows["orientation"])
    return rows


@wp.func
def _row3(rows: wp.array2d[wp.float64], row: int) -> wp.vec3d:
    return wp.vec3d(rows[row, 0], rows[row, 1], rows[row, 2])


@wp.kernel
def restart(
    # Model:
    hover_rad_s: wp.float64,
    # In:
    mask: wp.array[wp.int32],
    start: Start,
    # Out:
    worlds: WorldArrays,
) -> None:
    """Put the vehicles of some worlds where they begin, with rotors at hover, at time 0."""
    world = wp.tid()
    if mask[world] == 0:
        return
    vehicles = worlds.vehicles
    vehicles.position[world] = _row3(start.position, world)
    vehicles.velocity[world] = _row3(start.velocity, world)
    vehicles.orientation[world] = wp.quatd(
        start.orientation[world, 0],
        start.orientation[world, 1],
        start.orientation[world, 2],
        start.orientation[world, 3],
    )
    vehicles.body_rate[world] = _row3(start.body_rate, world)
    for rotor in range(vehicles.rotor_speed.shape[1]):
        vehicles.rotor_speed[world, rotor] = hover_rad_s
        vehicles.rotor_speed_command[world, rotor] = hover_rad_s
    vehicles.stamp_ns[world] = wp.int64(0)
    vehicles.status[world] = STATUS_OK
    vehicles.redone_count[world] = wp.int64(0)
    vehicles.evaluation_count[world] = wp.int64(0)
    worlds.clock_ns[world] = wp.int64(0)
    worlds.collided[world] = 0


@wp.kernel
def take_seeds(
    # In:
    mask: wp.array[wp.int32],
    seeds: wp.array[wp.uint64],
    # Out:
    seeds_out: wp.array[wp.uint64],
) -> None:
    """Copy the seeds of some worlds."""
    world = wp.tid()
    if mask[world] != 0:
        seeds_out[world] = seeds[world]
