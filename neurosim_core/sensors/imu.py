# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
"""Inertial measurement unit: specific force and angular rate at its mount, and their errors.

Without errors the reading is the exact kinematics of the state: with r the mount in B and w the body rate,

    a_S = R_SB (R_BW (dv/dt - g) + dw/dt x r + w x (w x r)),    w_S = R_SB w,

evaluated at the stamp, not interpolated. Errors are added per axis in this order: bias (a random walk, and
bias instability), white noise, saturation, quantisation. Their parameters have Kalibr's units and meaning; a
sample taken at rate f has white noise of standard deviation N sqrt(f), and the walk moves by K / sqrt(f) from
one to the next.

Reference: IEEE Std 952-1997, annex C, for the Allan variances: N^2 / T (white), K^2 T / 3 (walk), and 2 ln(2)
/ pi B^2 (bias instability) over averaging times T.
"""

import functools
import math
from typing import Annotated, Any, Literal

import warp as wp
from pydantic import Field, model_validator

from neurosim_core.frames import Mount
from neurosim_core.packets import ImuSample
from neurosim_core.random import normal2, random_bits, stream_id
from neurosim_core.registry import register
from neurosim_core.render.launch import kernel_variant
from neurosim_core.sensors.base import SamplerContext, StateSensorConfig
from neurosim_core.sensors.state_sampler import NonNegative, Sampling, StateSampler
from neurosim_core.settings import fill_from_preset
from neurosim_core.settings_file import read_table

CORRELATION_TIMES_S = tuple(10.0 ** (exponent / 2.0) for exponent in range(-2, 7))
"""Bias instability: correlation times of the Gauss-Markov processes whose sum is flicker noise [s], 0.1 ...
1000."""

TERMS = ("white", "walk", "instability", "saturation", "quantisation")
"""All errors that may be compiled in."""

_PROCESSES = len(CORRELATION_TIMES_S)

vec6d = wp.types.vector(length=6, dtype=wp.float64)
vec_processes = wp.types.vector(length=_PROCESSES, dtype=wp.float64)


@register("sensor", "imu")
class ImuConfig(StateSensorConfig):
    """An inertial measurement unit; without errors by default."""

    kind: Literal["imu"] = "imu"
    preset: str | None = None
    """Name of a sensor whose errors apply where none are given here: bmi088, icm20948, adis16448 (sources in
    imu_presets.yaml)."""
    mount: Mount = Mount()
    """Pose on the body."""
    rate_hz: Annotated[float, Field(gt=0.0, le=1e6)] = 400.0
    """Sample rate [Hz]."""
    accelerometer_noise_density: NonNegative = 0.0
    """White noise N of specific force [m/s^2/sqrt(Hz)]."""
    accelerometer_random_walk: NonNegative = 0.0
    """Random walk K of the bias of specific force [m/s^3/sqrt(Hz)]."""
    accelerometer_bias_instability_m_s2: NonNegative = 0.0
    """Bias instability B of specific force [m/s^2]: the Allan deviation has a floor of 0.664 B from 0.3 to
    300 s."""
    accelerometer_range_m_s2: Annotated[float, Field(gt=0.0)] | None = None
    """Largest measurable specific force along an axis, of either sign [m/s^2]; null: no limit."""
    accelerometer_resolution_m_s2: NonNegative = 0.0
    """Quantisation step of specific force [m/s^2]; 0: continuous."""
    gyroscope_noise_density: NonNegative = 0.0
    """White noise N of angular rate [rad/s/sqrt(Hz)]."""
    gyroscope_random_walk: NonNegative = 0.0
    """Random walk K of the bias of angular rate [rad/s^2/sqrt(Hz)]."""
    gyroscope_bias_instability_rad_s: NonNegative = 0.0
    """Bias instability B of angular rate [rad/s]: the Allan deviation has a floor of 0.664 B from 0.3 to 300
    s."""
    gyroscope_range_rad_s: Annotated[float, Field(gt=0.0)] | None = None
    """Largest measurable angular rate about an axis, of either sign [rad/s]; null: no limit."""
    gyroscope_resolution_rad_s: NonNegative = 0.0
    """Quantisation step of angular rate [rad/s]; 0: continuous."""

    @model_validator(mode="before")
    @classmethod
    def _fill_from_preset(cls, given: Any) -> Any:
        return fill_from_preset(given, read_table(__file__, "imu_presets"))

    packet_type = ImuSample

    def make(self, context: SamplerContext) -> StateSampler:
        """Return the sensor at work; arrays are named as the fields of an `ImuSample`."""
        vehicle, terms = context.vehicle, _terms(self)

        def memory(term: str, *axes: int) -> Any:
            shape = (vehicle.count if term in terms else 0, *axes)
            return wp.zeros(shape, dtype=vec6d, device=vehicle.device)

        return StateSampler(
            context,
            make_kernel(frozenset(terms)),
            (
                _model(self, gravity_m_s2=vehicle.config.gravity_m_s2, name=context.name),
                vehicle.arrays.acceleration,
                vehicle.arrays.angular_acceleration,
                memory("walk"),
                memory("instability", _PROCESSES),
            ),
            ImuSample,
            outputs={"specific_force": wp.vec3d, "angular_rate": wp.vec3d},
            terms=terms,
            before=vehicle.accelerate,
        )


