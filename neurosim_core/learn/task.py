"""The base class of tasks, which define observations, rewards and the ends of episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch

from neurosim_core.learn.episodes import Routes, StartConfig
from neurosim_core.learn.randomisation import Randomisation
from neurosim_core.learn.surfaces import LeakySurface, SurfaceConfig
from neurosim_core.scene.config import SceneConfig
from neurosim_core.vehicle import MultirotorConfig

ActionMode = Literal["rates", "attitude", "velocity", "motor_speeds"]
"""Names of the modes of `control.modes.MODES` that actions can command."""

MIRROR_ACTION = (1.0, -1.0, 1.0, -1.0)
"""Signs of an action when left and right are exchanged."""

Observations = dict[str, torch.Tensor]
"""Observations by name: float32 tensors, shape [N, ...]."""


@dataclass(kw_only=True, eq=False)
class View:
    """The state of all worlds at the end of a step. Its tensors are overwritten by the next step.

    Vectors in B are in the body frame.
    """

    position: torch.Tensor
    """p_WB [m], float32, shape [N, 3]."""
    velocity: torch.Tensor
    """v_WB in W [m/s], [N, 3]."""
    orientation: torch.Tensor
    """q_WB, xyzw, [N, 4]."""
    body_rate: torch.Tensor
    """w_WB in B [rad/s], [N, 3]."""
    velocity_B: torch.Tensor
    """v_WB in B [m/s], [N, 3]."""
    gravity_B: torch.Tensor
    """Direction of gravity in B, [N, 3]."""
    goal_B: torch.Tensor
    """From the vehicle to the goal, in B [m], [N, 3]."""
    gyro: torch.Tensor
    """Measured body rate [rad/s], [N, 3]."""
    gravity_measured: torch.Tensor
    """`gravity_B` with the errors of an attitude estimator, [N, 3]."""
    clearance: torch.Tensor
    """Distance from the vehicle's centre to the scene [m], with the resolution of a voxel, [N, 1]."""
    probes: torch.Tensor
    """Distance from the points `Task.probes` to the scene [m], with the resolution of a voxel, [N, K]."""
    scenes: Sequence[SceneConfig]
    """Settings of the scenes."""
    scene: torch.Tensor
    """Index of the scene of each world, int64, [N]."""
    surface: torch.Tensor | None
    """Event surface, [N, C, H, W]; None: there is no camera."""
    action: torch.Tensor
    """The last action, in [-1, 1], [N, 4]."""
    last_action: torch.Tensor
    """The action before the last one, [N, 4]."""
    crashed: torch.Tensor
    """The vehicle touched the scene, or its motion could not be integrated, bool, [N]."""
    elapsed_s: torch.Tensor
    """Time since the begin of the episode [s], [N]."""
    draws: torch.Tensor
    """Uniform random numbers in (0, 1) of the episode, [N, 16]; the first eleven are for tasks."""
    bodies: torch.Tensor
    """Positions and velocities of the thrown bodies in W [m, m/s], [N, B, 6]."""
    step_s: float
    """Length of a step [s]."""
    vehicle: MultirotorConfig
    """Parameters of the vehicle."""


