"""What `measure_dynamics` found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from neurosim_core.bench.dynamics_extremes import Refusal, Trial
from neurosim_core.bench.dynamics_inputs import Answer
from neurosim_core.bench.dynamics_long import Drift
from neurosim_core.bench.dynamics_precision import OrderFit, Sample
from neurosim_core.bench.dynamics_reference import Reference
from neurosim_core.bench.dynamics_scenes import Errors, Flight
from neurosim_core.bench.dynamics_sweep import Sweep
from neurosim_core.bench.dynamics_throughput import Pruning, Throughput


@dataclass(frozen=True, kw_only=True, eq=False)
class SolvedFlight:
    """A flight and its reference."""

    flight: Flight
    reference: Reference


@dataclass(frozen=True, kw_only=True)
class PeerSample:
    """One vehicle called from Python on one flight: RotorPy's, or ours."""

    flight: str
    method: str
    errors: Errors
    """Against the reference."""
    cpu_s_per_s: float
    """CPU time of everything that the call does, per simulated second [s/s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StiffMotor:
    """All methods at one motor time constant."""

    time_constant_s: float
    """[s]."""
    reference: Reference
    trials: tuple[Trial, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Extreme:
    """All methods on one extreme flight."""

    case: str
    reference: Reference
    trials: tuple[Trial, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class DynamicsResult:
    """All measurements of the chapter."""

    quick: bool
    """Whether it is the small version."""
    rotorpy: str | None
    """Version of RotorPy; None if it is not installed."""
    derivative_differences: Mapping[str, float]
    """Vehicle -> how far RotorPy's accelerations are from ours, relative; empty without RotorPy."""
    flights: tuple[SolvedFlight, ...]
    samples: tuple[Sample, ...]
    orders: tuple[OrderFit, ...]
    peers: tuple[PeerSample, ...]
    motors: tuple[StiffMotor, ...]
    extremes: tuple[Extreme, ...]
    refusals: tuple[Refusal, ...]
    sweeps: tuple[Sweep, ...]
    answers: tuple[Answer, ...]
    drifts: tuple[Drift, ...]
    throughputs: tuple[Throughput, ...]
    prunings: tuple[Pruning, ...]

    def sample(self, flight: str, method: str, setting: float) -> Sample:
        """Return the sample of a method with a setting on a flight; KeyError if there is none."""
        for sample in self.samples:
            if (sample.flight, sample.method, sample.setting) == (flight, method, setting):
                return sample
        raise KeyError((flight, method, setting))


def cheapest_called(result: DynamicsResult, peer: PeerSample) -> PeerSample | None:
    """Return the cheapest flight of one vehicle of ours, called once a command, that is no less exact."""
    ours = [
        p
        for p in result.peers
        if p.flight == peer.flight
        and p.method.startswith("ours")
        and p.errors.position_m <= peer.errors.position_m
    ]
    return min(ours, key=lambda p: p.cpu_s_per_s, default=None)
