# mypy: disable-error-code="index,attr-defined,misc,call-overload,assignment,operator,arg-type"
"""Bodies that move through the scene on prescribed paths: their poses are pure functions of time.

A body is rigid and has a frame O. With t the time since the start of the episode [s], and what is not given
left out:

    p_WO(t) = position + velocity t + acceleration t^2 / 2
              + amplitude sin(2 pi f t + phase)                                   sway, along a line
              + radius (cos(2 pi n t + phase) e1 + sin(2 pi n t + phase) e2)      orbit, around its centre
    q_WO(t) = q_rest * exp(spin t)                                                spin, about an axis of O

Bodies are seen, not felt: paths are not planned around them, and running into one is no collision. They are
lit by the scene and lie in its shadows, but cast none, neither on it nor on each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import scipy  # which imports its parts when they are used
import warp as wp
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, field_validator

from neurosim_core.frames import Vector3, quaternion_exp
from neurosim_core.scene.body_shapes import BoxShape, ShapeConfig, SurfaceConfig, make_solid
from neurosim_core.scene.scene import Scene
from neurosim_core.settings import BaseConfig

wp.set_module_options({"enable_backward": False})

_TWO_PI = wp.constant(wp.float64(2.0 * np.pi))
_S_PER_NS = wp.constant(wp.float64(1e-9))


class SwayConfig(BaseConfig):
    """A sinusoid along a line: amplitude sin(2 pi f t + phase)."""

    amplitude_m: Vector3 = (0.0, 0.5, 0.0)
    """Largest displacement, a vector in W [m]."""
    frequency_hz: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.5
    """Frequency [Hz]."""
    phase_rad: float = 0.0
    """Phase at t = 0 [rad]."""


class OrbitConfig(BaseConfig):
    """A circle at constant speed around `position_m`; the body does not turn with it (see `spin_rad_s`)."""

    radius_m: Annotated[float, Field(ge=0.0, le=1e4)] = 0.5
    """Radius of the circle [m]."""
    rate_hz: Annotated[float, Field(ge=-1000.0, le=1000.0)] = 0.25
    """Revolutions a second [Hz], right-handed about the axis; negative: the other way round."""
    axis: Vector3 = (0.0, 0.0, 1.0)
    """Axis of the circle in W, a vector of any length."""
    phase_rad: float = 0.0
    """Angle at t = 0 [rad], from e1: the world's x axis projected onto the plane of the circle, or its y axis
    where x is within 0.5 rad of the normal."""

    @field_validator("axis")
    @classmethod
    def _has_a_direction(cls, axis: Vector3) -> Vector3:
        if not np.linalg.norm(axis) > 1e-9:
            raise ValueError(f"must not be zero, got {axis}")
        return axis

    def basis(self) -> NDArray[np.float64]:
        """Return e1 and e2, where the circle is at angle 0 and a quarter further, shape [2, 3]."""
        normal = np.array(self.axis) / np.linalg.norm(self.axis)
        start = np.eye(3)[int(abs(normal[0]) > np.cos(0.5))]
        first = start - normal * (normal @ start)
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(normal, first)])


class MotionConfig(BaseConfig):
    """The pose of a body as a function of time; parts that are given add up."""

    position_m: Vector3 = (0.0, 0.0, 0.0)
    """Origin of the body in W at t = 0, and the centre of its sway and its orbit [m]."""
    rpy_rad: Vector3 = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw at t = 0 [rad]: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    velocity_m_s: Vector3 = (0.0, 0.0, 0.0)
    """Velocity in W at t = 0, without sway and orbit [m/s]."""
    acceleration_m_s2: Vector3 = (0.0, 0.0, 0.0)
    """Constant acceleration in W [m/s^2]; (0, 0, -9.81): free fall."""
    sway: SwayConfig | None = None
    """A sinusoid along a line; null: none."""
    orbit: OrbitConfig | None = None
    """A circle; null: none."""
    spin_rad_s: Vector3 = (0.0, 0.0, 0.0)
    """Constant angular velocity in the frame of the body [rad/s]."""


_ABSENT = MotionConfig(position_m=(0.0, 0.0, -1e6))
"""Where a body is that is not in the scene: nothing of it is larger than a pixel from there."""


class BodyConfig(BaseConfig):
    """A rigid body with a prescribed motion."""

    shape: ShapeConfig = BoxShape()
    """Shape: {kind: box | sphere | cylinder | mesh, ...}."""
    surface: SurfaceConfig | None = None
    """Appearance: {kind: plain | checker | picture, ...}; null: grey, and a mesh as its file says."""
    motion: MotionConfig = MotionConfig()
    """Pose as a function of time."""
    present: bool = True
    """Whether it is in the scene; false: it is hidden until a live simulator is told to show it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """A body once its shape is made or loaded."""

    name: str
    config: BodyConfig
    solid: Scene
    """Its triangles and materials, in its frame O."""
    corners_m: NDArray[np.float64]
    """Corners of the bounding box along the axes of O [m], shape [8, 3]."""
    center_m: NDArray[np.float64]
    """Centre of a sphere around all points, in O [m], shape [3]."""
    radius_m: float
    """Radius of that sphere [m]."""


