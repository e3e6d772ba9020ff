# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type,valid-type,assignment,no-untyped-def"
"""The magnetometer: the field of the Earth, as the settings give it, bent by the iron of the vehicle.

    m_S = A R_SW b_W + h + errors, with A the soft iron and h the hard iron.

Reference: Gebre-Egziabher, Elkaim, Powell, Parkinson (2006), Calibration of strapdown magnetometers in
magnetic field domain, eq. (2).
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.frames import Mount, Vector3
from neurosim_core.packets import FieldSpec, Packet
from neurosim_core.registry import register
from neurosim_core.sensors.base import RateHz, SamplerContext, StateSensorConfig
from neurosim_core.sensors.state_sampler import ErrorConfig, Motion, StateSampler, make_reader


@dataclass(frozen=True, kw_only=True, eq=False)
class MagneticField(Packet):
    """The reading of a magnetometer, in its own frame S."""

    field: Annotated[NDArray[np.float64], FieldSpec(3, unit="T", frame="sensor")]
    """Flux density [T], shape [3]."""


@register("sensor", "magnetometer")
class MagnetometerConfig(StateSensorConfig):
    """A magnetometer, without magnetic disturbances and errors by default."""

    kind: Literal["magnetometer"] = "magnetometer"
    rate_hz: RateHz = 100.0
    """Reading rate [Hz]."""
    mount: Mount = Mount()
    """Pose on the body."""
    earth_field_t: Vector3 = (1.3e-6, 21.4e-6, -43.4e-6)
    """Field in W: east, north, up [T]. A calculator of the World Magnetic Model says it for a place and a
    date, with z down; the default is about that of central Europe."""
    hard_iron_t: Vector3 = (0.0, 0.0, 0.0)
    """Field of magnets on the vehicle, in S [T]."""
    soft_iron: tuple[Vector3, Vector3, Vector3] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Matrix by which iron on the vehicle distorts the field, as rows, in S."""
    errors: ErrorConfig = ErrorConfig()
    """In T, such as {white: 3e-7, walk: 1e-9, resolution: 1.5e-7}. The resolution is that of the compass in
    the ICM-20948, 0.15 uT (TDK InvenSense, data sheet DS-000189 1.3, table 3, which gives no noise)."""

    packet_type = MagneticField

    def make(self, context: SamplerContext) -> StateSampler:
        """Return the sensor at work."""
        model = _Model()
        model.field, model.offset = wp.vec3d(*self.earth_field_t), wp.vec3d(*self.hard_iron_t)
        model.matrix = wp.mat33d(np.array(self.soft_iron) @ self.mount.rotation().inv().as_matrix())
        errors = {"field": self.errors}
        return make_reader(context, _read_field, model, errors, MagneticField, rate_hz=self.rate_hz)


@wp.struct
class _Model:
    field: wp.vec3d
    matrix: wp.mat33d  # A R_SB
    offset: wp.vec3d


@wp.func
def _read_field(model: _Model, motion: Motion, world: int, output: int) -> wp.vec3d:
    return model.matrix * wp.quat_rotate_inv(motion.orientation[world], model.field) + model.offset
