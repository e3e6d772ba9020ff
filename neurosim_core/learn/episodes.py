# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,no-any-return,call-overload,valid-type"
# mypy: disable-error-code="assignment,return-value"
"""Initial states of episodes, and observations of a vehicle, in float32: drawn and written on the device.

All numbers of a world come from its own seed: nothing of a world depends on its neighbours.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels as objects.

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.learn.randomisation import Randomisation
from neurosim_core.random import normal4, random_bits, stream_id, uniform4
from neurosim_core.scene.freespace import DistanceField, FreeSpace, sample_distance
from neurosim_core.sim.observation import Observation
from neurosim_core.sim.simulation import Simulation
from neurosim_core.vehicle.aerodynamics import Airframe

wp.set_module_options({"enable_backward": False})

DRAW_COUNT = 16
"""Uniform numbers of each episode that a task may use."""
COLUMNS = {
    "position": (0, 3),
    "velocity": (3, 6),
    "orientation": (6, 10),
    "body_rate": (10, 13),
    "velocity_B": (13, 16),
    "gravity_B": (16, 19),
    "goal_B": (19, 22),
    "gyro": (22, 25),
    "gravity_measured": (25, 28),
    "clearance": (28, 29),
}
"""Columns of `Episodes.rows`."""
COLUMN_COUNT = 29

PARAMETERS = {"mass_factor": 0, "inertia_factor": 1, "drag_factor": 2, "wind_m_s": slice(3, 5)}
"""Columns of what differs between the airframes of worlds; of the wind x and y in W."""

_POINT_COUNT = 4096
EPISODE = wp.constant(wp.uint32(stream_id("learn/episode")))
"""Stream of random numbers of what episodes draw."""
_NOISE = wp.constant(wp.uint32(stream_id("learn/noise")))


@dataclass(frozen=True, kw_only=True)
class StartConfig:
    """Initial states of vehicles: anywhere in free space, with any heading."""

    clearance_m: float = 0.6
    """Least distance to the scene at the start and at the goal [m]."""
    speed_m_s: tuple[float, float] = (0.0, 0.0)
    """Range of the speed, in any direction with half of the vertical part [m/s]."""
    tilt_max_rad: float = 0.0
    """Largest tilt [rad]."""
    rate_max_rad_s: float = 0.0
    """Largest body rate about each axis [rad/s]."""
    aimed: bool = False
    """Whether heading and velocity point at the goal, levelly."""


@wp.struct
class _Start:
    speed: wp.vec2
    tilt_max: wp.float32
    rate_max: wp.float32
    aimed: wp.bool


@wp.func
def signed(u: wp.vec4) -> wp.vec4:
    """Return numbers of [0, 1) in [-1, 1)."""
    return u * 2.0 - wp.vec4(1.0, 1.0, 1.0, 1.0)


@wp.kernel
def _begin(
    # Model:
    points: wp.array2d[wp.vec3],
    goals: wp.array2d[wp.vec3],
    scene_of_world: wp.array[wp.int32],
    start: _Start,
    # In:
    mask: wp.array[wp.bool],
    again: wp.bool,
    # In/out:
    seeds: wp.array[wp.uint64],
    # Out:
    position_out: wp.array2d[wp.float64],
    velocity_out: wp.array2d[wp.float64],
    orientation_out: wp.array2d[wp.float64],
    body_rate_out: wp.array2d[wp.float64],
    goal_out: wp.array[wp.vec3],
    draws_out: wp.array2d[wp.float32],
) -> None:
    world = wp.tid()
    if not mask[world]:
        return
    seed = seeds[world]
    if not again:
        mixed = random_bits(seed, EPISODE, wp.int64(0), 0)
        seed = (wp.uint64(mixed[0]) << wp.uint64(32)) | wp.uint64(mixed[1])
    seeds[world] = seed
    scene = scene_of_world[world]
    a = uniform4(random_bits(seed, EPISODE, wp.int64(1), 0))
    b = uniform4(random_bits(seed, EPISODE, wp.int64(1), 1))
    c = signed(uniform4(random_bits(seed, EPISODE, wp.int64(1), 2)))
    index = wp.min(int(a[0] * float(points.shape[1])), points.shape[1] - 1)
    point = points[scene, index]
    goal = goals[scene, index]
    heading = 2.0 * wp.PI * a[1]
    if start.aimed:
        heading = wp.atan2(goal[1] - point[1], goal[0] - point[0])
    yaw = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), heading)
    lean = 2.0 * wp.PI * a[2]
    tilt = wp.quat_from_axis_angle(wp.vec3(wp.cos(lean), wp.sin(lean), 0.0), start.tilt_max * a[3])
    q = yaw * tilt
    z = 2.0 * b[0] - 1.0
    around = 2.0 * wp.PI * b[1]
    level = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    speed = start.speed[0] + (start.speed[1] - start.speed[0]) * b[2]
    v = wp.vec3(level * wp.cos(around), level * wp.sin(around), 0.5 * z) * speed
    if start.aimed:
        v = wp.vec3(wp.cos(heading), wp.sin(heading), 0.0) * speed
    for axis in range(3):
        position_out[world, axis] = wp.float64(point[axis])
        velocity_out[world, axis] = wp.float64(v[axis])
        body_rate_out[world, axis] = wp.float64(start.rate_max * c[axis])
    for part in range(4):
        orientation_out[world, part] = wp.float64(q[part])
    goal_out[world] = goal
    for block in range(DRAW_COUNT // 4):
        u = uniform4(random_bits(seed, EPISODE, wp.int64(3), block))
        for part in range(4):
            draws_out[world, 4 * block + part] = u[part]


@wp.func
def _write(rows: wp.array2d[wp.float32], world: int, column: int, value: wp.vec3) -> None:
    for axis in range(3):
        rows[world, column + axis] = value[axis]


@wp.kernel
def _write_rows(
    # Model:
    fields: wp.array[DistanceField],
    scene_of_world: wp.array[wp.int32],
    gyro_bias: wp.float32,
    gyro_noise: wp.float32,
    gravity_noise: wp.float32,
    # In:
    seeds: wp.array[wp.uint64],
    position: wp.array[wp.vec3d],
    velocity: wp.array[wp.vec3d],
    orientation: wp.array[wp.quatd],
    body_rate: wp.array[wp.vec3d],
    clock_ns: wp.array[wp.int64],
    goal: wp.array[wp.vec3],
    # Out:
    rows_out: wp.array2d[wp.float32],
) -> None:
    world = wp.tid()
    q = wp.quat(orientation[world])
    p = wp.vec3(position[world])
    v = wp.vec3(velocity[world])
    w = wp.vec3(body_rate[world])
    down = wp.quat_rotate_inv(q, wp.vec3(0.0, 0.0, -1.0))
    stamp = clock_ns[world]
    n = normal4(random_bits(seeds[world], _NOISE, stamp, 0))
    m = normal4(random_bits(seeds[world], _NOISE, stamp, 1))
    b = gyro_bias * signed(uniform4(random_bits(seeds[world], EPISODE, wp.int64(6), 0)))
    _write(rows_out, world, 0, p)
    _write(rows_out, world, 3, v)
    for part in range(4):
        rows_out[world, 6 + part] = q[part]
    _write(rows_out, world, 10, w)
    _write(rows_out, world, 13, wp.quat_rotate_inv(q, v))
    _write(rows_out, world, 16, down)
    _write(rows_out, world, 19, wp.quat_rotate_inv(q, goal[world] - p))
    _write(rows_out, world, 22, w + wp.vec3(b[0], b[1], b[2]) + gyro_noise * wp.vec3(n[0], n[1], n[2]))
    _write(rows_out, world, 25, down + gravity_noise * wp.vec3(m[0], m[1], m[2]))
    rows_out[world, 28] = sample_distance(fields[scene_of_world[world]], p)[0]


@wp.struct
class _Ranges:
    mass: wp.vec2
    inertia: wp.vec2
    drag: wp.vec2
    wind_max: wp.float32


@wp.func
def within(bounds: wp.vec2, u: wp.float32) -> wp.float32:
    """Return a number of [0, 1) within bounds."""
    return bounds[0] + (bounds[1] - bounds[0]) * u


@wp.kernel
def _vary_airframes(
    # Model:
    nominal: wp.array[Airframe],
    ranges: _Ranges,
    # In:
    mask: wp.array[wp.bool],
    seeds: wp.array[wp.uint64],
    # Out:
    airframes_out: wp.array[Airframe],
    parameters_out: wp.array2d[wp.float32],
) -> None:
    world = wp.tid()
    if not mask[world]:
        return
    u = uniform4(random_bits(seeds[world], EPISODE, wp.int64(5), 0))
    mass = within(ranges.mass, u[0])
    inertia = within(ranges.inertia, u[1])
    drag = within(ranges.drag, u[2])
    around = uniform4(random_bits(seeds[world], EPISODE, wp.int64(5), 1))
    speed = ranges.wind_max * u[3]
    wind = speed * wp.vec2(wp.cos(2.0 * wp.PI * around[0]), wp.sin(2.0 * wp.PI * around[0]))
    airframe = nominal[0]
    airframe.mass_inverse = airframe.mass_inverse / wp.float64(mass)
    scale = wp.float64(mass) * wp.float64(inertia)
    airframe.inertia = airframe.inertia * scale
    airframe.inertia_inverse = airframe.inertia_inverse / scale
    airframe.inertia_diagonal = airframe.inertia_diagonal * scale
    airframe.inertia_diagonal_inverse = airframe.inertia_diagonal_inverse / scale
    airframe.rotor_drag = airframe.rotor_drag * wp.float64(drag)
    airframe.parasitic_drag = airframe.parasitic_drag * wp.float64(drag)
    if ranges.wind_max > 0.0:
        airframe.wind = wp.vec3d(wp.float64(wind[0]), wp.float64(wind[1]), wp.float64(0.0))
    airframes_out[world] = airframe
    parameters_out[world, 0] = mass
    parameters_out[world, 1] = inertia
    parameters_out[world, 2] = drag
    parameters_out[world, 3] = wind[0]
    parameters_out[world, 4] = wind[1]


Routes = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Where episodes of a scene begin and where they lead to [m], shape [n, 3] each."""