@wp.struct
class _Model:
    """Parameters as the kernel reads them; six-vectors hold specific force, then angular rate."""

    position: wp.vec3d  # r in B
    q_SB: wp.quatd
    gravity: wp.float64
    white: vec6d
    walk: vec6d
    instability: vec6d
    process_decay: vec_processes
    limit: vec6d
    resolution: vec6d
    white_stream: wp.uint32
    walk_stream: wp.uint32
    instability_stream: wp.uint32


@wp.func
def _normal6(seed: wp.uint64, stream: wp.uint32, step: wp.int64, element: wp.int32) -> vec6d:
    a = normal2(random_bits(seed, stream, step, 3 * element))
    b = normal2(random_bits(seed, stream, step, 3 * element + 1))
    c = normal2(random_bits(seed, stream, step, 3 * element + 2))
    return vec6d(a[0], a[1], b[0], b[1], c[0], c[1])


@functools.cache
def make_kernel(terms: frozenset[str]) -> Any:
    """Return the kernel that computes only the given errors, some of `TERMS`."""

    @kernel_variant(__name__, *sorted(terms))
    def measure(
        model: _Model,
        acceleration: wp.array[wp.vec3d],
        angular_acceleration: wp.array[wp.vec3d],
        walk_bias: wp.array[vec6d],
        processes: wp.array2d[vec6d],
        at: Sampling,
        slot: int,
        # Out:
        specific_force_out: wp.array2d[wp.vec3d],
        angular_rate_out: wp.array2d[wp.vec3d],
    ):
        world = wp.tid()
        if at.active[world] == 0:
            return
        w = at.motion.body_rate[world]
        up = wp.vec3d(wp.float64(0.0), wp.float64(0.0), model.gravity)
        force = wp.quat_rotate_inv(at.motion.orientation[world], acceleration[world] + up)
        force += wp.cross(angular_acceleration[world], model.position)
        force += wp.cross(w, wp.cross(w, model.position))
        force = wp.quat_rotate(model.q_SB, force)
        rate = wp.quat_rotate(model.q_SB, w)
        reading = vec6d(force[0], force[1], force[2], rate[0], rate[1], rate[2])

        seed = at.seeds[world]
        k = at.sample[world]
        if wp.static("walk" in terms):
            bias = vec6d()
            if k > wp.int64(0):
                bias = walk_bias[world] + wp.cw_mul(model.walk, _normal6(seed, model.walk_stream, k, 0))
            walk_bias[world] = bias
            reading += bias
        if wp.static("instability" in terms):
            process_count = processes.shape[1]  # no constant: unrolled, it compiles four times as long
            for process in range(process_count):
                drive = wp.cw_mul(model.instability, _normal6(seed, model.instability_stream, k, process))
                value = drive  # stationary from the first sample on
                if k > wp.int64(0):
                    decay = model.process_decay[process]
                    value = decay * processes[world, process]
                    value += wp.sqrt(wp.float64(1.0) - decay * decay) * drive
                processes[world, process] = value
                reading += value
        if wp.static("white" in terms):
            reading += wp.cw_mul(model.white, _normal6(seed, model.white_stream, k, 0))
        for axis in range(6):
            if wp.static("saturation" in terms):
                reading[axis] = wp.clamp(reading[axis], -model.limit[axis], model.limit[axis])
            if wp.static("quantisation" in terms):
                step = model.resolution[axis]
                if step > wp.float64(0.0):
                    reading[axis] = step * wp.rint(reading[axis] / step)

        at.sample[world] = k + wp.int64(1)
        specific_force_out[slot, world] = wp.vec3d(reading[0], reading[1], reading[2])
        angular_rate_out[slot, world] = wp.vec3d(reading[3], reading[4], reading[5])

    return measure


