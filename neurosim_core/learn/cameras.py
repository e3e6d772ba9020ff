# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,valid-type,assignment"
"""Randomisation of the camera and the light of episodes: mount, lens, brightness."""

# No `from __future__ import annotations`: Warp needs the annotations of kernels as objects.

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from pydantic import TypeAdapter

from neurosim_core.learn.episodes import EPISODE, signed, within
from neurosim_core.learn.randomisation import Randomisation
from neurosim_core.random import random_bits, uniform4
from neurosim_core.render.lenses import AnyLens
from neurosim_core.sim.simulation import Simulation

wp.set_module_options({"enable_backward": False})

LENS_COUNT = 64
"""Lenses that episodes draw theirs from."""


def draw_lenses(settings: Mapping[str, Any], drawn: Randomisation) -> tuple[list[Any], NDArray[np.float32]]:
    """Return the lenses that there are in episodes, the same in each call, and what they differ in.

    Returns `LENS_COUNT` lenses, none where all are as the settings say; and factor of the focal length,
    shifts of the optical axis along rows and columns (share of the width), and k1 of each, shape [lens, 4].
    """
    bounds = np.array(
        [
            drawn.focal_factor,
            *[(-drawn.axis_shift, drawn.axis_shift)] * 2,
            drawn.distortion,
        ]
    )
    nominal = np.array([[1.0, 0.0, 0.0, 0.0]])
    if (bounds == nominal.T).all():
        return [], nominal.astype(np.float32)
    lens = TypeAdapter(AnyLens).validate_python(dict(settings))
    kinds = ("pinhole", "radtan") if drawn.distortion != (0.0, 0.0) else ("pinhole", "radtan", "rational")
    if lens.kind not in kinds:
        raise ValueError(
            f"episodes cannot draw lenses like one of kind {lens.kind!r}, only {', '.join(kinds)}"
        )
    fx, fy, cx, cy = lens.intrinsics()
    own = lens.model_dump(exclude={"horizontal_fov_rad"})
    table = bounds[:, 0] + np.ptp(bounds, axis=1) * np.random.default_rng(0).random((LENS_COUNT, 4))
    lenses = []
    for factor, right, down, k1 in table.tolist():
        focal = {"fx": factor * fx, "fy": factor * fy}
        axis = {"cx": cx + right * lens.width, "cy": cy + down * lens.width}
        distorts: dict[str, Any] = {}
        if drawn.distortion != (0.0, 0.0):
            first, *others = lens.distortion_coefficients or (0.0,) * 4
            distorts = {"kind": "radtan", "distortion": (first + k1, *others)}
        lenses.append(TypeAdapter(AnyLens).validate_python(own | focal | axis | distorts))
    return lenses, table.astype(np.float32)


@wp.struct
class _Nominal:
    """The camera and the light as the settings say, and the bounds of what is drawn about them."""

    p_BC: wp.vec3d
    q_BC: wp.quatd
    dark_floor: wp.array[wp.float32]
    exposure: wp.array[wp.float32]
    mount_m: wp.float32
    mount_rad: wp.float32
    log_light: wp.vec2
    lens_count: wp.int32


@wp.kernel
def _vary(
    # Model:
    nominal: _Nominal,
    # In:
    mask: wp.array[wp.bool],
    seeds: wp.array[wp.uint64],
    # Out:
    p_BC_out: wp.array[wp.vec3d],
    q_BC_out: wp.array[wp.quatd],
    lens_out: wp.array[wp.int32],
    dark_floor_out: wp.array[wp.float32],
    exposure_out: wp.array[wp.float32],
    parameters_out: wp.array2d[wp.float32],
) -> None:
    world = wp.tid()
    if not mask[world]:
        return
    u = uniform4(random_bits(seeds[world], EPISODE, wp.int64(7), 0))
    v = uniform4(random_bits(seeds[world], EPISODE, wp.int64(7), 1))
    moved = nominal.mount_m * signed(u)
    turned = nominal.mount_rad * signed(v)
    light = wp.exp(within(nominal.log_light, u[3]))
    d = wp.vec3d(wp.float64(moved[0]), wp.float64(moved[1]), wp.float64(moved[2]))
    r = wp.vec3d(wp.float64(turned[0]), wp.float64(turned[1]), wp.float64(turned[2]))
    p_BC_out[world] = nominal.p_BC + d
    q_BC_out[world] = nominal.q_BC
    if nominal.mount_rad > 0.0:
        q_BC_out[world] = wp.quat_from_axis_angle(wp.normalize(r), wp.length(r)) * nominal.q_BC
    if nominal.lens_count > 0:
        lens_out[world] = wp.min(int(v[3] * float(nominal.lens_count)), nominal.lens_count - 1)
    if dark_floor_out.shape[0] > 0:
        dark_floor_out[world] = nominal.dark_floor[world] / light
        exposure_out[world] = nominal.exposure[world] * light
    for axis in range(3):
        parameters_out[world, axis] = moved[axis]
        parameters_out[world, 3 + axis] = turned[axis]
    parameters_out[world, 6] = light


class CameraDraws:
    """Draws mount, lens and light at the begin of episodes; launches only.

    `sim`: the simulation of the camera, made with `lenses` of `draw_lenses`, and with `per_world_light` if
    the light is drawn. `lens_table`: parameters of these lenses, from `draw_lenses`.
    """

    def __init__(
        self, sim: Simulation, camera: str, drawn: Randomisation, lens_table: NDArray[np.float32]
    ) -> None:
        self._device = sim.device
        self._mount = sim.optics(camera)
        p_BC, q_BC = (rows.numpy()[0] for rows in self._mount[:2])
        self._light: list[Any] = [wp.empty(0, dtype=float, device=sim.device)] * 2
        if drawn.light_factor != (1.0, 1.0):
            self._light = [sim.light(name) for name in ("dark_floor", "exposure")]
        self._as_tensors = [wp.to_torch(array) for array in self._light if array.shape[0]]
        self._lens_table = torch.as_tensor(lens_table, device=wp.device_to_torch(sim.device))
        self._nominal = nominal = _Nominal()
        nominal.p_BC, nominal.q_BC = wp.vec3d(*p_BC), wp.quatd(*q_BC)
        nominal.dark_floor, nominal.exposure = (wp.clone(array) for array in self._light)
        nominal.mount_m, nominal.mount_rad = drawn.mount_m, drawn.mount_rad
        nominal.log_light = wp.vec2(*np.log(drawn.light_factor))
        nominal.lens_count = len(lens_table) if len(lens_table) > 1 else 0
        self._rows: Any = wp.zeros((sim.count, 7), dtype=float, device=sim.device)

    def vary(self, mask: Any, seeds: Any) -> None:
        """Draw for the worlds of a mask, bool, [N], by the seeds of their episodes, uint64, [N]."""
        wp.launch(
            _vary,
            dim=len(seeds),
            inputs=[self._nominal, mask, seeds],
            outputs=[*self._mount, *self._light, self._rows],
            device=self._device,
        )

    def parameters(self) -> dict[str, torch.Tensor]:
        """Return what was drawn, by name of `Randomisation`, [N, ...]."""
        rows, lens = wp.to_torch(self._rows), self._lens_table[wp.to_torch(self._mount[2]).long()]
        return {
            "mount_m": rows[:, :3].clone(),
            "mount_rad": rows[:, 3:6].clone(),
            "light_factor": rows[:, 6].clone(),
            "focal_factor": lens[:, 0],
            "axis_shift": lens[:, 1:3],
            "distortion": lens[:, 3],
        }
