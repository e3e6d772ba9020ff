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
    """How time passes, and what happens when a controller or the machine is too slow."""

    mode: LiveMode = "streaming"
    """streaming: time passes whether commands arrive or not; each command is held until the next. lockstep:
    every control period waits for its command, so that a flight is bit-identical on every machine."""
    real_time_factor: Annotated[float, Field(ge=0.0, le=1000.0)] = 1.0
    """streaming: simulated over wall-clock time; 0: as fast as possible."""
    overrun: Literal["slow", "drop"] = "slow"
    """streaming: what gives way when the machine is too slow. slow: time; drop: camera frames. /status counts
    both."""
    command_timeout_s: Annotated[float, Field(gt=0.0, le=1e6)] = 0.2
    """Age at which a command is stale [simulated s]; the fail-safe then flies until the next command."""
    fail_safe: FailSafe = "hover"
    """hover: stay where the command became stale; cut: rotors at their lowest speed; hold: keep the stale
    command."""
    begin: Literal["command", "hover"] = "command"
    """streaming: when time begins. command: with the first command; hover: at once, and each vehicle hovers
    where it starts until its first command."""
    command_deadline_s: Annotated[float, Field(gt=0.0, le=1e6)] = 30.0
    """lockstep: longest wait for a command before the run ends with an error [wall-clock s]. The wait for the
    first command of a run has no limit."""
    command_every: Annotated[int, Field(ge=1)] = 1
    """lockstep: control periods for each command; 4 at a control rate of 200 Hz waits for 50 commands a
    second, and the inner loops still run at 200 Hz."""
    run_on: bool = True
    """Continue after `duration_s`, until stopped. false: end there."""


class LinkConfig(BaseConfig):
    """What a simulated link does to messages between simulator and controller, in simulated time; seeded.

    A link keeps the order of its messages: a delayed message delays those behind it.
    """

    latency_s: Delay = 0.0
    """Delay of every message [s]."""
    jitter_s: Delay = 0.0
    """Further delay, uniform in [0, jitter_s] [s]."""
    loss: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Share of messages that never arrive."""
    bandwidth_bytes_s: Annotated[float, Field(gt=0.0)] | None = None
    """Bytes a second; a message occupies the link for its size over this. null: unlimited."""
    queue_s: Annotated[float, Field(gt=0.0, le=1e6)] = 1.0
    """Longest wait for bandwidth [s]; a message that would wait longer is lost at once."""
    clock_offset_s: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    """How far the sensor's clock is ahead of simulated time at stamp 0 [s]; not for `command`."""
    clock_drift_ppm: Annotated[float, Field(ge=-1e5, le=1e5)] = 0.0
    """How much faster the sensor's clock runs [1e-6]; not for `command`."""

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
