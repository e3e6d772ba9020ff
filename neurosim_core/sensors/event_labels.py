# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
# ruff: noqa: SIM102, UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning)
"""The truth of each event: what its pixel sees when it fires, and why it fires.

For each event a ray is cast through the centre of its pixel, at its time, from the pose between the entries
of the history of the flight, and against bodies where they are then. What nobody asked for is not computed.

The cause of an event is what moves its pixel most when it fires: *leak*, where the reference falls faster
than light rises; *shot noise* and *hot pixel*, for events of the spontaneous process; *threshold noise*, for
the first passage of a Brownian motion whose noise crosses a threshold sooner than its drift would; else
*signal*.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.packets import Events, FieldSpec, as_numpy
from neurosim_core.render.launch import launch_split
from neurosim_core.render.projection import LensData, make_lens_data, velocity_projector
from neurosim_core.runtime.cuda import BufferPool, PooledBuffer, size_class
from neurosim_core.scene.bodies import Motion, body_orientation, body_position, velocity_on_body
from neurosim_core.scene.labels import label_scenes, warn_of_patterns
from neurosim_core.sensors.base import FrameContext
from neurosim_core.sensors.event_noise_model import CAUSE_BITS, CAUSES
from neurosim_core.vehicle.history import History, motion_at

_FAR_M = wp.constant(1.0e9)
_WORDS = 5
"""Numbers of 32 bits that the labels of an event take."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelledEvents(Events):
    """Events with their truth; what was not asked for is empty."""

    depth: Annotated[NDArray[np.float32], FieldSpec("depth", unit="m")]
    """Planar z of what the pixel sees at the time of the event [m], inf: nothing."""
    flow: Annotated[NDArray[np.float32], FieldSpec("flow", 2, unit="px/s")]
    """How fast that moves in the picture: column and row [px/s]."""
    instance: Annotated[NDArray[np.int32], FieldSpec("instance")]
    """Which object it is, -1: none."""
    semantic: Annotated[NDArray[np.int32], FieldSpec("semantic")]
    """Of which class it is, 0: unlabelled, -1: nothing."""
    cause: Annotated[NDArray[np.uint8], FieldSpec("cause")]
    """Why the pixel fired, 0: signal, 1: leak, 2: shot noise, 3: hot pixel, 4: threshold noise."""
    labels: Annotated[str, FieldSpec(constant=True)]
    """What labels mean, as JSON: {"instances": [[name, class], ...], "classes": [...], "causes": [...]}."""


@wp.struct
class _Labels:
    """Where labels go: parts of one block of memory, in this order."""

    flow: wp.array2d[float]
    depth: wp.array[float]
    instance: wp.array[int]
    semantic: wp.array[int]


@wp.struct
class _Model:
    column_shift: int
    lens: LensData
    rays: wp.array2d[wp.vec3]
    p_BC: wp.vec3d
    q_BC: wp.quatd
    mesh: wp.uint64
    face_instance: wp.array[int]
    class_of: wp.array[int]
    motions: wp.array[Motion]
    body_mesh: wp.array[wp.uint64]
    body_sphere: wp.array[wp.vec4]
    body_face: wp.array[int]


