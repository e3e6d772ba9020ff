# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,valid-type,call-overload,assignment"
"""Adaptive sampling in time: which ticks of an event camera's clock have to be rendered.

Between two renders log radiance is taken as linear in time, which is good as long as nothing moves far across
the pixels. The rule of ESIM renders again after

    t_{k+1} - t_k = lambda_v / max_x |V(x; t_k)|

where V is the motion field [px/s] of the scene seen from the moving camera, and lambda_v the displacement
allowed between two renders [px]. Here the flight is known before the look, so the motion field is not
extrapolated over the whole interval. With x_i(t) the pixel in which point i of the scene is seen, tick k is
rendered if

    max_i |x_i(t_{k+1}) - x_i(t_last)| > max_displacement_px

where t_last is the last tick that was rendered and i runs over points that are visible at t_last or at
t_{k+1}. So it is rendered if to leave it out would let something move too far by the next tick. The pose at
t_{k+1} is that of the vehicle at t_k, moved on by the twist that it has there: the choice needs no future
command. That is exact up to half an acceleration times the square of one tick.

The points are what a coarse grid of rays hits, cast at t_last: one ray for each square of PROBE_SPACING_PX,
shifted from render to render by a low-discrepancy sequence, and the corners of the picture, where rotation
and approach move fastest. A ray that hits nothing gives a point at infinity, which moves with rotation only.

What a ray hits of a moving body is a point of the body, and moves with it: where the body will be is a
function of time. The corners of the bounding boxes of bodies count as well, whether something hides them or
not, if the box overlaps the picture and the corner is no further outside of it than the picture is large.

It pays where a flight has slow and fast parts (docs/decisions/adaptive-sampling.md).

Limit: an object of the scene that no ray hits is not seen to move. It is narrower than the spacing, and it
moves at most by f |t| / z px relative to the far background, for the translation t of the camera between two
renders and its distance z. As the grid shifts, it is found sooner or later while it is in view.

Reference: Rebecq, Gehrig, Scaramuzza (2018), ESIM: an Open Event Camera Simulator, section 3.2 (adaptive
sampling by the maximum displacement between two successive frames).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.clock import NS_PER_S, Rate
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.launch import launch_split
from neurosim_core.render.scene_arrays import SceneArrays
from neurosim_core.runtime.cuda import Fence, HostCopy, HostInput
from neurosim_core.scene.bodies import bounding_points, make_body_poses, pose_bodies, upload_motions
from neurosim_core.sensors.displacement_kernels import (
    Pinhole,
    Rule,
    carry_row,
    cast_probes,
    compare_bodies,
    compare_probes,
    load_poses,
)

PROBE_SPACING_PX = 16
"""Distance between the rays that look for what moves [px]: a 256th of the rays of a render."""

_BLOCK = 64
"""Ticks that are chosen from together. On CUDA all pairs of them are compared at once; on a CPU those from a
render on, when it has been chosen."""
_SPLIT_MIN = 1 << 14
"""Probes to be cast or compared, times ticks, from which on all cores of a CPU are worth the trouble."""
_CHUNK_ON_CUDA = 64
"""Probes that one thread compares there."""
_SHIFT = (0.7548776662466927, 0.5698402909980532)
"""Steps of the low-discrepancy sequence of Roberts (2018), R2: powers of the inverse plastic number."""


class DisplacementRule:
    """Chooses the ticks to be rendered; remembers the last one, and what was seen there.

    What it chooses depends on the flight and on the ticks that must be rendered, not on how ticks are cut
    into calls of `choose`.

    Attributes:
        coarse_count: Ticks of the last `choose` from which to the next something moves further than allowed:
            the clock is too slow to keep the bound there.
    """

    def __init__(
        self,
        arrays: SceneArrays,
        lens: PinholeConfig,
        *,
        max_displacement_px: float,
        rate: Rate,
        p_BC: wp.vec3d,
        q_BC: wp.quatd,
        motions: Any = None,
    ) -> None:
        """Allocate the buffers.

        Args:
            arrays: The scene on a device.
            lens: Lens of the camera.
            max_displacement_px: How far a point may move between two renders [px].
            rate: The clock whose ticks are chosen from.
            p_BC: Position of the camera on the body [m].
            q_BC: Orientation of the camera's optical frame against the body, xyzw.
            motions: Of the bodies, device array of `scene.bodies.Motion`; None: as the scene has them.
        """
        self.coarse_count = 0
        self._limit_px = max_displacement_px
        self._rate = rate
        self._mount = (p_BC, q_BC)
        self._device = device = arrays.device
        self._on_cpu = wp.get_device(device).is_cpu
        rows = _BLOCK + 1
        columns = math.ceil(lens.width / PROBE_SPACING_PX) + 2  # one beyond each border
        self._probe_count = columns * (math.ceil(lens.height / PROBE_SPACING_PX) + 2) + 4

        def zeros(shape: Any, dtype: Any) -> Any:
            return wp.zeros(shape, dtype=dtype, device=device)

        pinhole, rule = Pinhole(), Rule()
        pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy = lens.intrinsics()
        pinhole.width, pinhole.height = lens.width, lens.height
        rule.lens, rule.mesh = pinhole, arrays.mesh_id
        rule.columns, rule.spacing = columns, float(PROBE_SPACING_PX)
        rule.p_WC, rule.p_next_WC = zeros(rows, wp.vec3d), zeros(rows, wp.vec3d)
        rule.q_WC, rule.q_next_WC = zeros(rows, wp.quatd), zeros(rows, wp.quatd)
        rule.points = zeros((rows, self._probe_count), wp.vec4d)
        rule.seen = zeros((rows, self._probe_count), wp.vec3d)
        # On CUDA row 0 is compared before it is cast
        rule.owner = wp.full(rule.points.shape, -1, dtype=int, device=device)
        self._rule = rule
        self._add_bodies(arrays, rows, motions)
        self._moved = rule.moved = zeros((rows, rows), float)
        self._moved_on_host = HostCopy(self._moved)
        self._slots, self._step_s = zeros(_BLOCK, int), zeros(_BLOCK, wp.float64)
        shifts = rule.shifts = zeros(rows, wp.vec2)
        self._inputs = [HostInput(array) for array in (self._slots, self._step_s, shifts)]
        self._done = Fence(device)
        self._started = False
        self._last_ns = 0
        self._measured: set[int] = set()

    def _add_bodies(self, arrays: SceneArrays, rows: int, motions: Any) -> None:
        """Take over the bodies of a scene, if it has any."""
        moving = arrays.bodies
        self._body_count = 0
        if moving is None:
            return
        self._body_count = len(moving.bodies)
        if motions is None:
            motions = upload_motions({body.name: body.config for body in moving.bodies}, self._device)
        self._motions = motions
        self._body_poses = make_body_poses(rows + 1, self._body_count, self._device)
        self._body_rows: Any = wp.array(np.arange(rows + 1, dtype=np.int32), dtype=int, device=self._device)
        self._stamps = HostInput(wp.zeros((rows + 1, 1), dtype=wp.int64, device=self._device))
        self._rule.body_mesh = moving.data.mesh
        self._rule.corners = wp.array(bounding_points(moving.bodies), dtype=wp.vec3d, device=self._device)
        self._rule.p_WO, self._rule.q_WO = self._body_poses.p_WO, self._body_poses.q_WO

    def begin_again(self) -> None:
        """Have the next tick rendered, whatever has moved."""
        self._started = False

    def choose(
        self, states: Any, slots: Sequence[int], stamps_ns: Sequence[int], forced: Sequence[bool]
    ) -> list[int]:
        """Return which ticks are to be rendered, as indices into `slots`, and wait for them.

        Args:
            states: Where the flight of world 0 is (`TraceArrays.states`), float64, shape [slot, >= 1, >= 13].
            slots: Slots of consecutive ticks of the clock.
            stamps_ns: Their stamps [ns], later than those of the call before.
            forced: Whether a tick is rendered in any case; the very first always is.
        """
        self.coarse_count = 0
        chosen: list[int] = []
        for begin in range(0, len(slots), _BLOCK):
            block = slice(begin, begin + _BLOCK)
            self._load(states, slots[block], stamps_ns[block])
            found = [begin + tick for tick in self._choose(forced[block])]
            self._last_ns = stamps_ns[found[-1]] if found else self._last_ns
            chosen += found
        return chosen

    def _choose(self, forced: Sequence[bool]) -> list[int]:
        """Return which ticks of a block to render, and keep what is seen at the last of them."""
        count = len(forced)
        if not self._on_cpu:
            self._measure(1, count, 0, count + 1, 0, count + 1)
        chosen: list[int] = []
        last = 0
        for tick, must in enumerate(forced, start=1):
            if must or not self._started or self._moved_px(last, tick, count) > self._limit_px:
                chosen.append(tick - 1)
                last = tick
                self._started = True
        self.coarse_count += sum(self._moved_px(t + 1, t + 1, count) > self._limit_px for t in chosen)
        if last > 0:
            inputs = [last, self._rule]
            wp.launch(carry_row, dim=self._probe_count, inputs=inputs, device=self._device)
        return chosen

    def _load(self, states: Any, slots: Sequence[int], stamps_ns: Sequence[int]) -> None:
        """Bring the poses of a block to the device."""
        count = len(slots)
        first = self._rate.first_tick(stamps_ns[0])
        ends_ns = [self._rate.stamp_ns(first + index + 1) for index in range(count)]
        of_slots, of_steps, of_shifts = (given.rows for given in self._inputs)
        of_slots[:count] = slots
        of_steps[:count] = (np.array(ends_ns) - np.array(stamps_ns)) / NS_PER_S
        of_shifts[1 : count + 1] = np.outer(np.arange(first, first + count), _SHIFT) % 1.0
        for given in self._inputs:
            given.upload()
        inputs = [*self._mount, states, self._slots, self._step_s, self._rule]
        wp.launch(load_poses, dim=count, inputs=inputs, device=self._device)
        if self._body_count > 0:
            self._stamps.rows[: count + 2, 0] = [self._last_ns, *stamps_ns, ends_ns[-1]]
            self._stamps.upload()
            pose_bodies(
                self._motions, self._stamps.array, self._body_rows, count=count + 2, poses=self._body_poses
            )
        self._moved.zero_()
        self._measured = set()

    def _moved_px(self, row: int, tick: int, count: int) -> float:
        """Return the largest displacement from a render in a row to the tick after another row [px]."""
        if self._on_cpu and row not in self._measured:
            self._measure(row, int(row > 0), row, 1, row, count + 1 - row)
            self._measured.add(row)
        return float(self._moved_on_host.view(row, 1)[0, tick])

    def _measure(
        self, cast_row: int, cast_count: int, row: int, row_count: int, tick: int, tick_count: int
    ) -> None:
        """Cast the probes of some rows, compare those of some rows with some ticks, and wait."""
        pairs = row_count * tick_count
        chunk = self._probe_count if self._on_cpu else _CHUNK_ON_CUDA
        compared = [row, tick, tick_count]
        if cast_count > 0:
            self._launch(cast_probes, cast_count, self._probe_count, [cast_row])
        self._launch(compare_probes, pairs, -(-self._probe_count // chunk), [*compared, chunk])
        if self._body_count > 0:
            self._launch(compare_bodies, pairs, self._body_count, compared)
        self._moved_on_host.fetch(row, row_count)
        self._done.set()
        self._done.wait()

    def _launch(self, kernel: Any, times: int, thread_count: int, inputs: Sequence[int]) -> None:
        """Launch so many threads so many times; on a CPU all cores take them if they look at many probes."""
        launch_split(
            kernel,
            dim=times * thread_count,
            inputs=inputs,
            outputs=[self._rule],
            device=self._device,
            thread_count=None if times * self._probe_count >= _SPLIT_MIN else 1,
        )
