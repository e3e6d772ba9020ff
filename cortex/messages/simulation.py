"""Messages to control a simulator, and its status."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated

from cortex.message_types import Array, Int64, UInt32, UInt64, Unit, message


@message(name="cortex/CommandRanges")
class CommandRanges:
    """The largest commands that one vehicle accepts."""

    refuse: bool
    """Whether the simulator refuses commands out of range; else it clamps them."""
    rotor_speed_max_rad_s: Annotated[float, Unit("rad/s")]
    """Speed of a rotor, from 0 [rad/s]."""
    thrust_max_n: Annotated[float, Unit("N")]
    """Collective thrust, from 0 [N]."""
    speed_max_m_s: Annotated[float, Unit("m/s")]
    """Length of a velocity [m/s]."""
    body_rate_max_rad_s: Annotated[float, Unit("rad/s")]
    """Length of a body rate, and size of a yaw rate [rad/s]."""
    position_max_m: Annotated[float, Unit("m")]
    """Size of each coordinate of a position [m]."""


@message(name="cortex/Simulation")
class Simulation:
    """What is simulated; for those who come later, too.

    Published when a simulator begins, and again by the same publisher when settings have been changed.
    """

    config: str
    """All settings that hold now, as YAML."""
    version: str
    """Version of the simulator."""
    vehicles: list[str]
    """Names of the vehicles; their topics begin with them."""
    mode: str
    """"lockstep" or "streaming"."""
    control_rate_hz: Annotated[float, Unit("Hz")]
    """Control periods a second [Hz]."""
    thrust_max_n: Annotated[list[float], Unit("N")] = field(default_factory=list)
    """Thrust of each vehicle with all rotors at their highest speed, in the order of `vehicles` [N]."""
    command_ranges: list[CommandRanges] = field(default_factory=list)
    """What each vehicle can be asked for, in the order of `vehicles`."""


@message(name="cortex/Trigger")
class Trigger:
    """A request that needs no arguments: pause, resume."""

    sequence: UInt64 = 0
    """Counts the requests of one sender from 0."""


@message(name="cortex/Reset")
class Reset:
    """Begin again at stamp 0; what is not given is as configured."""

    seed: Int64 | None = None
    """Seed of all noise."""
    vehicle: str = ""
    """Which vehicle starts elsewhere; empty: the only one."""
    position: Annotated[Array["float64", 3], Unit("m", frame="world")] | None = None
    """p_WB [m], shape [3]."""
    orientation: Array["float64", 4] | None = None
    """q_WB, xyzw, shape [4]."""
    velocity: Annotated[Array["float64", 3], Unit("m/s", frame="world")] | None = None
    """v_WB in the world frame [m/s], shape [3]."""
    body_rate: Annotated[Array["float64", 3], Unit("rad/s", frame="body")] | None = None
    """w_WB in the body frame [rad/s], shape [3]."""


@message(name="cortex/Step")
class Step:
    """Let a paused run go on for some control periods; the answer comes when they are over."""

    count: UInt32 = 1
    """Control periods."""
    timeout_s: Annotated[float, Unit("s")] = 60.0
    """For how long the answer is waited for [s]; then the run stops where it is. At most 60."""


@message(name="cortex/SimulatorReply")
class SimulatorReply:
    """What a simulator answers to every request."""

    accepted: bool
    """Whether it did what was asked."""
    reason: str
    """Why not; empty if it did."""
    stamp_ns: Annotated[int, Unit("ns")]
    """Simulation time [ns]."""
    phase: str
    """As in `SimulatorStatus`."""


@message(name="cortex/SensorStatus")
class SensorStatus:
    """One sensor of a vehicle."""

    vehicle: str
    """Name of the vehicle."""
    name: str
    """Name of the sensor."""
    active: bool
    """Whether it is published or recorded; a camera that is not is not rendered either."""
    subscriber_count: UInt32
    """Who listens."""
    published_count: UInt64
    """Messages that were published, or only recorded, since the beginning of the run."""
    dropped_count: UInt64
    """Frames that were not rendered, because the machine was too slow, and messages that a link lost."""
    injected_lost_count: UInt64 = 0
    """Of these, messages that a link lost as configured."""
    undelivered_count: UInt64 = 0
    """Besides, messages that a reliable subscriber lost, as it held up the simulator for too long."""
    late_p99_ns: Annotated[int, Unit("ns")] = 0
    """How late by the wall clock messages were published, 99th percentile since the status before [ns].

    After the time at which they were to arrive; 0 when time is not paced, or nothing was published."""


@message(name="cortex/VehicleStatus")
class VehicleStatus:
    """How one vehicle is commanded."""

    name: str
    """Name of the vehicle."""
    command_mode: str
    """Mode of the command that holds; empty before the first one."""
    command_count: UInt64
    """Commands taken over."""
    refused_count: UInt64
    """Commands with numbers that are not finite, or of a wrong shape."""
    superseded_count: UInt64
    """Commands that a newer one replaced before they were due."""
    lost_count: UInt64
    """Commands that Cortex lost on the way, or a link as configured."""
    command_age_ns: Annotated[int, Unit("ns")]
    """Simulation time since the command that holds was taken over [ns]."""
    fail_safe: bool
    """Whether the command is stale, and the fail-safe flies."""
    fail_safe_count: UInt64
    """How often it set in."""
    collision_count: UInt64
    """How often it has begun to touch something."""
    undelivered_count: UInt64 = 0
    """As in `SensorStatus`, of its other topics: odometry, rotor speeds, collisions, deliveries."""
    refused_reason: str = ""
    """Why the last command was refused; empty if none was."""
    clamped_count: UInt64 = 0
    """Commands out of range that were clamped."""
    clamped_reason: str = ""
    """What was out of range the last time; empty if nothing was."""
    command_source: str = ""
    """Name of the node that commands, or names of several; empty before the first command."""


@message(name="cortex/SimulatorStatus")
class SimulatorStatus:
    """How a simulator is doing; about five times a second, and when its phase changes."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Simulation time [ns]."""
    wall_ns: Annotated[int, Unit("ns", frame="CLOCK_REALTIME")]
    """Wall-clock time, since 1970 [ns]."""
    phase: str
    """"waiting" for a first or a late command, "running", "paused" or "ended"."""
    reason: str
    """Why it waits or has ended, or whose readers hold it up; empty if there is nothing to say."""
    mode: str
    """"lockstep" or "streaming"."""
    real_time_factor_wanted: float
    """0: as fast as it can."""
    real_time_factor: float
    """Simulated over wall-clock time since the status before."""
    step_count: UInt64
    """Control periods since the beginning of the run."""
    step_median_ns: Annotated[int, Unit("ns")]
    """Wall-clock time to compute one, median since the status before [ns]."""
    step_p99_ns: Annotated[int, Unit("ns")]
    """Its 99th percentile [ns]."""
    late_median_ns: Annotated[int, Unit("ns")]
    """How late the wall clock was at the ends of control periods [ns]; 0 when time is not paced."""
    late_p99_ns: Annotated[int, Unit("ns")]
    """Its 99th percentile [ns]."""
    overrun_count: UInt64
    """Control periods that took longer than they had, since the beginning of the run."""
    slipped_ns: Annotated[int, Unit("ns")]
    """Wall-clock time by which the run has been held back, since its beginning [ns]."""
    sensors: list[SensorStatus]
    """All sensors of all vehicles."""
    vehicles: list[VehicleStatus]
    """All vehicles, in the order of the settings."""
    sequence: UInt64 = 0
    """Counts the messages of one simulator from 0."""


@message(name="cortex/Delivery")
class Delivery:
    """What a simulated link did to one message; of fixed size."""

    stamp_ns: Annotated[int, Unit("ns")]
    """When the message was sent [ns]."""
    delivered_ns: Annotated[int, Unit("ns")]
    """When it arrives [ns]; -1: never."""
    size_bytes: UInt64
    """Its size, as far as it takes bandwidth [bytes]."""
    sequence: UInt64 = 0
    """Counts the messages of the link from 0."""
