"""Settings of a simulator with controllers in other processes (`neurosim serve`), and of simulated links."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from neurosim_core.settings import BaseConfig

LiveMode = Literal["lockstep", "streaming"]
FailSafe = Literal["hover", "cut", "hold"]
Delay = Annotated[float, Field(ge=0.0, le=5.0)]
"""A longer one was meant in milliseconds."""


class LiveConfig(BaseConfig):
    """Timing of a live run, and the response to a slow controller or machine."""

    mode: LiveMode = "streaming"
    """streaming: time passes whether commands arrive or not; each command is held until the next. lockstep:
    every control period waits for its command, so that a flight is bit-identical on every machine."""
    real_time_factor: Annotated[float, Field(ge=0.0, le=1000.0)] = 1.0
    """streaming: ratio of simulated to wall-clock time; 0: as fast as possible."""
    overrun: Literal["slow", "drop"] = "slow"
    """streaming: response when the machine is too slow. slow: simulated time slows down; drop: camera frames
    are dropped. /status counts both."""
    command_timeout_s: Annotated[float, Field(gt=0.0, le=1e6)] = 0.2
    """Age at which a command is stale [simulated s]; the fail-safe then flies until the next command."""
    fail_safe: FailSafe = "hover"
    """Response to a stale command. hover: stay where the command became stale; cut: rotors at their lowest
    speed; hold: keep the stale command."""
    begin: Literal["command", "hover"] = "command"
    """streaming: start of simulated time. command: at the first command; hover: at once, and each vehicle
    hovers where it starts until its first command."""
    command_deadline_s: Annotated[float, Field(gt=0.0, le=1e6)] = 30.0
    """lockstep: longest wait for a command before the run ends with an error [wall-clock s]. The wait for the
    first command of a run has no limit."""
    command_every: Annotated[int, Field(ge=1)] = 1
    """lockstep: number of control periods per command; 4 at a control rate of 200 Hz waits for 50 commands a
    second, and the inner loops still run at 200 Hz."""
    run_on: bool = True
    """Whether the run continues after `duration_s`, until it is stopped; false: it ends there."""


class LinkConfig(BaseConfig):
    """A simulated link between simulator and controller, in simulated time; random draws are seeded.

    A link keeps the order of its messages: a delayed message delays those behind it.
    """

    latency_s: Delay = 0.0
    """Delay of every message [s]."""
    jitter_s: Delay = 0.0
    """Additional random delay, uniform in [0, jitter_s] [s]."""
    loss: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Probability that a message is lost, from 0 to 1."""
    bandwidth_bytes_s: Annotated[float, Field(gt=0.0)] | None = None
    """Bandwidth [byte/s]; a message occupies the link for its size over this. null: unlimited."""
    queue_s: Annotated[float, Field(gt=0.0, le=1e6)] = 1.0
    """Longest wait for bandwidth [s]; a message that would wait longer is lost at once."""
    clock_offset_s: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    """Lead of the sensor's clock over simulated time at stamp 0 [s]; not for `command`."""
    clock_drift_ppm: Annotated[float, Field(ge=-1e5, le=1e5)] = 0.0
    """Relative excess of the rate of the sensor's clock [ppm]; not for `command`."""

    @property
    def delivers_at_once(self) -> bool:
        """Whether every message arrives when it is sent."""
        return not (self.latency_s or self.jitter_s or self.loss or self.bandwidth_bytes_s)

    def clock_ns(self, stamp_ns: int) -> int:
        """Return what the sensor's clock shows at a simulated time [ns], exact to the nearest nanosecond."""
        if not (self.clock_offset_s or self.clock_drift_ppm):
            return stamp_ns
        return stamp_ns + round(self.clock_offset_s * 1e9) + round(stamp_ns * (self.clock_drift_ppm * 1e-6))


NO_LINK = LinkConfig()
"""A link that does nothing."""
