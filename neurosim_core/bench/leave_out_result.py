"""What `neurosim bench leave-out` found: counts of each run, how far reduced kernels are from full ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from neurosim_core.bench.leave_out_cases import Case
from neurosim_core.bench.leave_out_probe import Probe

EQUAL_BAR = 1e-12
"""Largest difference of what reduced kernels compute in float64."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """How far a reduced kernel is from the full one with coefficients of zero."""

    kernel: str
    reduced: str
    """Terms of the reduced kernel."""
    full: str
    """Terms of the full one."""
    largest: float
    """Largest difference of any number that they compute."""
    precision: str
    """In which they compute."""
    bar: float
    """The largest difference that is allowed."""


@dataclass(frozen=True, kw_only=True)
class LeaveOutResult:
    """What `measure_leave_out` found."""

    quick: bool
    cases: tuple[Case, ...]
    probes: Mapping[str, Probe]
    """What was counted in each case, by its name."""
    differences: tuple[Difference, ...]
