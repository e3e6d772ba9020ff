"""What `neurosim serve` says unasked: what a user would want to know of, once."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from cortex.messages import SimulatorStatus, VehicleStatus
from neurosim_core.live.console import StatusLine, changes, print_end


def vehicle(**changed: Any) -> VehicleStatus:
    values: dict[str, Any] = {
        "name": "drone",
        "command_mode": "velocity",
        "command_count": 10,
        "refused_count": 0,
        "superseded_count": 0,
        "lost_count": 0,
        "command_age_ns": 0,
        "fail_safe": False,
        "fail_safe_count": 0,
        "collision_count": 0,
    }
    return VehicleStatus(**{**values, **changed})


def status(**changed: Any) -> SimulatorStatus:
    values: dict[str, Any] = {
        "stamp_ns": 10**9,
        "wall_ns": 0,
        "phase": "running",
        "reason": "",
        "mode": "streaming",
        "real_time_factor_wanted": 1.0,
        "real_time_factor": 1.0,
        "step_count": 200,
        "step_median_ns": 0,
        "step_p99_ns": 0,
        "late_median_ns": 0,
        "late_p99_ns": 0,
        "overrun_count": 0,
        "slipped_ns": 0,
        "sensors": [],
        "vehicles": [vehicle()],
    }
    return SimulatorStatus(**{**values, **changed})


@pytest.mark.parametrize(
    ("before", "after", "news"),
    [
        ({}, {}, []),
        (None, {"phase": "ended", "reason": "drone collided"}, ["ended: drone collided"]),
        ({"phase": "ended", "reason": "x"}, {"phase": "ended", "reason": "x"}, []),
        (
            {},
            {"phase": "waiting", "reason": "for the command of drone"},
            ["waiting for the command of drone"],
        ),
        (
            {},
            {"vehicles": [vehicle(fail_safe=True, fail_safe_count=1)]},
            ["drone: no command has come in time; the fail-safe flies"],
        ),
        (
            {"vehicles": [vehicle(fail_safe=True, fail_safe_count=1)]},
            {"vehicles": [vehicle(fail_safe_count=1)]},
            ["drone: commands are coming again"],
        ),
        ({"vehicles": [vehicle(fail_safe=True, fail_safe_count=1)]}, {"step_count": 0}, []),  # a reset
    ],
)
def test_changes_are_said(before, after, news):
    assert changes(None if before is None else status(**before), status(**after)) == news


def test_a_machine_that_is_too_slow_is_told_once():
    """After a second of it, not at a hiccup, and again only in another run."""
    text = io.StringIO()
    line = StatusLine(Console(file=text, width=200))
    factors = [1.0, 0.5, 1.0, *[0.4] * 20, 1.0, *[0.4] * 20]
    for step, factor in enumerate(factors):
        line.show(status(real_time_factor=factor, step_count=step))
    assert text.getvalue().count("this machine manages 0.40 x real time, not 1") == 1
    for step in range(20):
        line.show(status(real_time_factor=0.3, step_count=step))
    assert text.getvalue().count("this machine manages") == 2
    for step in range(20):
        line.show(status(real_time_factor=0.3, step_count=100 + step, real_time_factor_wanted=0.0))
    assert text.getvalue().count("this machine manages") == 2


def test_the_end_tells_of_intervals_that_were_redone():
    """Of vehicles that had some."""
    text = io.StringIO()
    print_end(Console(file=text, width=200), status(), None, redone={"red": 0, "blue": 1234})
    lines = text.getvalue().splitlines()
    assert "blue: 1,234 intervals were too rough for fixed steps, and redone in adaptive ones" in lines
    assert not any("red:" in line for line in lines)
