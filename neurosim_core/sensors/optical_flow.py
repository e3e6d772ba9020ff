# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,no-any-return,untyped-decorator"
# ruff: noqa: SIM102, UP018  (nested wp.static branches and typed literals have a meaning in kernels)
"""Optical flow: where in the picture what each pixel sees was, will be, or how fast it moves there.

The point that the ray of a pixel hits is fixed to what it is a part of, the scene or a moving body, and
projected with the poses of the other time, through the lens. So flow is exact whatever moves and turns. A
pixel that sees nothing sees a direction: its flow is that of the rotation of the camera.

Whether something hides it at the other time is known for most pixels from their own picture: nothing is on
the way from the other camera to the point where the picture shows only what is further than that way, and
near the camera where no surface is as near. Elsewhere a second ray is cast, from there to the point.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

import functools
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.clock import to_ns
from neurosim_core.packets import FieldSpec, Packet
from neurosim_core.registry import register
from neurosim_core.render.camera import Lens
from neurosim_core.render.launch import launch_split
from neurosim_core.render.projection import LensData, make_lens_data, projector, velocity_projector
from neurosim_core.render.ray_times import RayTimes
from neurosim_core.scene.bodies import Motion, body_velocity, make_body_poses
from neurosim_core.sensors.base import CameraConfig, PictureContext, PictureSensorConfig, PictureViews

VISIBLE, HIDDEN, OUTSIDE = 0, 1, 2
"""Values of the mask: seen at both times; hidden by something at the other time; outside the picture then."""
_FAR_M = wp.constant(1.0e9)
_NEAR_RATIO = wp.constant(1.0 - 3.0e-4)
"""What hides a point is nearer than it by this ratio: rays and points are float32."""
_CLEARANCE_M = wp.constant(0.5)
"""No surface is looked for that is further from a camera than this."""
_HORIZON_M = wp.constant(1.0e5)
"""Where a way to the sky ends [m]."""
_WAY_PX = wp.constant(64.0)
"""Longest way in a picture that is followed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OpticalFlow(Packet):
    """The motion of what pixels see, in the picture."""

    display: ClassVar[str] = "flow"

    data: Annotated[NDArray[np.float32], FieldSpec("H", "W", 2, unit="px")]
    """Column and row: displacement [px] over the window, or with a window of 0 velocity [px/s]; nan where the
    lens does not see the point at the other time; shape [H, W, 2]."""
    mask: Annotated[NDArray[np.uint8], FieldSpec("H", "W")]
    """0: seen at both times; 1: hidden at the other time; 2: outside the picture then, shape [H, W]."""
    from_ns: int
    """Time of the picture whose pixels these are [ns]."""
    to_ns: int
    """The other time [ns]; of a velocity the same."""
    encoding: Annotated[str, FieldSpec(constant=True)] = "32FC2"
    """What a pixel of `data` is, named as in ROS."""


@dataclass(frozen=True)
class _Before:
    """All rays are cast before the stamp."""

    span_ns: int

    @property
    def window_ns(self) -> int:
        """How long before the stamp rays are cast [ns]."""
        return self.span_ns

    def times(self, lens: Lens, sample_count: int) -> RayTimes:
        """Return one time for all rays."""
        instant = np.zeros((1, lens.height * lens.width), np.int32)
        return RayTimes(np.array([-self.span_ns], np.int64), instant, 1)


@register("sensor", "optical_flow")
class OpticalFlowConfig(CameraConfig, PictureSensorConfig):
    """A camera that measures optical flow, exactly, of scene and moving bodies, through its lens."""

    kind: Literal["optical_flow"] = "optical_flow"
    window_s: Annotated[float, Field(ge=0.0, le=10.0)] | None = None
    """Time between the two pictures [s], the later of which is at the stamp; null: a period; 0: velocity at
    the stamp, in px/s."""
    direction: Literal["backward", "forward"] = "backward"
    """backward: pixels are those of the later picture, and flow leads to where what they see was in the
    earlier one; forward: pixels are those of the earlier picture. Velocities have no direction."""
    occlusion: bool = True
    """Find out what is hidden at the other time. Where the pixel's own picture does not tell, a second ray
    does; what is thinner than a pixel may be overlooked."""

    packet_type = OpticalFlow
    output: ClassVar[str] = "range"

    @property
    def window_ns(self) -> int:
        """Time between the two pictures [ns]."""
        return to_ns(1.0 / self.rate_hz if self.window_s is None else self.window_s)

    @property
    def outputs(self) -> frozenset[str]:
        """Ranges, and which body it is."""
        return frozenset(["range", "instance"])

    @property
    def timing(self) -> _Before | None:
        """Forward flow casts its rays at the earlier time."""
        return _Before(self.window_ns) if self.direction == "forward" and self.window_ns else None

    @property
    def pose_offset_ns(self) -> int | None:
        """The other time."""
        return None if not self.window_ns else 0 if self.timing else -self.window_ns

    @property
    def needs_twist(self) -> bool:
        """Velocities need it."""
        return not self.window_ns

    def make_process(self, context: PictureContext) -> "FlowProcess":
        """Return what makes flow of ranges."""
        return FlowProcess(self, context)

    def packet(self, picture: NDArray[Any], **header: Any) -> OpticalFlow:
        """Return flow and mask; the picture has both, shape [H, W, 3]."""
        ends = (header["stamp_ns"], header["stamp_ns"] - self.window_ns)
        start_ns, other_ns = ends if self.direction == "backward" else ends[::-1]
        return OpticalFlow(
            data=np.ascontiguousarray(picture[..., :2]),
            mask=picture[..., 2].astype(np.uint8),
            from_ns=start_ns,
            to_ns=other_ns,
            **header,
        )