@functools.cache
def _make_kernel(lens_kind: str, labels: frozenset[str], has_bodies: bool) -> Any:
    project_velocity = velocity_projector(lens_kind) if "flow" in labels else None
    name = "_".join((lens_kind, *sorted(labels), "bodies" if has_bodies else "still"))

    @wp.kernel(module=wp.get_module("neurosim_core.sensors.event_labels." + name), enable_backward=False)
    def label_events(
        first: int,
        # Model:
        model: _Model,
        # In:
        history: History,
        flown: wp.array[wp.int64],
        t_us: wp.array[wp.int64],
        x: wp.array[wp.uint16],
        first_x: int,
        y: wp.array[wp.uint16],
        first_y: int,
        # Out:
        out: _Labels,
    ):
        event = first + wp.tid()
        stamp_ns = wp.int64(1000) * t_us[event]
        at = motion_at(history, 0, flown[0] - wp.int64(1), stamp_ns)
        p_WC = at.position + wp.quat_rotate(at.orientation, model.p_BC)
        q_WC = at.orientation * model.q_BC
        col = int(x[first_x + event]) >> model.column_shift
        ray_C = wp.normalize(wp.vec3d(model.rays[int(y[first_y + event]), col]))
        ray_W = wp.quat_rotate(q_WC, ray_C)
        face = int(-1)
        body = int(-1)
        r = _FAR_M
        query = wp.mesh_query_ray(model.mesh, wp.vec3(p_WC), wp.vec3(ray_W), _FAR_M)
        if query.result:
            face = query.face
            r = query.t
        if wp.static(has_bodies):
            for index in range(model.body_mesh.shape[0]):
                p_WO = body_position(model.motions[index], stamp_ns)
                q_WO = body_orientation(model.motions[index], stamp_ns)
                p_O = wp.vec3(wp.quat_rotate_inv(q_WO, p_WC - p_WO))
                ray_O = wp.vec3(wp.quat_rotate_inv(q_WO, ray_W))
                sphere = model.body_sphere[index]
                to_center = wp.vec3(sphere[0], sphere[1], sphere[2]) - p_O
                along = wp.dot(to_center, ray_O)
                beside = to_center - along * ray_O
                if along > -sphere[3] and wp.dot(beside, beside) < sphere[3] * sphere[3]:
                    met = wp.mesh_query_ray(model.body_mesh[index], p_O, ray_O, r)
                    if met.result:
                        face = model.body_face[index] + met.face
                        r = met.t
                        body = index
        if wp.static("depth" in labels):
            out.depth[event] = wp.where(face >= 0, r * float(ray_C[2]), wp.inf)
        if wp.static("instance" in labels or "semantic" in labels):
            number = int(-1)
            label = int(-1)
            if face >= 0:
                number = model.face_instance[face]
                if wp.static("semantic" in labels):
                    label = model.class_of[number]
            if wp.static("instance" in labels):
                out.instance[event] = number
            if wp.static("semantic" in labels):
                out.semantic[event] = label
        if wp.static("flow" in labels):
            w_C = wp.quat_rotate_inv(model.q_BC, at.body_rate)
            p_C = ray_C
            v_C = -wp.cross(w_C, ray_C)
            if face >= 0:
                p_C = wp.float64(r) * ray_C
                arm = wp.cross(at.body_rate, model.p_BC)
                v_W = -(at.velocity + wp.quat_rotate(at.orientation, arm))
                if wp.static(has_bodies):
                    if body >= 0:
                        p_WO = body_position(model.motions[body], stamp_ns)
                        q_WO = body_orientation(model.motions[body], stamp_ns)
                        p_W = p_WC + wp.float64(r) * ray_W
                        v_W += velocity_on_body(model.motions[body], stamp_ns, p_WO, q_WO, p_W)
                v_C = wp.quat_rotate_inv(q_WC, v_W) - wp.cross(w_C, p_C)
            rate = project_velocity(model.lens, p_C, v_C)
            for axis in range(2):
                out.flow[event, axis] = wp.where(rate[2] == wp.float64(0.0), wp.nan, float(rate[axis]))

    return label_events


