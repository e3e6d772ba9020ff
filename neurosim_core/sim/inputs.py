# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,valid-type"
"""Inputs of worlds, from the host or on the device: commands, seeds, masks, initial states of vehicles."""

# No `from __future__ import annotations`: Warp needs the annotations of structures as objects.

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from neurosim_core.frames import as_rows, normalised
from neurosim_core.runtime.cuda import Fence, HostInput
from neurosim_core.sim.scene_table import SceneTable
from neurosim_core.sim.trace import WorldArrays
from neurosim_core.vehicle.arrays import STATUS_OK

wp.set_module_options({"enable_backward": False})


class CommandBuffer:
    """Commands of one mode on the device.

    A step that waits for the one before it *stages* them: its launches begin with the `upload`. Steps that
    run ahead of the device *write* them, through two buffers of the host in turn: the host waits only if the
    device has not yet copied what it was given two steps ago.
    """

    def __init__(self, array: Any) -> None:
        self.array = array
        self._hosts = [HostInput(array)]
        self._read = [Fence(array.device) for _ in range(2)]
        self._turn = 0

    def stage(self, rows: NDArray[np.float64]) -> None:
        """Keep rows for the next `upload`; what was staged before has been copied."""
        self._hosts[0].rows[:] = rows

    def upload(self) -> None:
        """Launch the copy of what was staged."""
        self._hosts[0].upload()

    def write(self, rows: NDArray[np.float64]) -> None:
        """Launch the copy of rows to the device."""
        if len(self._hosts) < 2:
            self._hosts.append(HostInput(self.array))
        turn, self._turn = self._turn, 1 - self._turn
        self._read[turn].wait()
        self._hosts[turn].rows[:] = rows
        self._hosts[turn].upload()
        self._read[turn].set()


def make_seeds(seeds: int | ArrayLike, count: int) -> list[int]:
    """Return a seed for each world: those given, or that of world 0, which the others count on from.

    Raises:
        ValueError: They are no integers in [0, 2^64), or of the wrong number.
    """
    given = np.asarray(seeds)
    if not np.issubdtype(given.dtype, np.integer) or given.shape not in ((), (count,)):
        raise ValueError(
            f"seeds must be an integer or integers of shape [{count}], got {given.dtype} "
            f"of shape {list(given.shape)}"
        )
    chosen = [int(s) for s in given] if given.ndim else [int(given) + world for world in range(count)]
    if min(chosen) < 0 or max(chosen) >= 1 << 64:
        raise ValueError(f"seeds must be in [0, 2^64), got {min(chosen)} to {max(chosen)}")
    return chosen


def as_device_array(value: Any, device: Any) -> Any:
    """Return a Warp array of the device without a copy, or None: it is something of the host.

    Raises:
        ValueError: It is on another device, or a tensor through which gradients are to flow.
    """
    if isinstance(value, wp.array):
        if value.device == device:
            return value
        raise ValueError(f"arrays must be on {device} or be NumPy arrays, got one on {value.device}")
    if getattr(value, "requires_grad", False):
        raise ValueError("gradients do not flow through worlds: give tensor.detach()")
    if device.is_cuda and hasattr(value, "__cuda_array_interface__"):
        return wp.from_dlpack(value)
    return None


def check_rows(rows: Any, out: Any, name: str) -> None:
    """Refuse an array of the device that cannot be copied to another."""
    if rows.ndim != 2 or tuple(rows.shape) != tuple(out.shape):
        raise ValueError(f"{name} must have shape {list(out.shape)}, got {list(rows.shape)}")
    if rows.dtype not in (wp.float32, wp.float64):
        raise ValueError(f"{name} must be float32 or float64, got {rows.dtype.__name__}")


def checked_rows(value: Any, out: Any, name: str) -> Any:
    """Return rows for an array of the device, on the device, float64; quaternions have unit length then."""
    given, is_orientation = as_device_array(value, out.device), name == "orientation"
    if given is None:
        on_host = as_rows(value, name=name, count=out.shape[0], width=out.shape[1])
        on_host = normalised(on_host) if is_orientation else on_host
        return wp.array(on_host, dtype=wp.float64, device=out.device)
    check_rows(given, out, name)
    rows = wp.zeros(out.shape, dtype=wp.float64, device=out.device)
    wp.utils.array_cast(given, rows)
    if is_orientation:
        wp.launch(_normalise, dim=rows.shape[0], outputs=[rows], device=out.device)
    return rows


@wp.kernel
def _normalise(
    # In/out:
    orientation: wp.array2d[wp.float64],
) -> None:
    """Give quaternions unit length."""
    world = wp.tid()
    total = wp.float64(0.0)
    for part in range(4):
        total += orientation[world, part] * orientation[world, part]
    for part in range(4):
        orientation[world, part] = orientation[world, part] / wp.sqrt(total)


def checked_mask(mask: Any, count: int, device: Any) -> Any:
    """Return a mask of the right shape: an array of the device, of any of the types that it may have."""
    given = as_device_array(mask, device)
    kinds: tuple[Any, ...] = (wp.bool, wp.uint8, wp.int32)
    if given is None:
        given = np.asarray(mask)
        kinds = (np.bool_, np.uint8, np.int32)
    if given.shape != (count,) or given.dtype not in kinds:
        raise ValueError(
            f"mask must be bool, uint8 or int32 of shape [{count}], "
            f"got {getattr(given.dtype, '__name__', given.dtype)} of shape {list(given.shape)}"
        )
    if isinstance(given, np.ndarray):
        return wp.array((given != 0).astype(np.int32), dtype=wp.int32, device=device)
    return given


def checked_seeds(seed: Any, count: int, device: Any) -> Any:
    """Return seeds of all worlds: an array of the device."""
    if not isinstance(seed, wp.array):
        return wp.array(np.array(make_seeds(seed, count), dtype=np.uint64), dtype=wp.uint64, device=device)
    if seed.dtype != wp.uint64 or seed.shape != (count,):
        raise ValueError(
            f"seed must be uint64 of shape [{count}], got {seed.dtype.__name__} of shape {list(seed.shape)}"
        )
    return as_device_array(seed, device)


@wp.struct
class Start:
    """Initial states of vehicles, one row for each world."""

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
