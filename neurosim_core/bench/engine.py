"""Everything that the benchmarks take from the engine, in one place: its names, flights and pictures."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from neurosim_core.clock import Rate
from neurosim_core.config import SimulationConfig, load_config, to_yaml
from neurosim_core.control import PathFollower
from neurosim_core.frames import Mount
from neurosim_core.live.probe import ProbeError, StreamProbe, answer_images
from neurosim_core.overrides import set_options
from neurosim_core.packets import EventArrays, Events, Odometry, join_events
from neurosim_core.record import Recording
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import RenderConfig
from neurosim_core.render.renderer import make_renderer, upload_scene
from neurosim_core.scene.freespace import FreeSpaceConfig, make_free_space
from neurosim_core.scene.scene import Ambient, Material, Scene
from neurosim_core.sensors.displacement import DisplacementRule
from neurosim_core.sensors.event_config import EventCameraConfig, event_presets
from neurosim_core.sensors.events import EventCamera
from neurosim_core.sim.model import Model, make_model, refit
from neurosim_core.sim.rollout import run_model, step
from neurosim_core.sim.simulation import Simulation
from neurosim_core.sim.state import StartState, make_state
from neurosim_core.trajectory.shapes import FigureEightConfig, figure_eight
from neurosim_core.vehicle import DynamicsError, Multirotor, MultirotorConfig, MultirotorState, preset
from neurosim_core.warp_start import find_device

Poses = tuple[NDArray[np.float32], NDArray[np.float32]]
"""p_WC [m], shape [K, 3], and q_WC, xyzw, shape [K, 4]."""


def device_title(device: str) -> str:
    """Return the name of a device for people."""
    return str(wp.get_device(find_device(device)).name)


def scene_settings(scene: Path | None, *, quick: bool = False) -> dict[str, Any]:
    """Return the settings of a mesh file as the scene; none for the apartment, one room if `quick`."""
    if scene is not None:
        return {"scene": {"kind": "mesh", "file": str(scene.resolve())}}
    return {"scene": {"kind": "apartment", "rooms": 1}} if quick else {}


def option_names(camera: str, **more: str) -> dict[str, str]:
    """Return what the command line calls settings of a camera, for error messages: setting -> option."""
    names = {"lens.width": "--width", "lens.height": "--height", **more}
    return {"device": "--device", **{f"sensors.{camera}.{key}": name for key, name in names.items()}}


def free_views(scene: Scene, count: int, *, device: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points with room around them [m], [n, 3], and yaws [rad], [n]; n is `count` at most."""
    low, high = scene.bounds_m
    rng = np.random.default_rng(6)
    points = rng.uniform([*low[:2], 0.8], [*high[:2], 1.8], (4000, 3))
    space = make_free_space(scene, FreeSpaceConfig(), device=device)
    roomy = points[space.clearance(points) > 0.6][:count]
    return roomy, rng.uniform(-np.pi, np.pi, 6)[: len(roomy)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Flown:
    """States of one vehicle at the ticks of a clock."""

    model: Model
    rate: Rate
    stamps_ns: NDArray[np.int64]
    """Shape [n]."""
    states: NDArray[np.float64]
    """Position, orientation (xyzw), velocity, body rate, rotor speeds, shape [n, 13 + R]."""

    def poses(self) -> Poses:
        """Return where the default camera on the body is at the ticks."""
        return camera_poses(self.states[:, :3], Rotation.from_quat(self.states[:, 3:7]))


def camera_poses(p_WB: NDArray[np.float64], R_WB: Rotation) -> Poses:
    """Return where an event camera with its default mount is, for poses of the body [n]."""
    mount = default_mount()
    q_WC = (R_WB * Rotation.from_quat(mount.optical_quaternion())).as_quat()
    return (p_WB + R_WB.apply(mount.position_m)).astype(np.float32), q_WC.astype(np.float32)


def default_mount() -> Mount:
    """Return where an event camera is on the body if nothing is said of it."""
    mount: Mount = getattr(load_config().sensors["events"], "mount")  # noqa: B009
    return mount


def fly(config: SimulationConfig, rate_hz: float, *, pilot: Any = None, velocity: Any = None) -> Flown:
    """Fly without cameras, and note the states at the ticks of a rate.

    A pilot takes the airframe and the share of the flight that is over, and returns a command and its mode;
    without one the path is followed. `velocity` is that at the start, in W [m/s].
    """
    settings = config.model_dump()
    settings["sensors"] = {"odometry": {"kind": "odometry", "rate_hz": rate_hz}}
    settings["vehicle"]["on_collision"] = "report"
    model = make_model(SimulationConfig.model_validate(settings))
    state = make_state(model, start=StartState(velocity=velocity))
    end_ns = round(1e9 * config.duration_s)

    def packets() -> Iterator[Any]:
        if pilot is None:
            yield from run_model(model, state)
        while pilot is not None and state.stamp_ns < end_ns:
            command, mode = pilot(model.airframe, state.stamp_ns / end_ns)
            yield from step(model, state, command, mode=mode)
            if state.failure is not None:
                raise state.failure

    rows = [
        np.concatenate([p.position, p.orientation, p.velocity, p.body_rate, p.rotor_speed])
        for p in packets()
        if isinstance(p, Odometry)
    ]
    rate = Rate(rate_hz)
    stamps_ns = np.array(list(rate.stamps(0, end_ns + 1)))[: len(rows)]
    return Flown(model=model, rate=rate, stamps_ns=stamps_ns, states=np.array(rows)[: len(stamps_ns)])


def adaptive_ticks(
    flown: Flown, arrays: Any, lens: PinholeConfig, limit_px: float, forced: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], float]:
    """Return the ticks that adaptive sampling renders, and the time that the choice takes [s].

    A point may move by `limit_px` between two renders; `forced` ticks, shape [n], are rendered in any case.
    """
    states: Any = wp.array(flown.states[:, None], dtype=wp.float64, device=arrays.device)
    mount = default_mount()
    p_BC, q_BC = wp.vec3d(*mount.position_m), wp.quatd(*mount.optical_quaternion())
    best_s, chosen = 0.0, [0]
    for count in (1, len(forced)):  # the first compiles
        pose: dict[str, Any] = {"p_BC": p_BC, "q_BC": q_BC}
        rule = DisplacementRule(arrays, lens, max_displacement_px=limit_px, rate=flown.rate, **pose)
        begin_s = busy_s(arrays.device)
        chosen = rule.choose(states, range(count), flown.stamps_ns[:count].tolist(), forced[:count].tolist())
        best_s = busy_s(arrays.device) - begin_s
    return np.array(chosen), best_s