class EventLabels:
    """Adds the truth to events of one camera: `launch` with all of a cut, then `add` to packet after packet.

    Args:
        labels: What to add.
        classes: As of `SemanticSensorConfig`.
        context: The camera; its history goes back as far as a packet does.
        has_cause: Columns are eight times the column plus the cause.
    """

    def __init__(
        self,
        labels: Sequence[str],
        classes: Mapping[str, Sequence[str]] | None,
        context: FrameContext,
        *,
        has_cause: bool,
    ) -> None:
        self._labels = frozenset(labels)
        self._geometry = self._labels - {"cause"}
        self._has_cause = has_cause
        self._device: Any = wp.get_device(context.device)
        self._history = context.history
        meaning: dict[str, Any] = {"causes": CAUSES} if "cause" in labels else {}
        if self._geometry:
            self._kernel = self._make_model(classes, context, meaning)
            self._flown: Any = wp.zeros(1, dtype=wp.int64, device=self._device)
            self._pool = BufferPool(self._device) if self._device.is_cuda else None
            self._memory: Any = None
            self._block: PooledBuffer | None = None
        self._rows = np.zeros(0, np.float32)
        self._count = self._taken = 0
        self._meaning = json.dumps(meaning, separators=(",", ":"))

    def _make_model(
        self, classes: Mapping[str, Sequence[str]] | None, context: FrameContext, meaning: dict[str, Any]
    ) -> Any:
        """Set what the kernel reads, add what labels mean, and return the kernel."""
        scene, lens, device = context.scene, context.lens, self._device
        if not hasattr(scene, "mesh_id"):
            raise ValueError(f"labels of {context.name}: only the renderer 'warp' has them")
        model = self._model = _Model()
        model.column_shift = CAUSE_BITS if self._has_cause else 0
        model.rays = wp.array(lens.ray_table(), dtype=wp.vec3, device=device)
        if "flow" in self._labels:
            model.lens = make_lens_data(lens, device)
        model.p_BC, model.q_BC = context.p_BC, context.q_BC
        model.mesh, model.face_instance = scene.mesh_id, scene.data.face_instance
        if scene.bodies is not None:
            bodies = scene.bodies
            model.motions, model.body_mesh = context.motions, bodies.data.mesh
            model.body_sphere, model.body_face = bodies.data.sphere, bodies.data.first_face
        if {"instance", "semantic"} & self._geometry:
            warn_of_patterns(context.name, [scene], classes)
            known = label_scenes([scene], classes)
            numbers = np.array([number for _, number in known.instances[0]], np.int32)
            model.class_of = wp.array(numbers, dtype=int, device=device)
            meaning |= {"instances": known.instances[0], "classes": known.classes}
        return _make_kernel(getattr(lens, "kind", ""), self._geometry, scene.bodies is not None)

    def record_flight(self) -> None:
        """Note how far the flight is known; launches only.

        The vehicle may be ahead, and go on while `launch` looks back.
        """
        if self._geometry:
            wp.copy(self._flown, self._history.count)

    def launch(self, count: int, t: Any, x: Any, y: Any, *, first_x: int = 0, first_y: int = 0) -> None:
        """Launch the search for the truth of events, and its copy to the host.

        Args:
            count: How many events there are.
            t: Their times [us], int64, shape [>= count].
            x: Their columns [px], uint16, from `first_x` on.
            y: Their rows [px], uint16, from `first_y` on.
            first_x: Where the columns begin in `x`.
            first_y: Where the rows begin in `y`.
        """
        self._count, self._taken = count, 0
        if not self._geometry or count == 0:
            return
        size = _WORDS * count
        if self._pool is None or self._memory is None or self._memory.size < size:
            room = size if self._pool is None else size_class(2 * size)
            self._memory = wp.empty(room, dtype=float, device=self._device)
        out, columns = _Labels(), self._memory[:size]
        out.flow, out.depth = columns[: 2 * count].reshape((count, 2)), columns[2 * count : 3 * count]
        out.instance, out.semantic = (columns[k * count : (k + 1) * count].view(int) for k in (3, 4))
        launch_split(
            self._kernel,
            dim=count,
            inputs=[self._model, self._history, self._flown, t, x, first_x, y, first_y],
            outputs=[out],
            device=self._device,
        )
        if self._pool is None:
            self._rows = columns.numpy()
        else:
            self._block = self._pool.acquire(4 * size)
            place: Any = wp.array(ptr=columns.ptr, dtype=wp.uint8, shape=4 * size, device=self._device)
            wp.copy(self._block.array, place, count=4 * size)

    def add(self, events: Events) -> LabelledEvents:
        """Return the next of the events that were launched with their truth; the device has finished."""
        if self._geometry and self._block is not None and self._pool is not None:
            self._rows = self._pool.hand_out(self._block, 4 * _WORDS * self._count).view(np.float32)
            self._block = None
        first, end = self._taken, self._taken + len(events)
        self._taken = end

        def column(name: str, place: int, dtype: Any = np.float32) -> NDArray[Any]:
            rows = self._rows[place * self._count :].view(dtype)
            return rows[first:end] if name in self._labels else np.zeros(0, dtype)

        values = {field.name: getattr(events, field.name) for field in fields(events)}
        causes = np.zeros(len(events) if "cause" in self._labels else 0, np.uint8)
        if self._has_cause:
            causes = (as_numpy(events.x) & ((1 << CAUSE_BITS) - 1)).astype(np.uint8)
            values["x"] = as_numpy(events.x) >> CAUSE_BITS
        flow = self._rows[: 2 * self._count].reshape(-1, 2)[first:end]
        return LabelledEvents(
            **values,
            depth=column("depth", 2),
            flow=flow if "flow" in self._labels else np.zeros((0, 2), np.float32),
            instance=column("instance", 3, np.int32),
            semantic=column("semantic", 4, np.int32),
            cause=causes,
            labels=self._meaning,
        )