def make_bodies(bodies: Mapping[str, BodyConfig]) -> tuple[Body, ...]:
    """Make or load the shapes of bodies.

    Raises:
        SceneError: A file cannot be used.
    """
    return tuple(_make_body(name, config) for name, config in bodies.items())


def _make_body(name: str, config: BodyConfig) -> Body:
    solid = make_solid(config.shape, config.surface, name=name)
    points = solid.vertices[np.unique(solid.faces)].astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    center = 0.5 * (low + high)
    side = np.indices((2, 2, 2)).reshape(3, 8).T
    return Body(
        name=name,
        config=config,
        solid=solid,
        corners_m=np.where(side == 0, low, high),
        center_m=center,
        radius_m=float(np.linalg.norm(points - center, axis=1).max()),
    )


def bounding_points(bodies: Sequence[Body]) -> NDArray[np.float64]:
    """Return the corners of the bounding boxes, each in the frame O of its body [m], shape [B, 8, 3]."""
    return np.array([body.corners_m for body in bodies], dtype=np.float64).reshape(-1, 8, 3)


@wp.struct
class Motion:
    """`MotionConfig` on a device."""

    position: wp.vec3d
    orientation: wp.quatd
    velocity: wp.vec3d
    acceleration: wp.vec3d
    sway: wp.vec3d
    sway_hz: wp.float64
    sway_rad: wp.float64
    orbit_e1: wp.vec3d  # Times the radius, as `orbit_e2`
    orbit_e2: wp.vec3d
    orbit_hz: wp.float64
    orbit_rad: wp.float64
    spin: wp.vec3d


def upload_motions(
    bodies: Mapping[str, BodyConfig], device: str, *, world_count: int = 1
) -> wp.array[Motion]:
    """Return the motions of bodies on a device, world by world, shape [world B]."""
    motions = [_motion(body.motion if body.present else _ABSENT) for body in bodies.values()]
    return wp.array(world_count * motions, dtype=Motion, device=device)


def _motion(config: MotionConfig) -> Motion:
    motion = Motion()
    motion.position = wp.vec3d(*config.position_m)
    orientation = scipy.spatial.transform.Rotation.from_euler("xyz", config.rpy_rad)
    motion.orientation = wp.quatd(*orientation.as_quat())
    motion.velocity = wp.vec3d(*config.velocity_m_s)
    motion.acceleration = wp.vec3d(*config.acceleration_m_s2)
    motion.spin = wp.vec3d(*config.spin_rad_s)
    if config.sway is not None:
        motion.sway = wp.vec3d(*config.sway.amplitude_m)
        motion.sway_hz, motion.sway_rad = config.sway.frequency_hz, config.sway.phase_rad
    if config.orbit is not None:
        e1, e2 = config.orbit.radius_m * config.orbit.basis()
        motion.orbit_e1, motion.orbit_e2 = wp.vec3d(*e1), wp.vec3d(*e2)
        motion.orbit_hz, motion.orbit_rad = config.orbit.rate_hz, config.orbit.phase_rad
    return motion


@wp.func
def velocity_on_body(
    motion: Motion, stamp_ns: wp.int64, p_WO: wp.vec3d, q_WO: wp.quatd, p_W: wp.vec3d
) -> wp.vec3d:
    """Return the velocity of a point that is fixed to a body, in W [m/s]."""
    arm = wp.quat_rotate_inv(q_WO, p_W - p_WO)
    return body_velocity(motion, stamp_ns) + wp.quat_rotate(q_WO, wp.cross(motion.spin, arm))


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyPoses:
    """Poses of bodies at K instants, on a device."""

    p_WO: wp.array2d[wp.vec3d]
    """Positions [m], shape [K, B]."""
    q_WO: wp.array2d[wp.quatd]
    """Orientations, xyzw, shape [K, B]."""


def make_body_poses(instant_count: int, body_count: int, device: str) -> BodyPoses:
    """Allocate poses; they are zero until `pose_bodies` has been launched."""
    shape = (instant_count, body_count)
    return BodyPoses(
        p_WO=wp.zeros(shape, dtype=wp.vec3d, device=device),
        q_WO=wp.zeros(shape, dtype=wp.quatd, device=device),
    )


@wp.func
def body_position(motion: Motion, stamp_ns: wp.int64) -> wp.vec3d:
    """Return p_WO of a body [m]."""
    time_s = wp.float64(stamp_ns) * _S_PER_NS
    sway = _TWO_PI * motion.sway_hz * time_s + motion.sway_rad
    orbit = _TWO_PI * motion.orbit_hz * time_s + motion.orbit_rad
    return (
        motion.position
        + time_s * motion.velocity
        + wp.float64(0.5) * time_s * time_s * motion.acceleration
        + wp.sin(sway) * motion.sway
        + wp.cos(orbit) * motion.orbit_e1
        + wp.sin(orbit) * motion.orbit_e2
    )