@wp.struct
class _Model:
    pixel_count: int
    width: int
    height: int
    stride: int
    scene_instances: int
    rays: wp.array2d[wp.vec3]
    lenses: wp.array[LensData]
    lens_of_world: wp.array[int]
    mesh: wp.array[wp.uint64]
    scene_of_world: wp.array[int]
    motions: wp.array[Motion]
    body_mesh: wp.array[wp.uint64]
    clearance: wp.array[float]


@wp.struct
class Views:
    """`PictureViews` at one time."""

    p_WC: wp.array[wp.vec3]
    q_WC: wp.array[wp.quat]
    stamps: wp.array2d[wp.int64]
    p_WO: wp.array2d[wp.vec3d]
    q_WO: wp.array2d[wp.quatd]


@wp.func
def is_hidden(
    mesh: wp.uint64,
    bodies: wp.array[wp.uint64],
    views: Views,
    view: int,
    p_W: wp.vec3d,
    ray_W: wp.vec3d,
    far: float,
    free: bool,
) -> bool:
    """Return whether something is on the ray from the camera, nearer than a distance [m].

    Where it is `free`, the scene is not, and bodies may be.
    """
    if not free:
        if wp.mesh_query_ray_anyhit(mesh, wp.vec3(p_W), wp.vec3(ray_W), far):
            return True
    for body in range(bodies.shape[0]):
        q_WO = views.q_WO[view, body]
        p_O = wp.vec3(wp.quat_rotate_inv(q_WO, p_W - views.p_WO[view, body]))
        ray_O = wp.vec3(wp.quat_rotate_inv(q_WO, ray_W))
        if wp.mesh_query_ray_anyhit(bodies[body], p_O, ray_O, far):
            return True
    return False


@wp.kernel(enable_backward=False)
def _measure_clearance(
    # Model:
    model: _Model,
    # In:
    instant_count: int,
    here: Views,
):
    """Write the distance from the camera within which there is no surface of the scene [m]."""
    world = wp.tid() // instant_count
    view = world * model.stride + wp.tid() % instant_count
    mesh = model.mesh[model.scene_of_world[world]]
    clearance = _CLEARANCE_M
    found = wp.mesh_query_point_no_sign(mesh, here.p_WC[view], _CLEARANCE_M)
    if found.result:
        nearest = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
        clearance = wp.length(nearest - here.p_WC[view])
    model.clearance[view] = _NEAR_RATIO * clearance


@wp.func
def _is_way_free(
    model: _Model,
    lens: LensData,
    ranges: wp.array2d[float],
    other: wp.vec3,
    point: wp.vec3,
    clearance: float,
) -> bool:
    """Return whether the picture of a pinhole camera shows that a way is free, but for its last pixel.

    Args:
        model: Of the picture.
        lens: Of the camera.
        ranges: The picture [m].
        other: Where the way begins, in C [m].
        point: Where it ends, in C [m].
        clearance: Distance from the camera within which there is no surface [m].
    """
    length = wp.length(point - other)
    along = (point - other) / length
    middle = wp.dot(other, along)
    inside = middle * middle + clearance * clearance - wp.dot(other, other)
    leaving = wp.sqrt(wp.max(inside, 0.0)) - middle
    if wp.dot(other, other) >= clearance * clearance:
        return False
    if leaving >= length:
        return True
    begin = other + leaving * along
    if begin[2] <= 0.0:
        return False
    scale = wp.vec2(float(lens.fx), float(lens.fy))
    center = wp.vec2(float(lens.cx), float(lens.cy))
    here = wp.vec3(point[0] / point[2], point[1] / point[2], 1.0)
    step = wp.vec3(begin[0] / begin[2], begin[1] / begin[2], 1.0) - here
    count = wp.max(wp.abs(step[0] * scale[0]), wp.abs(step[1] * scale[1]))
    if count > _WAY_PX:
        return False
    nearness = 1.0 / point[2]
    for k in range(1, int(wp.ceil(count))):
        share = float(k) / count
        toward = here + share * step
        away = wp.length(toward) / (nearness + share * (1.0 / begin[2] - nearness))
        left = int(wp.floor(toward[0] * scale[0] + center[0] - 0.5))
        top = int(wp.floor(toward[1] * scale[1] + center[1] - 0.5))
        if left < 0 or top < 0 or left + 1 >= model.width or top + 1 >= model.height:
            return False
        least = wp.min(
            wp.min(ranges[top, left], ranges[top, left + 1]),
            wp.min(ranges[top + 1, left], ranges[top + 1, left + 1]),
        )
        if _NEAR_RATIO * least <= away:
            return False
    return True


