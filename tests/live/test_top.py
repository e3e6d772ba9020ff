"""The dashboard of a running simulator."""

from __future__ import annotations

import io
from dataclasses import replace

from rich.console import Console

from cortex.messages import SensorStatus, SimulatorStatus
from neurosim_core.live.call import Dashboard

STATUS = SimulatorStatus(
    stamp_ns=1_000_000_000,
    wall_ns=0,
    phase="running",
    reason="",
    mode="streaming",
    real_time_factor_wanted=1.0,
    real_time_factor=0.5,
    step_count=200,
    step_median_ns=2_000_000,
    step_p99_ns=3_000_000,
    late_median_ns=0,
    late_p99_ns=4_000_000,
    overrun_count=7,
    slipped_ns=0,
    sensors=[],
    vehicles=[],
)


def sensor(published: int) -> SensorStatus:
    return SensorStatus(
        vehicle="drone",
        name="imu",
        active=True,
        subscriber_count=1,
        published_count=published,
        dropped_count=3,
    )


def shown(dashboard: Dashboard, status: SimulatorStatus) -> str:
    console = Console(file=io.StringIO(), width=120)
    console.print(dashboard.update(status))
    return console.file.getvalue()


def row(text: str) -> list[str]:
    return next(line for line in text.splitlines() if "drone/imu" in line).split()


def test_rates_are_counted_between_statuses():
    """50 messages in a quarter of a second are 200 a second; before there are two statuses nobody knows."""
    dashboard = Dashboard()
    assert row(shown(dashboard, replace(STATUS, sensors=[sensor(100)])))[:3] == ["drone/imu", "on", "-"]
    text = shown(dashboard, replace(STATUS, stamp_ns=1_250_000_000, sensors=[sensor(150)]))
    assert row(text)[:6] == ["drone/imu", "on", "200", "1", "150", "3"]
    assert "real-time factor ▄▄ 0.50" in text
    assert "p99 4.00 ms" in text
    assert "7 overruns" in text


def test_a_pause_keeps_the_rates_and_a_reset_forgets_them():
    dashboard = Dashboard()
    shown(dashboard, replace(STATUS, sensors=[sensor(100)]))
    later = replace(STATUS, stamp_ns=2_000_000_000, sensors=[sensor(300)])
    assert row(shown(dashboard, later))[2] == "200"
    assert row(shown(dashboard, replace(later, phase="paused")))[2] == "200"
    assert row(shown(dashboard, replace(STATUS, stamp_ns=0, sensors=[sensor(0)])))[2] == "-"
