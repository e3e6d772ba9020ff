# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type,valid-type,assignment"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"
"""The magnetometer: the field of the Earth, as the settings give it, bent by the iron of the vehicle.

    m_S = A R_SW b_W + h + errors, with A the soft iron and h the hard iron.

Reference: Gebre-Egziabher, Elkaim, Powell, Parkinson (2006), Calibration of strapdown magnetometers in
magnetic field domain, eq. (2).
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.frames import Mount, Vector3
from neurosim_core.packets import FieldSpec, Packet
from neurosim_core.registry import register
from neurosim_core.sensors.base import RateHz, SamplerContext, StateSensorConfig
from neurosim_core.sensors.state_sampler import (
    ErrorConfig,
    Errors,
    Motion,
    StateSampler,
    error_adder,
    make_errors,
    numbers,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class MagneticField(Packet):
    """What a magnetometer reads, in its own frame S."""

    field: Annotated[NDArray[np.float64], FieldSpec(3, unit="T", frame="sensor")]
    """Flux density [T], shape [3]."""


@register("sensor", "magnetometer")
class MagnetometerConfig(StateSensorConfig):
    """A magnetometer, without iron around it and without errors by default."""

    kind: Literal["magnetometer"] = "magnetometer"
    rate_hz: RateHz = 100.0
    """Readings a second [Hz]."""
    mount: Mount = Mount()
    """Pose on the body."""
    earth_field_t: Vector3 = (1.3e-6, 21.4e-6, -43.4e-6)
    """Field in W: east, north, up [T]. A calculator of the World Magnetic Model says it for a place and a
    date, with z down; the default is about that of central Europe."""
    hard_iron_t: Vector3 = (0.0, 0.0, 0.0)
    """What magnets on the vehicle add, in S [T]."""
    soft_iron: tuple[Vector3, Vector3, Vector3] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Rows of the matrix by which iron on the vehicle bends the field, in S."""
    errors: ErrorConfig = ErrorConfig()
    """In T, such as {white: 3e-7, walk: 1e-9, resolution: 1.5e-7}. The resolution is that of the compass in
    the ICM-20948, 0.15 uT (TDK InvenSense, data sheet DS-000189 1.3, table 3, which gives no noise)."""

    packet_type = MagneticField

    def make(self, context: SamplerContext) -> "Magnetometer":
        """Return the sensor at work."""
        return Magnetometer(self, context)


@wp.struct
class _Model:
    field: wp.vec3d
    matrix: wp.mat33d  # A R_SB
    offset: wp.vec3d
    errors: Errors


@functools.cache
def make_kernel(terms: tuple[str, ...]) -> Any:
    """Return the kernel with the given errors."""
    add_errors = error_adder(terms)

    @wp.kernel(
        module=wp.get_module("neurosim_core.sensors.magnetometer." + ("_".join(terms) or "exact")),
        enable_backward=False,
    )
    def measure(
        model: _Model,
        motion: Motion,
        seeds: wp.array[wp.uint64],
        active: wp.array[wp.int32],
        sample: wp.array[wp.int64],
        memory: wp.array2d[wp.vec3d],
        slot: int,
        field_out: wp.array2d[wp.vec3d],
    ):
        world = wp.tid()
        if active[world] == 0:
            return
        value = model.matrix * wp.quat_rotate_inv(motion.orientation[world], model.field) + model.offset
        k = sample[world]
        value = add_errors(model.errors, seeds[world], k, value, memory, world, 0)
        sample[world] = k + wp.int64(1)
        field_out[slot, world] = value

    return measure


class Magnetometer(StateSampler):
    """The magnetometers of all worlds."""

    def __init__(self, config: MagnetometerConfig, context: SamplerContext) -> None:
        model, terms = _Model(), config.errors.terms()
        model.field, model.offset = wp.vec3d(*config.earth_field_t), wp.vec3d(*config.hard_iron_t)
        model.matrix = wp.mat33d(np.array(config.soft_iron) @ config.mount.rotation().inv().as_matrix())
        model.errors = make_errors(config.errors, rate_hz=config.rate_hz, name=f"{context.name}/field")
        super().__init__(context, make_kernel(terms), model, outputs={"field": wp.vec3d}, terms=terms)

    def packet(self, rows: Mapping[str, NDArray[Any]], **header: Any) -> MagneticField:
        """Return one sample as a packet."""
        return MagneticField(field=numbers(rows, "field"), **header)