@wp.func
def body_orientation(motion: Motion, stamp_ns: wp.int64) -> wp.quatd:
    """Return q_WO of a body."""
    return motion.orientation * quaternion_exp(wp.float64(stamp_ns) * _S_PER_NS * motion.spin)


@wp.func
def body_velocity(motion: Motion, stamp_ns: wp.int64) -> wp.vec3d:
    """Return the velocity of the origin of a body in W [m/s]; `spin` is its angular velocity in O."""
    time_s = wp.float64(stamp_ns) * _S_PER_NS
    sway_rate, orbit_rate = _TWO_PI * motion.sway_hz, _TWO_PI * motion.orbit_hz
    sway = sway_rate * time_s + motion.sway_rad
    orbit = orbit_rate * time_s + motion.orbit_rad
    return (
        motion.velocity
        + time_s * motion.acceleration
        + sway_rate * wp.cos(sway) * motion.sway
        + orbit_rate * (wp.cos(orbit) * motion.orbit_e2 - wp.sin(orbit) * motion.orbit_e1)
    )


@wp.kernel
def _pose_bodies(
    # Model:
    motions: wp.array[Motion],
    # In:
    stamps_ns: wp.array2d[wp.int64],
    slots: wp.array[int],
    instants_per_world: int,
    # Out:
    p_WO_out: wp.array2d[wp.vec3d],
    q_WO_out: wp.array2d[wp.quatd],
) -> None:
    instant, body = wp.tid()
    stamp_ns = stamps_ns[slots[instant], 0]
    motion = motions[instant / instants_per_world * p_WO_out.shape[1] + body]
    p_WO_out[instant, body] = body_position(motion, stamp_ns)
    q_WO_out[instant, body] = body_orientation(motion, stamp_ns)


def pose_bodies(
    motions: wp.array[Motion],
    stamps_ns: wp.array2d[wp.int64],
    slots: wp.array[int],
    *,
    count: int,
    poses: BodyPoses,
) -> None:
    """Write where bodies are at the first `count` of the given slots; launches one kernel.

    Motions of several worlds (`upload_motions`) share the instants out in their order.

    Args:
        motions: Of the bodies of each world, one world after the other.
        stamps_ns: Times [ns], shape [slot, >= 1], of which the first column counts (`Trace.stamps`).
        slots: Rows of `stamps_ns`, shape [>= count].
        count: Number of instants, of all worlds together.
        poses: Overwritten; its first `count` rows.
    """
    body_count = poses.p_WO.shape[1]
    worlds = motions.shape[0] // max(body_count, 1)
    wp.launch(
        _pose_bodies,
        dim=(count, body_count),
        inputs=[motions, stamps_ns, slots, max(count // max(worlds, 1), 1)],
        outputs=[poses.p_WO, poses.q_WO],
        device=motions.device,
    )


@wp.kernel
def _throw_bodies(
    # In:
    position: wp.array2d[wp.vec3d],
    velocity: wp.array2d[wp.vec3d],
    acceleration: wp.vec3d,
    # In/out:
    motions: wp.array[Motion],
) -> None:
    world, body = wp.tid()
    motion = motions[world * position.shape[1] + body]
    motion.position = position[world, body]
    motion.velocity = velocity[world, body]
    motion.acceleration = acceleration
    motions[world * position.shape[1] + body] = motion


def throw_bodies(motions: wp.array[Motion], position: Any, velocity: Any, acceleration: Vector3) -> None:
    """Let the bodies of each world fly from where they are at t = 0; launches one kernel.

    Motions are overwritten, but for what turns and swings. Position [m] and velocity in W [m/s] at t = 0 are
    device arrays of vec3d, shape [world, B]; all have one acceleration, in W [m/s^2].
    """
    inputs = [position, velocity, wp.vec3d(*acceleration)]
    wp.launch(_throw_bodies, dim=position.shape, inputs=inputs, outputs=[motions], device=motions.device)


def body_poses(
    bodies: Mapping[str, BodyConfig], stamps_ns: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return p_WO [m], shape [K, B, 3], and q_WO, xyzw, shape [K, B, 4], of bodies by name, at K stamps [ns].

    Exact to rounding: the error of a phase or angle grows as 1e-16 of its size.

    Raises:
        TypeError: Stamps are not integers.
    """
    stamps = np.asarray(stamps_ns)
    if stamps.size and not np.issubdtype(stamps.dtype, np.integer):
        raise TypeError(f"stamps_ns must be integers, got {stamps.dtype}")
    stamps = stamps.astype(np.int64).reshape(-1, 1)
    poses = make_body_poses(len(stamps), len(bodies), "cpu")
    if bodies and len(stamps):
        pose_bodies(
            upload_motions(bodies, "cpu"),
            wp.array(stamps, dtype=wp.int64, device="cpu"),
            wp.array(np.arange(len(stamps), dtype=np.int32), dtype=int, device="cpu"),
            count=len(stamps),
            poses=poses,
        )
    shape = (len(stamps), len(bodies))
    return np.array(poses.p_WO.numpy()).reshape(*shape, 3), np.array(poses.q_WO.numpy()).reshape(*shape, 4)