def make_routes(
    spaces: Sequence[FreeSpace], given: Sequence[Routes | None], *, clearance_m: float, device: Any
) -> tuple[Any, Any]:
    """Return points where episodes begin and their goals, device arrays of vec3 [scene, n].

    `given`: of each scene; None: points in free space that are connected to each other, and lead nowhere.
    `clearance_m`: least distance to the scene [m].
    """
    ends = []
    for index, (space, routes) in enumerate(zip(spaces, given, strict=True)):
        if routes is None:
            points = space.centers(np.argwhere(space.reachable(clearance_m)))
            routes, places = (points, points), np.arange(len(points))
            chosen = np.random.default_rng(0).integers(max(len(points), 1), size=_POINT_COUNT)
        else:
            places = np.flatnonzero(np.minimum(*(space.clearance(each) for each in routes)) >= clearance_m)
            chosen = np.arange(_POINT_COUNT) % max(len(places), 1)
        if not len(places):
            raise ValueError(f"scene {index} has no free space with a clearance of {clearance_m:g} m")
        ends.append([each[places[chosen]] for each in routes])
    rows = np.array(ends, dtype=np.float32)
    starts: Any = wp.array(rows[:, 0], dtype=wp.vec3, device=device)
    goals: Any = wp.array(rows[:, 1], dtype=wp.vec3, device=device)
    return starts, goals