def views_at(views: PictureViews, device: Any) -> Any:
    """Return the poses of one time for a kernel."""
    bodies = views.bodies or _no_bodies(str(device))
    at = Views()
    at.p_WC, at.q_WC, at.stamps = views.p_WC, views.q_WC, views.stamps
    at.p_WO, at.q_WO = bodies.p_WO, bodies.q_WO
    return at


@functools.cache
def _no_bodies(device: str) -> Any:
    return make_body_poses(0, 0, device)


def lens_kind(context: PictureContext) -> str:
    """Return the kind of the lenses of all worlds.

    Raises:
        ValueError: There are several.
    """
    kinds = {getattr(lens, "kind", "") for lens in context.lenses}
    if len(kinds) > 1:
        raise ValueError(f"{context.name}: worlds have lenses of several kinds, {sorted(kinds)}")
    return str(kinds.pop())


@functools.cache
def _make_kernel(kind: str, terms: tuple[str, ...]) -> Any:
    project = projector(kind)
    project_velocity = velocity_projector(kind)
    name = "_".join((kind, *terms)).replace(" ", "_")

    @wp.kernel(module=wp.get_module("neurosim_core.sensors.optical_flow." + name), enable_backward=False)
    def measure_flow(
        first: int,
        # Model:
        model: _Model,
        # In:
        instant_count: int,
        image_slot: wp.array[int],
        active: wp.array[int],
        here: Views,
        there: Views,
        twist: wp.array[wp.spatial_vectord],
        ranges: wp.array3d[float],
        instance: wp.array3d[int],
        # Out:
        flow_out: wp.array3d[wp.vec3],
    ):
        index = first + wp.tid()
        pixel = index % model.pixel_count
        view = index // model.pixel_count
        world = view // instant_count
        view = world * model.stride + view % instant_count
        slot = image_slot[view]
        if slot < 0:
            return
        if active.shape[0] > 0:
            if active[world] == 0:
                return
        row = pixel // model.width
        col = pixel % model.width
        lens = model.lenses[model.lens_of_world[world]]
        ray_C = wp.normalize(wp.vec3d(model.rays[model.lens_of_world[world], pixel]))
        p_WC = wp.vec3d(here.p_WC[view])
        q_WC = wp.normalize(wp.quatd(here.q_WC[view]))
        ray_W = wp.quat_rotate(q_WC, ray_C)
        r = wp.float64(ranges[slot, row, col])
        found = ranges[slot, row, col] < _FAR_M
        body = -1
        if wp.static("bodies" in terms):
            body = wp.max(-1, instance[slot, row, col] - model.scene_instances)
        if wp.static("velocity" in terms):
            motion = twist[view]
            w_C = wp.vec3d(motion[3], motion[4], motion[5])
            p_C = ray_C
            v_C = -wp.cross(w_C, ray_C)
            if found:
                p_C = r * ray_C
                v_W = -wp.vec3d(motion[0], motion[1], motion[2])
                if wp.static("bodies" in terms):
                    if body >= 0:
                        q_WO = here.q_WO[view, body]
                        p_O = wp.quat_rotate_inv(q_WO, p_WC + r * ray_W - here.p_WO[view, body])
                        turning = wp.quat_rotate(q_WO, wp.cross(model.motions[body].spin, p_O))
                        v_W += body_velocity(model.motions[body], here.stamps[view, 0]) + turning
                v_C = wp.quat_rotate_inv(q_WC, v_W) - wp.cross(w_C, p_C)
            rate = project_velocity(lens, p_C, v_C)
            flow_out[slot, row, col] = wp.vec3(float(rate[0]), float(rate[1]), 0.0)
            if rate[2] == wp.float64(0.0):
                flow_out[slot, row, col] = wp.vec3(wp.nan, wp.nan, 2.0)
            return
        p_WT = wp.vec3d(there.p_WC[view])  # T: the camera at the other time
        q_WT = wp.normalize(wp.quatd(there.q_WC[view]))
        d_W = ray_W
        if found:
            p_W = p_WC + r * ray_W
            if wp.static("bodies" in terms):
                if body >= 0:
                    p_O = wp.quat_rotate_inv(here.q_WO[view, body], p_W - here.p_WO[view, body])
                    p_W = there.p_WO[view, body] + wp.quat_rotate(there.q_WO[view, body], p_O)
            d_W = p_W - p_WT
        seen = project(lens, wp.quat_rotate_inv(q_WT, d_W))
        if seen[2] == wp.float64(0.0):
            flow_out[slot, row, col] = wp.vec3(wp.nan, wp.nan, 2.0)
            return
        u = float(seen[0] - wp.float64(col) - wp.float64(0.5))
        v = float(seen[1] - wp.float64(row) - wp.float64(0.5))
        mask = 0.0
        inside = seen[0] >= wp.float64(0.0) and seen[0] < wp.float64(model.width)
        inside = inside and seen[1] >= wp.float64(0.0) and seen[1] < wp.float64(model.height)
        if not inside:
            mask = 2.0
        elif wp.static("occlusion" in terms):
            far = _FAR_M
            if found:
                far = _NEAR_RATIO * float(wp.length(d_W))
            free = bool(False)
            if wp.static(kind == "pinhole"):
                if body < 0:
                    free = _is_way_free(
                        model,
                        lens,
                        ranges[slot],
                        wp.vec3(wp.quat_rotate_inv(q_WC, p_WT - p_WC)),
                        wp.min(ranges[slot, row, col], _HORIZON_M) * wp.vec3(ray_C),
                        model.clearance[view],
                    )
            mesh = model.mesh[model.scene_of_world[world]]
            if is_hidden(mesh, model.body_mesh, there, view, p_WT, wp.normalize(d_W), far, free):
                mask = 1.0
        flow_out[slot, row, col] = wp.vec3(u, v, mask)

    return measure_flow