def busy_s(device: str) -> float:
    """Return CPU time of all threads [s]; on CUDA the wall clock, when the device is idle."""
    if wp.get_device(device).is_cpu:
        return time.process_time()
    wp.synchronize_device(device)
    return time.perf_counter()


class ShiftedLens:
    """A lens whose rays are shifted within their pixels, so that several rays per pixel make another pattern.

    Reference: Cranley, Patterson (1976), Randomization of number theoretic methods for multiple integration.
    """

    def __init__(self, lens: PinholeConfig, shift_px: tuple[float, float]) -> None:
        self._lens = lens
        self._shift_px = shift_px
        self.width, self.height = lens.width, lens.height

    def __getattr__(self, name: str) -> Any:
        return getattr(self._lens, name)

    def ray_table(self, offset_px: tuple[float, float] = (0.5, 0.5)) -> NDArray[np.float32]:
        """Return directions of rays through shifted points of the pixels; see `PinholeConfig.ray_table`."""
        x, y = ((offset + shift) % 1.0 for offset, shift in zip(offset_px, self._shift_px, strict=True))
        return self._lens.ray_table((x, y))


class View:
    """Renders stacks of log radiance, of `count` pictures at most."""

    def __init__(self, arrays: Any, lens: Any, *, count: int, output: str = "log_radiance") -> None:
        self.device = str(arrays.device)
        self.count = count
        self._renderer = make_renderer(arrays, lens, outputs=[output], instant_count=count, image_count=count)
        self._slots: Any = wp.array(np.arange(count, dtype=np.int32), dtype=int, device=self.device)

    def render(self, poses: Poses) -> Any:
        """Return log radiance [K, H, W] on the device; the next call overwrites it."""
        p_WC: Any = wp.array(poses[0], dtype=wp.vec3, device=self.device)
        q_WC: Any = wp.array(poses[1], dtype=wp.quat, device=self.device)
        self._renderer.render(p_WC, q_WC, self._slots, instant_count=len(poses[0]))
        return self._renderer.log_radiance

    def stacks(self, poses: Poses) -> Iterator[tuple[slice, Any]]:
        """Render any number of poses, stack by stack; yield which poses they are, and their pictures."""
        for begin in range(0, len(poses[0]), self.count):
            rows = slice(begin, min(begin + self.count, len(poses[0])))
            yield rows, self.render((poses[0][rows], poses[1][rows]))


def event_settings(
    size: tuple[int, int],
    *,
    rate_hz: float,
    instants: int,
    samples: int | None = None,
    max_displacement_px: float | None = None,
) -> dict[str, Any]:
    """Return the settings of a flight with one event camera; packets end with the launches."""
    camera = {
        "kind": "event_camera",
        "lens": {"width": size[0], "height": size[1], "horizontal_fov_rad": 1.5},
        "sampling_rate_hz": rate_hz,
        "packet_rate_hz": rate_hz / instants,
        "max_displacement_px": max_displacement_px,
    }
    return {
        "instants_per_launch": instants,
        "vehicle": {"on_collision": "report"},
        "render": {} if samples is None else {"samples_per_pixel": samples},
        "sensors": {"events": camera},
    }