def _terms(config: ImuConfig) -> tuple[str, ...]:
    limited = config.accelerometer_range_m_s2 is not None or config.gyroscope_range_rad_s is not None
    present = {
        "white": config.accelerometer_noise_density or config.gyroscope_noise_density,
        "walk": config.accelerometer_random_walk or config.gyroscope_random_walk,
        "instability": config.accelerometer_bias_instability_m_s2 or config.gyroscope_bias_instability_rad_s,
        "saturation": limited,
        "quantisation": config.accelerometer_resolution_m_s2 or config.gyroscope_resolution_rad_s,
    }
    return tuple(term for term, needed in present.items() if needed)


def _model(config: ImuConfig, *, gravity_m_s2: float, name: str) -> Any:
    def six(accelerometer: float, gyroscope: float, scale: float = 1.0) -> Any:
        return vec6d(*(3 * [scale * accelerometer] + 3 * [scale * gyroscope]))

    rate_hz = config.rate_hz
    # Gauss-Markov processes with log-spaced times and equal variances s^2 have the spectrum s^2 / (2 f
    # ln(ratio)) between their corners; flicker noise of instability B has B^2 / (2 pi f)
    ratio = CORRELATION_TIMES_S[1] / CORRELATION_TIMES_S[0]
    share = math.sqrt(math.log(ratio) / math.pi)
    model = _Model()
    model.position = wp.vec3d(*config.mount.position_m)
    model.q_SB = wp.quat_inverse(wp.quatd(*config.mount.quaternion()))
    model.gravity = gravity_m_s2
    model.white = six(config.accelerometer_noise_density, config.gyroscope_noise_density, math.sqrt(rate_hz))
    model.walk = six(config.accelerometer_random_walk, config.gyroscope_random_walk, 1.0 / math.sqrt(rate_hz))
    model.instability = six(
        config.accelerometer_bias_instability_m_s2, config.gyroscope_bias_instability_rad_s, share
    )
    model.process_decay = vec_processes(*(math.exp(-1.0 / (rate_hz * time)) for time in CORRELATION_TIMES_S))
    model.limit = six(
        math.inf if config.accelerometer_range_m_s2 is None else config.accelerometer_range_m_s2,
        math.inf if config.gyroscope_range_rad_s is None else config.gyroscope_range_rad_s,
    )
    model.resolution = six(config.accelerometer_resolution_m_s2, config.gyroscope_resolution_rad_s)
    model.white_stream = stream_id(f"{name}/imu/white")
    model.walk_stream = stream_id(f"{name}/imu/walk")
    model.instability_stream = stream_id(f"{name}/imu/instability")
    return model
