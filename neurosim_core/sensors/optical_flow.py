# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
# ruff: noqa: SIM102, UP018  (nested wp.static branches and typed literals have a meaning in kernels)
"""Optical flow: where in the picture what each pixel sees was, will be, or how fast it moves there.

The point that the ray of a pixel hits is fixed to what it is a part of, the scene or a moving body, and
projected with the poses of the other time, through the lens. So flow is exact whatever moves and turns. A
pixel that sees nothing sees a direction: its flow is that of the rotation of the camera.

Whether something hides it at the other time is known for most pixels from their own picture (`occlusion.py`).
Elsewhere a second ray is cast, from there to the point: on CUDA, for all such pixels together.
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
from neurosim_core.render.launch import kernel_variant
from neurosim_core.render.projection import projector, velocity_projector
from neurosim_core.render.ray_times import SweepTiming
from neurosim_core.scene.bodies import make_body_poses, velocity_on_body
from neurosim_core.sensors.base import CameraConfig, PictureContext, PictureSensorConfig, PictureViews
from neurosim_core.sensors.occlusion import (
    NEAR_RATIO,
    TILE,
    Surroundings,
    is_hidden_by_bodies,
    is_way_free,
    make_surroundings,
    measure_clearance,
    measure_tiles,
)
from neurosim_core.sensors.pixel_process import Batch, PixelProcess, Views, element_of, make_rays, make_views

VISIBLE, HIDDEN, OUTSIDE = (wp.constant(value) for value in (0, 1, 2))
"""Values of the mask: seen at both times; hidden by something at the other time; outside the picture then."""
_FAR_M = wp.constant(1.0e9)
_LISTED_THREADS = 2**17
"""Threads that cast the rays of unresolved pixels: more than any device runs at a time."""


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
    """Encoding of a pixel of `data`, named as in ROS."""


@register("sensor", "optical_flow")
class OpticalFlowConfig(CameraConfig, PictureSensorConfig):
    """A camera that measures the exact optical flow of scene and moving bodies, through its lens."""

    kind: Literal["optical_flow"] = "optical_flow"
    window_s: Annotated[float, Field(ge=0.0, le=10.0)] | None = None
    """Time between the two pictures [s], of which the later one is at the stamp; null: one period; 0:
    velocity at the stamp, in px/s."""
    direction: Literal["backward", "forward"] = "backward"
    """backward: flow of the pixels of the later picture, to where they see the same point in the earlier one;
    forward: flow of the pixels of the earlier picture. Velocities have no direction."""
    occlusion: bool = True
    """Whether points that are hidden at the other time are marked. Where the pixel's own picture does not
    tell, a second ray does; what is thinner than a pixel may be overlooked."""

    packet_type = OpticalFlow
    is_overlay = True
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
    def timing(self) -> SweepTiming | None:
        """Forward flow casts its rays at the earlier time."""
        return SweepTiming(self.window_ns) if self.direction == "forward" and self.window_ns else None

    @property
    def look_back_ns(self) -> int:
        """To the earlier picture."""
        return self.window_ns

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
    around: Surroundings
    rays: wp.array3d[wp.vec3]
    ranges: wp.array3d[float]
    instance: wp.array3d[int]
    there: Views  # at the other time
    twist: wp.array[wp.spatial_vectord]
    # Of each view, of C with respect to T, the camera at the other time:
    R_TC: wp.array[wp.mat33d]
    p_TC: wp.array[wp.vec3d]
    p_CT: wp.array[wp.vec3]
    clearance: wp.array[float]
    # Where the picture does not tell what is hidden:
    nearest: wp.array3d[float]
    unresolved: wp.array[int]
    unresolved_count: wp.array[int]
    thread_count: int


@wp.kernel(enable_backward=False)
def _relate_views(model: _Model, focal_px: float, batch: Batch):
    world = wp.tid() // batch.instant_count
    view = world * batch.stride + wp.tid() % batch.instant_count
    here = batch.here
    there = model.there
    q_WC = wp.normalize(wp.quatd(here.q_WC[view]))
    q_WT = wp.normalize(wp.quatd(there.q_WC[view]))
    p_W = wp.vec3d(here.p_WC[view]) - wp.vec3d(there.p_WC[view])
    model.R_TC[view] = wp.quat_to_matrix(wp.quat_inverse(q_WT) * q_WC)
    model.p_TC[view] = wp.quat_rotate_inv(q_WT, p_W)
    model.p_CT[view] = wp.vec3(wp.quat_rotate_inv(q_WC, -p_W))
    if focal_px > 0.0:
        mesh = model.around.mesh[batch.scene_of_world[world]]
        model.clearance[view] = measure_clearance(mesh, here.p_WC[view], model.p_CT[view], focal_px)
    if wp.tid() == 0:
        model.unresolved_count[0] = 0


@functools.cache
def _make_kernel(kind: str, terms: tuple[str, ...]) -> Any:
    project = projector(kind)
    project_velocity = velocity_projector(kind)

    @wp.func
    def measure_pixel(index: int, model: _Model, batch: Batch, flow_out: wp.array3d[wp.vec3]):
        at = element_of(batch, index)
        slot = at.slot
        if slot < 0:
            return
        row = at.row
        col = at.col
        view = at.view
        here = batch.here
        there = model.there
        ranges = model.ranges
        number = batch.lens_of_world[at.world]
        lens = model.around.lenses[number]
        ray_C = wp.vec3d(model.rays[number, row, col])
        # Rounded to float32: a step of Newton's method makes it of unit length.
        ray_C *= wp.float64(1.5) - wp.float64(0.5) * wp.dot(ray_C, ray_C)
        if wp.static("bodies" in terms or "velocity" in terms):
            p_WC = wp.vec3d(here.p_WC[view])
            q_WC = wp.normalize(wp.quatd(here.q_WC[view]))
            ray_W = wp.quat_rotate(q_WC, ray_C)
        r = wp.float64(ranges[slot, row, col])
        found = ranges[slot, row, col] < _FAR_M
        body = -1
        if wp.static("bodies" in terms):
            body = wp.max(-1, model.instance[slot, row, col] - model.around.scene_instances)
        if wp.static("velocity" in terms):
            motion = model.twist[view]
            w_C = wp.vec3d(motion[3], motion[4], motion[5])
            p_C = ray_C
            v_C = -wp.cross(w_C, ray_C)
            if found:
                p_C = r * ray_C
                v_W = -wp.vec3d(motion[0], motion[1], motion[2])
                if wp.static("bodies" in terms):
                    if body >= 0:
                        v_W += velocity_on_body(
                            model.around.motions[body],
                            here.stamps[view, 0],
                            here.p_WO[view, body],
                            here.q_WO[view, body],
                            p_WC + r * ray_W,
                        )
                v_C = wp.quat_rotate_inv(q_WC, v_W) - wp.cross(w_C, p_C)
            rate = project_velocity(lens, p_C, v_C)
            flow_out[slot, row, col] = wp.vec3(float(rate[0]), float(rate[1]), 0.0)
            if rate[2] == wp.float64(0.0):
                flow_out[slot, row, col] = wp.vec3(wp.nan, wp.nan, float(OUTSIDE))
            return
        p_T = model.R_TC[view] * ray_C  # T: the camera at the other time
        if found:
            p_T = r * p_T + model.p_TC[view]
            if wp.static("bodies" in terms):
                if body >= 0:
                    p_W = p_WC + r * ray_W
                    p_O = wp.quat_rotate_inv(here.q_WO[view, body], p_W - here.p_WO[view, body])
                    p_W = there.p_WO[view, body] + wp.quat_rotate(there.q_WO[view, body], p_O)
                    q_WT = wp.normalize(wp.quatd(there.q_WC[view]))
                    p_T = wp.quat_rotate_inv(q_WT, p_W - wp.vec3d(there.p_WC[view]))
        seen = project(lens, p_T)
        if seen[2] == wp.float64(0.0):
            flow_out[slot, row, col] = wp.vec3(wp.nan, wp.nan, float(OUTSIDE))
            return
        u = float(seen[0] - wp.float64(col) - wp.float64(0.5))
        v = float(seen[1] - wp.float64(row) - wp.float64(0.5))
        mask = int(VISIBLE)
        inside = seen[0] >= wp.float64(0.0) and seen[0] < wp.float64(ranges.shape[2])
        inside = inside and seen[1] >= wp.float64(0.0) and seen[1] < wp.float64(ranges.shape[1])
        if not inside:
            mask = int(OUTSIDE)
        elif wp.static("occlusion" in terms):
            free = bool(False)
            if wp.static("way" in terms):
                if body < 0:
                    free = is_way_free(
                        lens,
                        ranges[slot],
                        model.nearest[slot],
                        row,
                        col,
                        model.p_CT[view],
                        ranges[slot, row, col] * wp.vec3(ray_C),
                        model.clearance[view],
                    )
            p_WT = there.p_WC[view]
            way_W = wp.vec3(wp.quat_rotate(wp.quatd(there.q_WC[view]), wp.normalize(p_T)))
            far = wp.where(found, NEAR_RATIO * float(wp.length(p_T)), _FAR_M)
            if wp.static("list" in terms):
                if not free:
                    model.unresolved[wp.atomic_add(model.unresolved_count, 0, 1)] = index
            elif not free:
                if wp.mesh_query_ray_anyhit(
                    model.around.mesh[batch.scene_of_world[at.world]], p_WT, way_W, far
                ):
                    mask = int(HIDDEN)
            if wp.static("bodies" in terms):
                if is_hidden_by_bodies(model.around.body_mesh, there, view, p_WT, way_W, far):
                    mask = int(HIDDEN)
        flow_out[slot, row, col] = wp.vec3(u, v, float(mask))

    @kernel_variant(__name__, kind, *terms)
    def measure_flow(
        first: int,
        model: _Model,
        batch: Batch,
        # Out:
        flow_out: wp.array3d[wp.vec3],
    ):
        index = first + wp.tid()
        if wp.static("listed" not in terms):
            measure_pixel(index, model, batch, flow_out)
        else:
            while index < model.unresolved_count[0]:
                measure_pixel(model.unresolved[index], model, batch, flow_out)
                index += model.thread_count

    return measure_flow


class FlowProcess(PixelProcess):
    """Makes flow (column, row) and the mask, vec3, shape [M, H, W], of what the rays of a camera hit."""

    def __init__(self, config: OpticalFlowConfig, context: PictureContext) -> None:
        source = context.source
        device = source.device
        present = {
            "bodies": context.motions is not None,
            "velocity": not config.window_ns,
            "occlusion": config.occlusion and bool(config.window_ns),
        }
        terms = tuple(term for term, needed in present.items() if needed)
        model = self._model = _Model()
        kind, model.around, self._lenses = make_surroundings(context)
        model.rays = make_rays(context)
        view_count = len(context.lens_of_world) * context.stride
        for name, dtype in (("R_TC", wp.mat33d), ("p_TC", wp.vec3d), ("p_CT", wp.vec3), ("clearance", float)):
            setattr(model, name, wp.zeros(view_count, dtype=dtype, device=device))
        twist_count, view_count = (0, view_count) if config.window_ns else (view_count, 0)
        model.twist = wp.zeros(twist_count, dtype=wp.spatial_vectord, device=device)
        body_count = 0 if context.motions is None else context.motions.shape[0] // len(context.lens_of_world)
        self._there = {
            "p_WC": wp.zeros(view_count, dtype=wp.vec3, device=device),
            "q_WC": wp.zeros(view_count, dtype=wp.quat, device=device),
            "stamps": wp.zeros((view_count, 1), dtype=wp.int64, device=device),
            "bodies": make_body_poses(view_count, body_count, device),
        }
        model.there = make_views(**self._there)
        offset_ns = 0 if config.timing else -config.window_ns
        self._offsets_ns: Any = wp.array([offset_ns], dtype=wp.int64, device=device)
        model.unresolved_count = wp.zeros(1, dtype=int, device=device)
        self._focal_px, self._listed = 0.0, None
        variant = terms
        if "occlusion" in terms and kind == "pinhole":
            self._focal_px = max(float(lens.fx) for lens in self._lenses)
            tiles = (source.shape[0], *(-(-size // TILE) for size in source.shape[1:]))
            model.nearest = wp.zeros(tiles, dtype=float, device=device)
            variant = (*terms, "way")
            if wp.get_device(device).is_cuda:
                model.unresolved = wp.zeros(source.size, dtype=int, device=device)
                model.thread_count = _LISTED_THREADS
                variant, self._listed = (*variant, "list"), _make_kernel(kind, (*terms, "listed"))
        model.ranges, model.instance = context.sources["range"], context.sources["instance"]
        super().__init__(context, _make_kernel(kind, variant), model, dtype=wp.vec3, terms=terms)

    def launch(self, views: PictureViews) -> None:
        """Make the flow of the pictures of a batch; launches only."""
        if "velocity" in self.terms:
            views.compute_twists(self._model.twist)
        else:
            views.compute_poses(self._offsets_ns, **self._there)
            batch = self.batch_of(views)
            view_count = views.image_slot.shape[0] // batch.stride * views.instant_count
            inputs = [self._model, self._focal_px, batch]
            wp.launch(_relate_views, dim=view_count, inputs=inputs, device=self.device)
        if self._focal_px:
            nearest = self._model.nearest
            inputs = [self._model.ranges, nearest]
            wp.launch_tiled(measure_tiles, dim=nearest.shape, inputs=inputs, block_dim=64, device=self.device)
        super().launch(views)
        if self._listed is not None:
            self.run(self._listed, views, *self._inputs, outputs=[self.picture], dim=_LISTED_THREADS)