class Task:
    """The base class of tasks: settings, and the methods that a task defines.

    `@ns.register("task", "name")` registers a task. All methods work on tensors of all worlds. They must not
    wait for the device (no `.item()`, no `if tensor`), nor mix worlds.
    """

    rate_hz: float = 50.0
    """Steps a second."""
    rate_on_cpu_hz: float | None = None
    """Steps a second in trainings on a CPU, where renders dominate the cost; None: `rate_hz`."""
    episode_s: float = 6.0
    """Time after which an episode is truncated [s]."""
    camera: Mapping[str, Any] = {"width": 24, "height": 24, "horizontal_fov_rad": 1.6}
    """Lens of the event camera."""
    mount: Mapping[str, Any] = {"position_m": (0.1, 0.0, 0.03)}
    """Pose of the camera on the body: {position_m, rpy_rad}; positive pitch looks down."""
    surface: SurfaceConfig = LeakySurface(tau_s=(0.02, 0.2))
    """Representation of events."""
    threshold: float = 0.1
    """ON and OFF threshold of the event camera."""
    pixel: Mapping[str, Any] = {}
    """Settings of its pixels, such as {preset: davis346}, in place of `threshold`; {}: ideal pixels."""
    renders_per_step: int = 1
    """Number of renders in a step."""
    rays_per_pixel: int = 4
    """Rays per pixel; with one, half the events of a coarse picture are false."""
    vehicle: Mapping[str, Any] = {"preset": "hummingbird"}
    """Settings of the vehicle."""
    start: StartConfig = StartConfig()
    """Random starts of episodes."""
    randomisation: Randomisation = Randomisation()
    """Random values of each episode."""
    training: Randomisation | None = None
    """Wider randomisation for training, which helps students in new scenes; None: `randomisation`."""
    mode: ActionMode = "rates"
    """Meaning of the four numbers of an action. `rates`: thrust, body rates. `attitude`: thrust, roll,
    pitch, change of the heading. `velocity`: ahead, left, up, rate of the heading. `motor_speeds`: the thrust
    of four rotors."""
    rate_max_rad_s: Sequence[float] = (4.0, 4.0, 2.0)
    """Body rates of an action of 1 [rad/s]; the last is that of the heading, too."""
    thrust_span: float = 0.6
    """Change of thrust of an action of 1, as a share of the hover thrust."""
    tilt_max_rad: float = 0.6
    """Angles of an action of 1, in mode `attitude` [rad]."""
    speed_max_m_s: float = 2.0
    """Speed of an action of 1 along each axis, in mode `velocity` [m/s]."""
    bodies: Mapping[str, Any] = {}
    """Settings of bodies, which `throw` throws in each world; needs a single scene."""
    probes: Sequence[tuple[float, float, float]] = ()
    """Points for `View.probes` [m]: ahead, to the left and above the vehicle, in a level frame."""
    groups: Mapping[str, Sequence[str]] = {
        "actor": ("state",),
        "critic": ("state",),
        "teacher": ("state",),
        "student": ("proprioception", "events"),
    }
    """Names of observations that each group sees: actor, critic, teacher, student."""
    teacher: Mapping[str, Any] = {}
    """Settings of `PpoConfig` for the teacher that differ from those of `hover`."""
    student: Mapping[str, Any] = {}
    """Settings of `DaggerConfig` for the student that differ from those of `hover`."""
    hint: str = "velocity"
    """Name of the observation that students learn to estimate."""
    mirror: Mapping[str, Sequence[float]] = {}
    """Signs of observations when left and right are exchanged, for students; {}: no mirroring."""

    def scenes(self, *, unseen: bool) -> list[dict[str, Any]]:
        """Return settings of the training scenes, or of other scenes for tests."""
        first = 100 if unseen else 0
        return [{"kind": "apartment", "rooms": 1, "seed": first + seed} for seed in range(4)]

    def routes(self, scene: SceneConfig) -> Routes | None:
        """Return starts and goals of episodes in a scene; None: random ones, by `start`."""
        return None

    def throw(
        self, position: torch.Tensor, orientation: torch.Tensor, draws: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the positions and velocities of `bodies` at the begin of an episode; then they fall freely.

        Args:
            position: p_WB at the begin [m], float64, [N, 3].
            orientation: q_WB at the begin, xyzw, float64, [N, 4].
            draws: `View.draws` of the episode.

        Returns:
            p_WO [m] and the velocity in W [m/s], [N, B, 3].
        """
        raise NotImplementedError

    def command(self, view: View) -> torch.Tensor:
        """Return the commands of the last actions, rows of `control.modes.MODES[mode]`, [N, width]."""
        return COMMANDS[self.mode](self, view)

    def begin(self, view: View, mask: torch.Tensor) -> None:
        """Handle the begin of episodes in the worlds of a mask (bool, [N])."""

    def advance(self, view: View) -> None:
        """Handle the end of a step, before rewards and observations are computed."""

    def observe(self, view: View) -> Observations:
        """Return the observations by name; the environment adds event surfaces as `events`."""
        raise NotImplementedError

    def reward(self, view: View) -> torch.Tensor:
        """Return the reward of the step, [N]."""
        raise NotImplementedError

    def terminated(self, view: View) -> torch.Tensor:
        """Return the episodes that terminate, bool, [N]; crashed episodes always do."""
        return view.crashed

    def metrics(self, view: View) -> dict[str, torch.Tensor]:
        """Return metrics of the episodes, [N] each; they are read at the end of an episode.

        `success` and `crash` are 1 or 0; by default, an episode without a crash is a success.
        """
        crash = view.crashed.float()
        return {"success": 1.0 - crash, "crash": crash}


def _thrust_n(task: Task, view: View) -> torch.Tensor:
    return view.vehicle.hover_thrust_n * (1.0 + task.thrust_span * view.action[:, :1])


def _rates(task: Task, view: View) -> torch.Tensor:
    """Thrust, and body rates."""
    rates = [most * view.action[:, 1 + axis, None] for axis, most in enumerate(task.rate_max_rad_s)]
    return torch.cat([_thrust_n(task, view), *rates], dim=1)


def _attitude(task: Task, view: View) -> torch.Tensor:
    """Thrust, roll, pitch, and the change of the heading."""
    roll, pitch, change = (0.5 * task.tilt_max_rad * view.action[:, 1:]).unbind(1)  # half the angles
    yaw = 0.5 * _heading(view) + change
    (cx, sx), (cy, sy), (cz, sz) = ((half.cos(), half.sin()) for half in (roll, pitch, yaw))
    x, y = sx * cy * cz - cx * sy * sz, cx * sy * cz + sx * cy * sz
    z, w = cx * cy * sz - sx * sy * cz, cx * cy * cz + sx * sy * sz
    q = torch.stack([x, y, z, w], dim=1)
    # q and -q are one attitude, and commands that lag must not mix them
    near = (q * view.orientation).sum(1, keepdim=True) >= 0.0
    return torch.cat([_thrust_n(task, view), torch.where(near, q, -q)], dim=1)


def _velocity(task: Task, view: View) -> torch.Tensor:
    """Velocity ahead, to the left and up, and the rate of the heading."""
    ahead, left, up, around = view.action.unbind(1)
    heading = _heading(view)
    c, s, most = heading.cos(), heading.sin(), task.speed_max_m_s
    velocity = [most * (c * ahead - s * left), most * (s * ahead + c * left), most * up]
    return torch.stack([*velocity, task.rate_max_rad_s[2] * around], dim=1)


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
"""Functions by mode that return the commands of the last actions, [N, width of the mode]."""


def hover_command(mode: ActionMode, vehicle: MultirotorConfig) -> list[float]:
    """Return the command before the first action; an attitude is then turned to the heading."""
    if mode not in COMMANDS:
        raise ValueError(f"unknown mode {mode!r} of actions, known: {', '.join(COMMANDS)}")
    if mode == "motor_speeds":
        if vehicle.rotor_count != 4:
            raise ValueError(f"motor_speeds needs a vehicle with four rotors, got {vehicle.rotor_count}")
        return 4 * [vehicle.hover_rotor_speed_rad_s]
    first = 0.0 if mode == "velocity" else vehicle.hover_thrust_n
    return [first, 0.0, 0.0, 0.0, *([1.0] if mode == "attitude" else [])]


def turn(q: torch.Tensor, vectors: torch.Tensor, *, back: bool = False) -> torch.Tensor:
    """Return vectors in B rotated to W by q_WB (xyzw), or with `back` from W to B, [N, 3]."""
    xyz, w = (-q[:, :3] if back else q[:, :3]), q[:, 3:]
    across = 2.0 * torch.linalg.cross(xyz, vectors)
    return vectors + w * across + torch.linalg.cross(xyz, across)