class FlowProcess:
    """Makes flow of what the rays of a camera hit.

    Attributes:
        picture: Flow (column, row) and the mask, vec3, shape [M, H, W].
        terms: What is computed.
    """

    def __init__(self, config: OpticalFlowConfig, context: PictureContext) -> None:
        source, lenses = context.source, context.lenses
        present = {
            "bodies": context.motions is not None,
            "velocity": not config.window_ns,
            "occlusion": config.occlusion and bool(config.window_ns),
        }
        self.terms = tuple(term for term, needed in present.items() if needed)
        self._context = context
        self._device = device = source.device
        self.picture = wp.zeros(source.shape, dtype=wp.vec3, device=device)
        model = self._model = _Model()
        model.height, model.width = source.shape[1:]
        model.pixel_count = model.width * model.height
        model.stride = context.stride
        rays = np.stack([lens.ray_table().reshape(-1, 3) for lens in lenses])
        model.rays = wp.array(rays, dtype=wp.vec3, device=device)
        self._lenses = [make_lens_data(lens, device) for lens in lenses]
        model.lenses = wp.array(self._lenses, dtype=LensData, device=device)
        lens_rows = list(context.lens_of_world)
        model.lens_of_world = wp.array(lens_rows, dtype=int, device=device)
        model.clearance = wp.zeros(len(lens_rows) * context.stride, dtype=float, device=device)
        mesh = np.array([scene.mesh_id for scene in context.scenes], np.uint64)
        model.mesh = wp.array(mesh, dtype=wp.uint64, device=device)
        model.scene_of_world = context.scene_of_world
        if context.motions is not None:
            scene = context.scenes[0]
            model.scene_instances = len(scene.scene.instance_names)
            model.motions, model.body_mesh = context.motions, scene.bodies.mesh
        self._kernel = _make_kernel(lens_kind(context), self.terms)

    def launch(self, views: PictureViews) -> None:
        """Make the flow of the pictures of a batch; launches only."""
        world_count = views.image_slot.shape[0] // self._context.stride
        sources = self._context.sources
        here = views_at(views, self._device)
        if "occlusion" in self.terms:
            wp.launch(
                _measure_clearance,
                dim=world_count * views.instant_count,
                inputs=[self._model, views.instant_count, here],
                device=self._device,
            )
        launch_split(
            self._kernel,
            dim=world_count * views.instant_count * self._model.pixel_count,
            inputs=[
                self._model,
                views.instant_count,
                views.image_slot,
                views.active,
                here,
                views_at(views.then or views, self._device),
                views.twist,
                sources["range"],
                sources["instance"],
            ],
            outputs=[self.picture],
            device=self._device,
        )
