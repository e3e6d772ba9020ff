"""The command that holds: newest, late, stale."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neurosim_core.live import LinkConfig, LiveConfig
from neurosim_core.nodes.channel import Channel
from neurosim_core.nodes.helm import Command, Helm
from neurosim_core.packets import Odometry
from neurosim_core.vehicle import preset

MS = 1_000_000
STATE = Odometry(
    position=np.array([1.0, 2.0, 3.0]),
    orientation=Rotation.from_euler("z", 0.7).as_quat(),
    velocity=np.array([1.0, 0.0, 0.0]),
    body_rate=np.zeros(3),
    rotor_speed=np.zeros(4),
)


def make_helm(link: LinkConfig | None = None, **live: Any) -> Helm:
    return Helm(LiveConfig(**live), link or LinkConfig(), airframe=preset("hummingbird"), seed=3)


def command(value: float, mode: Any = "rates") -> Command:
    return Command(mode=mode, setpoint=np.full(4, value))


def held(helm: Helm, stamp_ns: int) -> tuple[str, Any]:
    return helm.command_at(stamp_ns, lambda: STATE)


def test_nothing_holds_before_the_first_command():
    helm = make_helm(command_timeout_s=0.2)
    assert held(helm, 0) == ("motor_speeds", None)
    assert held(helm, 500 * MS) == ("motor_speeds", None)
    assert helm.counts.fail_safe == 0
    assert helm.age_ns(500 * MS) == 0


def test_it_may_hover_where_it_starts_until_the_first_command():
    helm = make_helm(begin="hover", command_timeout_s=0.2)
    for stamp_ns in (0, 500 * MS):
        mode, setpoint = held(helm, stamp_ns)
        assert (mode, setpoint.tolist()) == ("position", pytest.approx([1.0, 2.0, 3.0, 0.7]))
    assert (helm.fail_safe, helm.counts.fail_safe) == (False, 0)
    helm.send(command(1.0), stamp_ns=600 * MS)
    assert held(helm, 600 * MS)[0] == "rates"
    assert held(make_helm(begin="hover", mode="lockstep"), 0) == ("motor_speeds", None)


def test_a_command_holds_until_the_next():
    helm = make_helm()
    helm.send(command(1.0), stamp_ns=0)
    assert held(helm, 0)[1][0] == 1.0
    assert held(helm, 5 * MS)[1][0] == 1.0
    helm.send(command(2.0), stamp_ns=10 * MS)
    helm.send(command(3.0, "attitude"), stamp_ns=10 * MS)
    mode, setpoint = held(helm, 10 * MS)
    assert (mode, setpoint[0]) == ("attitude", 3.0)
    assert helm.counts.taken == 2
    assert helm.counts.superseded == 1
    assert helm.age_ns(25 * MS) == 15 * MS


def test_the_timeout_is_exact():
    """Stale is older than the timeout, not as old."""
    helm = make_helm(command_timeout_s=0.2, fail_safe="cut")
    helm.send(command(1.0), stamp_ns=0)
    held(helm, 0)
    assert held(helm, 200 * MS)[0] == "rates"
    assert held(helm, 200 * MS + 1)[0] == "motor_speeds"


def test_hover_stays_where_the_command_became_stale():
    helm = make_helm(command_timeout_s=0.2, fail_safe="hover")
    helm.send(command(1.0), stamp_ns=0)
    held(helm, 0)
    mode, setpoint = held(helm, 205 * MS)
    assert mode == "position"
    assert setpoint == pytest.approx([1.0, 2.0, 3.0, 0.7], abs=1e-12)
    assert helm.fail_safe
    elsewhere = Odometry(**{**vars(STATE), "position": np.array([9.0, 9.0, 9.0])})
    assert helm.command_at(210 * MS, lambda: elsewhere)[1] is setpoint
    assert helm.counts.fail_safe == 1
    helm.send(command(5.0), stamp_ns=215 * MS)
    assert held(helm, 215 * MS)[0] == "rates"
    assert not helm.fail_safe


def test_cut_and_hold():
    cut = make_helm(command_timeout_s=0.1, fail_safe="cut")
    hold = make_helm(command_timeout_s=0.1, fail_safe="hold")
    for helm in (cut, hold):
        helm.send(command(4.0), stamp_ns=0)
        held(helm, 0)
    lowest = preset("hummingbird").rotor_speed_min_rad_s
    assert held(cut, 101 * MS)[1].tolist() == [lowest] * 4
    assert held(hold, 101 * MS)[1][0] == 4.0
    assert hold.fail_safe
    assert hold.counts.fail_safe == 1


def test_a_link_delays_commands():
    helm = make_helm(LinkConfig(latency_s=0.008))
    delivery = helm.send(command(1.0), stamp_ns=0)
    assert delivery is not None
    assert delivery.delivered_ns == 8 * MS
    assert delivery.size_bytes == 40
    assert held(helm, 5 * MS)[1] is None
    assert held(helm, 10 * MS)[1][0] == 1.0
    assert helm.age_ns(15 * MS) == 5 * MS  # since it took over


def test_reset_forgets():
    helm = make_helm(LinkConfig(latency_s=0.008))
    helm.send(command(1.0), stamp_ns=0)
    held(helm, 10 * MS)
    helm.send(command(2.0), stamp_ns=15 * MS)
    helm.reset(seed=3)
    assert held(helm, 30 * MS) == ("motor_speeds", None)
    assert helm.counts.taken == 0


def test_a_channel_keeps_the_order_when_its_link_changes():
    """What was under way on a slow link is not overtaken by what is sent without one."""
    channel = Channel("imu", LinkConfig(), seed=0)
    assert channel.send("a", stamp_ns=0, size_bytes=1) is None
    channel.configure(LinkConfig(latency_s=0.02))
    channel.send("b", stamp_ns=5 * MS, size_bytes=1)
    channel.configure(LinkConfig())
    channel.send("c", stamp_ns=10 * MS, size_bytes=1)
    assert channel.next_due_ns == 0
    assert channel.due(24 * MS) == [(0, "a")]
    assert channel.next_due_ns == 25 * MS
    assert channel.due(25 * MS) == [(25 * MS, "b"), (25 * MS, "c")]
    assert channel.send("d", stamp_ns=30 * MS, size_bytes=1) is None
    channel.reset(seed=0)
    assert channel.next_due_ns is None


def test_nothing_of_the_fail_safe_is_left_after_a_reset():
    helm = make_helm(command_timeout_s=0.1, fail_safe="cut")
    helm.send(command(1.0), stamp_ns=0)
    assert held(helm, 0)[1][0] == 1.0
    held(helm, 200 * MS)
    assert helm.fail_safe
    helm.reset(seed=3)
    assert not helm.fail_safe
    assert held(helm, 0) == ("motor_speeds", None)
