"""What actions command: thrust and body rates, thrust and attitude, velocity, or rotor speeds."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import torch

from neurosim_core.vehicle import MultirotorConfig

if TYPE_CHECKING:
    from neurosim_core.learn.task import Task, View

ActionMode = Literal["rates", "attitude", "velocity", "motor_speeds"]
"""Names of the modes of `control.modes.MODES` that actions can command."""


def _thrust_n(task: Task, view: View) -> torch.Tensor:
    return view.vehicle.hover_thrust_n * (1.0 + task.thrust_span * view.action[:, :1])


def _rates(task: Task, view: View) -> torch.Tensor:
    """Thrust, and body rates."""
    rates = [most * view.action[:, 1 + axis, None] for axis, most in enumerate(task.rate_max_rad_s)]
    return torch.cat([_thrust_n(task, view), *rates], dim=1)


def _attitude(task: Task, view: View) -> torch.Tensor:
    """Thrust, roll, pitch, and how far to turn the heading from what it is."""
    roll, pitch, turn = (0.5 * task.tilt_max_rad * view.action[:, 1:]).unbind(1)  # half the angles
    yaw = 0.5 * _heading(view) + turn
    (cx, sx), (cy, sy), (cz, sz) = ((half.cos(), half.sin()) for half in (roll, pitch, yaw))
    x, y = sx * cy * cz - cx * sy * sz, cx * sy * cz + sx * cy * sz
    z, w = cx * cy * sz - sx * sy * cz, cx * cy * cz + sx * sy * sz
    q = torch.stack([x, y, z, w], dim=1)
    # q and -q are one attitude, and commands that lag must not mix them
    near = (q * view.orientation).sum(1, keepdim=True) >= 0.0
    return torch.cat([_thrust_n(task, view), torch.where(near, q, -q)], dim=1)


def _velocity(task: Task, view: View) -> torch.Tensor:
    """Velocity ahead, to the left and up, and the rate of the heading."""
    ahead, left, up, turn = view.action.unbind(1)
    heading = _heading(view)
    c, s, most = heading.cos(), heading.sin(), task.speed_max_m_s
    velocity = [most * (c * ahead - s * left), most * (s * ahead + c * left), most * up]
    return torch.stack([*velocity, task.rate_max_rad_s[2] * turn], dim=1)


def _motor_speeds(task: Task, view: View) -> torch.Tensor:
    """The thrust of each of four rotors, as a speed."""
    share = (1.0 + task.thrust_span * view.action).clamp(min=0.0)
    return view.vehicle.hover_rotor_speed_rad_s * share.sqrt()


def _heading(view: View) -> torch.Tensor:
    x, y, z, w = view.orientation.unbind(1)
    return torch.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))


COMMANDS: dict[str, Callable[[Task, View], torch.Tensor]] = {
    "rates": _rates,
    "attitude": _attitude,
    "velocity": _velocity,
    "motor_speeds": _motor_speeds,
}
"""By mode: the commands of the last actions, [N, width of the mode]."""


def hover_command(mode: ActionMode, vehicle: MultirotorConfig) -> list[float]:
    """Return what is commanded before the first action takes effect; an attitude is turned to the heading."""
    if mode not in COMMANDS:
        raise ValueError(f"unknown mode {mode!r} of actions, known: {', '.join(COMMANDS)}")
    if mode == "motor_speeds":
        if vehicle.rotor_count != 4:
            raise ValueError(f"motor_speeds needs a vehicle with four rotors, got {vehicle.rotor_count}")
        return 4 * [vehicle.hover_rotor_speed_rad_s]
    first = 0.0 if mode == "velocity" else vehicle.hover_thrust_n
    return [first, 0.0, 0.0, 0.0, *([1.0] if mode == "attitude" else [])]