@wp.kernel
def _probe(
    # Model:
    fields: wp.array[DistanceField],
    scene_of_world: wp.array[wp.int32],
    probes: wp.array[wp.vec3],
    # In:
    rows: wp.array2d[wp.float32],
    # Out:
    distances_out: wp.array2d[wp.float32],
) -> None:
    world, index = wp.tid()
    q = wp.quat(rows[world, 6], rows[world, 7], rows[world, 8], rows[world, 9])
    ahead = wp.quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
    length = wp.max(wp.sqrt(ahead[0] * ahead[0] + ahead[1] * ahead[1]), 1.0e-6)
    x = ahead[0] / length
    y = ahead[1] / length
    d = probes[index]
    offset = wp.vec3(x * d[0] - y * d[1], y * d[0] + x * d[1], d[2])
    point = wp.vec3(rows[world, 0], rows[world, 1], rows[world, 2]) + offset
    distances_out[world, index] = sample_distance(fields[scene_of_world[world]], point)[0]


class Episodes:
    """Draws how the episodes of all worlds begin, and writes what is known of vehicles; launches only.

    `config`: how they begin. `routes`: of `make_routes`. `probes`: points, ahead of, to the left of and above
    the vehicle, level [m]. `drawn`: what else episodes draw.

    Attributes:
        start: Arguments of `Simulation.reset`: arrays of the device that `begin` overwrites.
        seeds: Seed of the present episode of each world, device array of uint64, shape [N].
        draws: Uniform numbers of each episode, device array of float32, shape [N, DRAW_COUNT].
        parameters: Of the airframe in each episode, device array of float32, shape [N, 5]; see `PARAMETERS`.
        rows: What is known of each vehicle, device array of float32, shape [N, COLUMN_COUNT]; see `COLUMNS`.
        distances: Distance to the scene of the probes, to a voxel [m], likewise, shape [N, K].
    """

    def __init__(
        self,
        sim: Simulation,
        config: StartConfig,
        routes: Any,
        *,
        probes: Sequence[tuple[float, float, float]],
        drawn: Randomisation,
    ) -> None:
        self._start = _Start()
        self._start.speed = wp.vec2(*config.speed_m_s)
        self._start.tilt_max = config.tilt_max_rad
        self._start.rate_max = config.rate_max_rad_s
        self._start.aimed = config.aimed
        self._sim, self._routes, self._drawn, worlds = sim, routes, drawn, sim.count

        def zeros(shape: Any, dtype: Any = wp.float32) -> Any:
            return wp.zeros(shape, dtype=dtype, device=sim.device)

        widths = {"position": 3, "velocity": 3, "orientation": 4, "body_rate": 3}
        self.start = {name: zeros((worlds, width), wp.float64) for name, width in widths.items()}
        self.seeds, self._goal = zeros(worlds, wp.uint64), zeros(worlds, wp.vec3)
        self.draws, self.rows = zeros((worlds, DRAW_COUNT)), zeros((worlds, COLUMN_COUNT))
        self.distances = zeros((worlds, len(probes)))
        self._probes: Any = wp.array(list(probes), dtype=wp.vec3, device=sim.device)
        rows = np.tile(np.array([1.0, 1.0, 1.0, 0.0, 0.0], dtype=np.float32), (worlds, 1))
        self.parameters: Any = wp.array(rows, dtype=wp.float32, device=sim.device)
        self._nominal: Any = None

    def seed(self, seed: int) -> None:
        """Let world i go on from seed + i."""
        if operator.index(seed) < 0:
            raise ValueError(f"seed must be 0 at least, got {seed}")
        self.seeds.assign(np.arange(len(self.seeds), dtype=np.uint64) + np.uint64(seed))

    def begin(self, mask: Any, *, again: bool = False) -> None:
        """Draw the next episode of the worlds of a mask, device array of bool, [N]; or the same again."""
        inputs = [*self._routes, self._sim.scene_of_world, self._start, mask, again, self.seeds]
        self._launch(_begin, inputs, [*self.start.values(), self._goal, self.draws])

    def vary_airframes(self, mask: Any) -> None:
        """Draw the airframes of the worlds of a mask: factors on those of the first call, and a wind."""
        airframes, drawn = self._sim.airframes, self._drawn
        if self._nominal is None:
            self._nominal = wp.clone(airframes[:1])
        ranges = _Ranges()
        ranges.mass, ranges.inertia = wp.vec2(*drawn.mass_factor), wp.vec2(*drawn.inertia_factor)
        ranges.drag, ranges.wind_max = wp.vec2(*drawn.drag_factor), drawn.wind_m_s
        self._launch(_vary_airframes, [self._nominal, ranges, mask, self.seeds], [airframes, self.parameters])

    def write_rows(self, observation: Observation) -> None:
        """Write what is known of all vehicles: `rows` and `distances`."""
        scenes, drawn, state = [self._sim.fields, self._sim.scene_of_world], self._drawn, observation.state
        noise = [drawn.gyro_bias_rad_s, drawn.gyro_noise_rad_s, drawn.gravity_noise]
        moving = [state.position, state.velocity, state.orientation, state.body_rate, observation.clock_ns]
        self._launch(_write_rows, [*scenes, *noise, self.seeds, *moving, self._goal], [self.rows])
        if self.distances.shape[1]:
            inputs = [*scenes, self._probes, self.rows]
            self._launch(_probe, inputs, [self.distances], dim=self.distances.shape)

    def _launch(self, kernel: Any, inputs: list[Any], outputs: list[Any], dim: Any = None) -> None:
        dim = len(self.seeds) if dim is None else dim
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._sim.device)
