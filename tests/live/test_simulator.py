"""The simulator as a node: what it publishes, how time passes, and what it does when others fail."""

from __future__ import annotations

import itertools
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from live_rig import IMU, ODOMETRY, LiveRig, before_looks, drain, make_config, models_of
from processes import SOON_S, wait_for
from small_room import room_scene

from cortex.messages import (
    Clock,
    Collision,
    Events,
    Image,
    Imu,
    MotorCommand,
    Odometry,
    Parameters,
    PoseCommand,
    Reset,
    RotorSpeeds,
    Simulation,
    SimulatorStatus,
    Step,
    Trigger,
)
from cortex.messages import Delivery as DeliveryMessage
from neurosim_core.config import load_config
from neurosim_core.live.streaming import frame_counts
from neurosim_core.packets import Delivery
from neurosim_core.record import Recording
from neurosim_core.sim import Batch, State, forget_controllers, make_state, observe, step

pytestmark = pytest.mark.usefixtures("shared_runtime")

MS = 1_000_000
PERIOD_NS = 5 * MS
LOCKSTEP = {"live.mode": "lockstep"}


def same(message: Any, packet: Any) -> bool:
    """Whether a message says exactly what a packet of odometry does."""
    names = ("position", "orientation", "velocity", "body_rate")
    return message.stamp_ns == packet.stamp_ns and all(
        np.array_equal(getattr(message, name), getattr(packet, name)) for name in names
    )


# Lockstep


def test_lockstep_publishes_what_was_flown():
    """Odometry, rotor speeds and clock at every tick, sensors at theirs; the states are those of `step`."""
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        speeds = rig.listen("/drone/rotor_speeds", RotorSpeeds)
        clock = rig.listen("/clock", Clock)
        imu = rig.listen("/drone/imu", Imu)
        rgb = rig.listen("/drone/rgb", Image)
        events = rig.listen("/drone/events", Events)
        waiting = rig.wait_for_status(lambda status: status.phase == "waiting")
        assert waiting.reason == "for the first command"
        assert waiting.mode == "lockstep"
        states = rig.fly(odometry, 8, lambda state: ("motor_speeds", 1.05 * rig.hover()))
        pictures = [rgb.recv(SOON_S) for _ in range(3)]
        samples = [imu.recv(SOON_S) for _ in range(17)]
        ticks = [clock.recv(SOON_S) for _ in range(8)]
        turning: dict[int, RotorSpeeds] = {}
        while len(turning) < 9:  # the first may come again, for a controller that has just connected
            message = speeds.recv(SOON_S)
            turning[message.sequence] = message
        windows = [events.recv(SOON_S) for _ in range(4)]

    model = models_of(rig.config)["drone"]
    state = make_state(model)
    expected = [observe(state)]
    for _ in range(8):
        step(model, state, 1.05 * rig.hover())
        expected.append(observe(state))
    assert all(same(message, packet) for message, packet in zip(states, expected, strict=True))
    assert [m.sequence for m in states] == list(range(9))
    assert all(
        np.array_equal(m.speed, packet.rotor_speed) and m.sequence == number
        for number, (m, packet) in enumerate(zip(turning.values(), expected, strict=True))
    )
    assert [m.stamp_ns for m in ticks] == [PERIOD_NS * k for k in range(1, 9)]
    assert [m.sequence for m in ticks] == list(range(8))
    assert {m.real_time_factor for m in ticks} == {0.0}
    assert [m.stamp_ns for m in samples] == [2_500_000 * k for k in range(17)]
    assert [m.stamp_ns for m in pictures] == [0, 20 * MS, 40 * MS]
    assert pictures[0].data.shape == (48, 64, 3)
    assert [(m.start_ns, m.stamp_ns) for m in windows] == [(10 * MS * k, 10 * MS * (k + 1)) for k in range(4)]


def test_simulation_is_told_to_who_comes_later():
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        told = rig.listen("/simulation", Simulation).recv(SOON_S)
        assert told.vehicles == ["drone"]
        assert told.mode == "lockstep"
        assert told.control_rate_hz == 200.0
        assert load_config(yaml.safe_load(told.config)) == rig.config


def test_lockstep_takes_only_the_command_that_answers():
    """A command with another stamp is superseded, and time waits on."""
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        rig.fly(odometry, 1)
        rig.send(rig.hover(), stamp_ns=0)
        rig.send(rig.hover(), stamp_ns=123)
        rig.wait_for_status(lambda status: status.vehicles[0].superseded_count == 2)
        status = rig.wait_for_status(lambda status: status.phase == "waiting")
        assert status.stamp_ns == PERIOD_NS
        assert status.reason == "for the command of drone that answers 5000000 ns"
        rig.send(rig.hover(), stamp_ns=PERIOD_NS)
        assert odometry.recv(SOON_S).stamp_ns == 2 * PERIOD_NS


def test_lockstep_ends_with_an_error_when_no_command_comes():
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        rig.fly(odometry, 2)
        rig.send(rig.hover(), stamp_ns=77)
        rig.wait_for_status(lambda status: status.vehicles[0].superseded_count == 1)
        rig.set({"live.command_deadline_s": 0.2})
        assert rig.join() == 1
        reason = rig.wait_for_status(lambda status: status.phase == "ended").reason
    assert "no command for drone within live.command_deadline_s = 0.2 s at control period 2" in reason
    assert "mode motor_speeds that answers the odometry of 10000000 ns" in reason
    assert "1 publisher(s)" in reason
    assert "answered 77 ns" in reason


def test_a_controller_that_spoke_too_soon_is_asked_again():
    """Its first command reaches nobody, as the simulator is not connected to it yet; it hears again."""
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        speeds = rig.listen("/drone/rotor_speeds", RotorSpeeds)
        first = odometry.recv(SOON_S)
        with rig.node.publisher("/drone/command/motor_speeds", MotorCommand):
            again = odometry.recv(SOON_S)
            assert (again.stamp_ns, again.sequence) == (0, 0)
            assert again.position.tobytes() == first.position.tobytes()
            assert [speeds.recv(SOON_S).sequence for _ in range(2)] == [0, 0]
            assert drain(odometry, 0.1) == []  # once for each that comes
            rig.send(rig.hover(), stamp_ns=0)
            while (answered := odometry.recv(SOON_S)).stamp_ns == 0:  # the rig's own publisher has come, too
                pass
            assert [answered.stamp_ns, *(m.stamp_ns for m in drain(odometry, 0.1))] == [PERIOD_NS]
        with rig.node.publisher("/drone/command/position", PoseCommand):  # one that is started in the middle
            assert odometry.recv(SOON_S).stamp_ns == PERIOD_NS


def test_lockstep_waits_only_at_every_nth_period():
    with LiveRig(make_config(**LOCKSTEP, **{"live.command_every": 4})) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        rig.send(rig.hover(), stamp_ns=0)
        stamps: list[int] = []
        while len(stamps) < 5:  # that of a new controller comes again
            stamps = list(dict.fromkeys([*stamps, odometry.recv(SOON_S).stamp_ns]))
        assert stamps == [PERIOD_NS * k for k in range(5)]
        with pytest.raises(TimeoutError):
            odometry.recv(0.05)
        rig.send(rig.hover(), stamp_ns=20 * MS)
        assert odometry.recv(SOON_S).stamp_ns == 25 * MS


def test_a_link_delays_odometry_and_commands_in_lockstep():
    """8 ms each way: odometry of tick k is there at tick k + 2, its command flies from tick k + 4 on."""
    link = {"latency_s": 0.008}
    config = make_config(**LOCKSTEP, links={"odometry": link, "rotor_speeds": link, "command": link})
    stamps = []
    with LiveRig(config) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        turning = rig.listen("/drone/rotor_speeds", RotorSpeeds)
        told = rig.listen("/clock", Clock)
        for _ in range(8):
            state = odometry.recv(SOON_S)
            stamps.append(state.stamp_ns)
            push = 1.2 if state.stamp_ns == 0 else 1.0
            rig.send(push * rig.hover(), stamp_ns=state.stamp_ns)
        speeds = [turning.recv(SOON_S).speed[0] for _ in range(6)]
        assert stamps == [PERIOD_NS * k for k in range(8)]
        assert told.recv(SOON_S).stamp_ns == PERIOD_NS
    hover = rig.hover()[0]
    assert speeds[:3] == pytest.approx([hover] * 3)  # the command of stamp 0 is due at 8 ms: tick 2
    assert speeds[3] > 1.01 * hover


def test_lockstep_with_a_lossy_link_is_that_of_its_seed():
    def flight() -> tuple[list[int], list[int]]:
        with LiveRig(make_config(**LOCKSTEP, links={"command": {"loss": 0.4}})) as rig:
            odometry = rig.listen("/drone/odometry", Odometry)
            lost = rig.listen("/drone/command/delivery", DeliveryMessage)
            states = rig.fly(odometry, 40, lambda s: ("position", [s.stamp_ns * 1e-9, 2.0, 1.0, 0.0]))
            deliveries = [lost.recv(SOON_S).delivered_ns for _ in range(40)]
            status = rig.wait_for_status(lambda status: status.stamp_ns >= 200 * MS)
            assert status.vehicles[0].lost_count == deliveries.count(-1)
            return [int(s.position.view(np.uint64)[0]) for s in states], deliveries

    first, second = flight(), flight()
    assert first == second
    assert 4 <= first[1].count(-1) <= 34  # 16 expected, 6 deviations are 18


# Commands


@pytest.mark.parametrize(
    ("mode", "row"),
    [
        ("motor_speeds", None),
        ("rates", [6.5, 0.0, 0.0, 1.0]),
        ("attitude", [6.5, 0.0, 0.0, 0.1, 0.995]),
        ("velocity", [0.0, 0.0, 0.5, 0.2]),
        ("position", [1.0, 1.0, 1.5, 0.5]),
    ],
)
def test_every_mode_flies_as_in_process(mode: Any, row: Any):
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        row = 1.1 * rig.hover() if row is None else row
        odometry = rig.listen("/drone/odometry", Odometry)
        states = rig.fly(odometry, 5, lambda state: (mode, row))
        status = rig.wait_for_status(lambda status: status.step_count == 5)
    assert status.vehicles[0].command_mode == mode
    assert status.vehicles[0].command_count == 5
    model = models_of(rig.config)["drone"]
    state = make_state(model)
    for message in states:
        assert same(message, observe(state))
        step(model, state, row, mode=mode)


def test_modes_are_switched_by_what_arrives():
    modes = [("motor_speeds", None), ("position", [1.0, 1.0, 1.5, 0.5]), ("rates", [6.5, 0.0, 0.0, 1.0])] * 3
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        commands = [(mode, rig.hover() if row is None else row) for mode, row in modes]
        odometry = rig.listen("/drone/odometry", Odometry)
        states = rig.fly(odometry, 9, lambda state: commands[state.stamp_ns // PERIOD_NS])
    model = models_of(rig.config)["drone"]
    state = make_state(model)
    for message, (mode, row) in zip(states, commands, strict=False):
        assert same(message, observe(state))
        step(model, state, row, mode=mode)  # type: ignore[arg-type]


def test_bad_commands_are_refused_and_counted(caplog: pytest.LogCaptureFixture):
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        rig.send([np.nan, 1.0, 1.0, 1.0])
        rig.send([1.0, 1.0])
        rig.fly(odometry, 1)
        assert rig.wait_for_status(lambda status: status.step_count == 1).vehicles[0].refused_count == 2
    assert "refused a command" in caplog.text


# Pay for what is used


def test_only_what_is_listened_to_is_rendered():
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        states = rig.fly(odometry, 8)
        state = rig.simulator.vehicles[0].state
        assert state.counts["renders"] == 0
        pictures = rig.listen("/drone/rgb", Image)
        status = rig.wait_for_status(lambda status: status.sensors[2].active)
        assert [(s.name, s.active, s.subscriber_count) for s in status.sensors] == [
            ("imu", False, 0),
            ("odometry", True, 1),
            ("rgb", True, 1),
            ("events", False, 0),
        ]
        rig.send(rig.hover(), stamp_ns=states[-1].stamp_ns)
        rig.fly(odometry, 8)
        assert [picture.stamp_ns for picture in drain(pictures, least=2)] == [60 * MS, 80 * MS]
        assert state.counts["renders"] == 2  # no event camera looks
        pictures.close()
        rig.wait_for_status(lambda status: not status.sensors[2].active)
        rig.send(rig.hover(), stamp_ns=state.stamp_ns)
        rig.fly(odometry, 8)
        assert state.counts["renders"] == 2


def test_who_subscribes_and_then_commands_gets_stamp_0(monkeypatch: pytest.MonkeyPatch):
    begin_s, subscribed = time.monotonic(), threading.Event()
    clock = SimpleNamespace(
        monotonic=lambda: time.monotonic() if subscribed.is_set() else begin_s,
        monotonic_ns=time.monotonic_ns,
        time_ns=time.time_ns,
    )
    monkeypatch.setattr("neurosim_core.live.status.time", clock)  # it settles when the test has subscribed
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        rig.send(rig.hover(), stamp_ns=0)
        monitor = rig.simulator._subscribers
        assert not sum(monitor._counts[1:-1])  # of the topics of the vehicle
        events = rig.node.subscriber("/drone/events", Events)
        imu = rig.node.subscriber("/drone/imu", Imu)
        wait_for(lambda: sum(monitor._counts[1:-1]) >= 2)
        subscribed.set()
        rig.send(rig.hover(), stamp_ns=PERIOD_NS)
        rig.send(rig.hover(), stamp_ns=2 * PERIOD_NS)
        assert imu.recv(SOON_S).stamp_ns == 0
        assert events.recv(SOON_S).start_ns == 0


# Streaming


def test_streaming_keeps_to_the_clock():
    """A fifth of a second of simulated time takes 0.8 s at a quarter of real time."""
    with LiveRig(make_config(**{"live.real_time_factor": 0.25})) as rig:
        clock = rig.listen("/clock", Clock)
        rig.send(rig.hover())
        ticks = [clock.recv(SOON_S) for _ in range(41)]
    assert [m.stamp_ns for m in ticks] == [PERIOD_NS * k for k in range(1, 42)]
    assert {m.real_time_factor for m in ticks} == {0.25}
    # the first one may be late, on a busy machine; unpaced, all take a tenth of that
    assert ticks[-1].wall_ns - ticks[0].wall_ns >= 500 * MS


def test_an_answer_counts_from_the_next_tick_on():
    """What arrives by a tick is taken before anything of it is published: no answer is in time for it."""
    with LiveRig(make_config(**{"live.real_time_factor": 0.2})) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        speeds = rig.listen("/drone/rotor_speeds", RotorSpeeds)
        rig.send(rig.hover())
        for _ in range(20):
            state = odometry.recv(SOON_S)
        rig.send(1.3 * rig.hover())
        felt = next(
            m.stamp_ns for m in iter(lambda: speeds.recv(SOON_S), None) if m.speed[0] > rig.hover()[0] + 1
        )
    assert felt >= state.stamp_ns + 2 * PERIOD_NS


def test_time_may_begin_with_a_hover():
    """Before anybody has sent a command everything flows, and the vehicle stays where it starts."""
    with LiveRig(make_config(sensors={"odometry": ODOMETRY}, **{"live.begin": "hover"})) as rig:
        states = rig.listen("/drone/odometry", Odometry)
        first, *_, last = [states.recv(SOON_S) for _ in range(50)]
        assert last.stamp_ns > first.stamp_ns
        np.testing.assert_allclose(last.position, first.position, atol=0.02)
        rig.send([0.0, 0.0, 1.0, 0.0], mode="velocity")
        wait_for(lambda: states.recv(SOON_S).velocity[2] > 0.5)


def test_factor_0_does_not_wait():
    with LiveRig(make_config(**{"live.real_time_factor": 0.0, "live.run_on": False})) as rig:
        told: list[Any] = []
        rig.simulator.status.on_status = told.append
        begin_s = time.monotonic()
        rig.send(rig.hover())
        assert rig.join() == 0
        assert time.monotonic() - begin_s < SOON_S
        assert rig.simulator.stamp_ns == 1000 * MS
        assert told[-1].overrun_count == 0


@pytest.mark.parametrize("fail_safe", ["hover", "cut", "hold"])
def test_a_lost_controller(fail_safe: str):
    """The command pushes up; hover stays there, cut falls, hold goes on."""
    live = {"live.real_time_factor": 0.0, "live.command_timeout_s": 0.1, "live.fail_safe": fail_safe}
    with LiveRig(make_config(**live)) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        rig.send([0.0, 0.0, 0.5, 0.0], mode="velocity")
        states = [odometry.recv(SOON_S) for _ in range(120)]
        status = rig.wait_for_status(lambda status: status.vehicles[0].fail_safe)
    assert status.vehicles[0].fail_safe_count == 1
    assert status.vehicles[0].command_age_ns > 100 * MS
    height = np.array([state.position[2] for state in states])
    onset = 21  # the first tick after 100 ms
    assert height[onset] > height[0]
    climbed = height[-1] - height[onset]
    if fail_safe == "hover":
        assert abs(climbed) < 0.05  # it overshoots, and comes back
    elif fail_safe == "cut":
        assert climbed < -0.5  # 9.81 / 2 * 0.5^2 = 1.2 m, less what the rotors still give
    else:
        assert climbed > 0.1  # 0.5 m/s for half a second, less what the controller takes to get there


def test_the_fail_safe_ends_with_the_next_command():
    live = {"live.real_time_factor": 0.0, "live.command_timeout_s": 0.05}
    with LiveRig(make_config(**live)) as rig:
        rig.send(rig.hover())
        rig.wait_for_status(lambda status: status.vehicles[0].fail_safe)
        rig.set({"live.command_timeout_s": 1000.0})
        rig.send(rig.hover())
        rig.wait_for_status(lambda status: not status.vehicles[0].fail_safe)


def _with_slow_cameras(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Let the rendering of a batch with frames take longer."""
    before_looks(monkeypatch, lambda state, batch: frame_counts(state, batch) and time.sleep(seconds))


def test_slow_cameras_slow_time_down(monkeypatch: pytest.MonkeyPatch):
    """A picture takes 80 ms where it has 20: nothing is left out, time slips, and the status says so."""
    _with_slow_cameras(monkeypatch, 0.08)
    with LiveRig(make_config()) as rig:
        pictures = rig.listen("/drone/rgb", Image)
        rig.send(rig.hover())
        found = [pictures.recv(SOON_S) for _ in range(5)]
        status = rig.wait_for_status(lambda status: status.stamp_ns >= 80 * MS)
    assert [picture.stamp_ns for picture in found] == [20 * MS * k for k in range(5)]
    assert [picture.sequence for picture in found] == list(range(5))
    assert status.overrun_count > 0
    assert status.slipped_ns > 200 * MS
    assert all(sensor.dropped_count == 0 for sensor in status.sensors)


def test_slow_cameras_lose_frames_where_time_matters_more(monkeypatch: pytest.MonkeyPatch):
    _with_slow_cameras(monkeypatch, 0.05)
    with LiveRig(make_config(**{"live.overrun": "drop"})) as rig:
        pictures = rig.listen("/drone/rgb", Image)
        events = rig.listen("/drone/events", Events)
        rig.send(rig.hover())
        found = [pictures.recv(SOON_S) for _ in range(5)]
        dropped = rig.wait_for_status(lambda s: s.sensors[2].dropped_count and s.sensors[3].dropped_count)
        windows = drain(events, 0.1)
    sequence = [picture.sequence for picture in found]
    assert sequence == [picture.stamp_ns // (20 * MS) for picture in found]  # what is left out shows as a gap
    assert sequence[-1] > 4
    assert dropped.sensors[2].name == "rgb"
    assert all(second.start_ns == first.stamp_ns for first, second in itertools.pairwise(windows))


def test_what_is_left_out_at_the_end_is_counted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Every picture of the flight is in the recording, or the last status says that it is missing."""
    _with_slow_cameras(monkeypatch, 0.05)
    told: list[SimulatorStatus] = []
    with LiveRig(make_config(**{"live.overrun": "drop"}), record=tmp_path) as rig:
        rig.simulator.status.on_status = told.append
        rig.send(rig.hover())
        running = rig.wait_for_status(lambda s: s.sensors[2].dropped_count)
        rig.stop.set()
        assert rig.join() == 0
        flown_ns = rig.simulator.vehicles[0].state.stamp_ns
    with Recording(tmp_path / "flight.h5") as flight:
        packets = list(flight.packets())
    pictures = [p.stamp_ns for p in packets if p.sensor == "rgb"]
    dropped = told[-1].sensors[2].dropped_count
    assert dropped >= running.sensors[2].dropped_count
    assert len(pictures) + dropped == flown_ns // (20 * MS) + 1
    assert [p.stamp_ns for p in packets if p.sensor == "odometry"][-1] == flown_ns


@pytest.mark.parametrize(("give_up_s", "stamps_ms"), [(SOON_S, [0, 20]), (0.0, [0])])
def test_the_end_of_a_run_waits_for_the_picture_in_work_for_a_limited_time(
    monkeypatch: pytest.MonkeyPatch, give_up_s: float, stamps_ms: list[int]
):
    reached, told = threading.Event(), []

    def hold(state: State, batch: Batch) -> None:
        if batch.until_ns == 20 * MS:
            reached.set()
            assert release.wait(SOON_S)

    before_looks(monkeypatch, hold)
    monkeypatch.setattr("neurosim_core.live.streaming.GIVE_UP_S", give_up_s)
    with LiveRig(make_config()) as rig:
        release = rig.stop if give_up_s else threading.Event()
        rig.simulator.status.on_status = told.append
        pictures = rig.listen("/drone/rgb", Image)
        rig.send(rig.hover())
        assert reached.wait(SOON_S)
        rig.stop.set()
        assert rig.join() == 0
        assert [m.stamp_ns for m in drain(pictures, least=len(stamps_ms))] == [MS * t for t in stamps_ms]
        release.set()
    shown = told[-1].stamp_ns // (20 * MS) + 1
    assert told[-1].sensors[2].dropped_count in (shown - len(stamps_ms), shown - len(stamps_ms) + 1)


def test_cameras_that_fail_end_it(monkeypatch: pytest.MonkeyPatch):
    def fail(state: State, batch: Batch) -> None:
        raise ValueError("no picture")

    before_looks(monkeypatch, fail)
    with LiveRig(make_config()) as rig:
        rig.listen("/drone/rgb", Image)
        rig.send(rig.hover())
        assert rig.join() is None
        error, rig.error = rig.error, None
    assert isinstance(error, RuntimeError)
    assert str(error) == "the cameras failed: no picture"


def test_links_delay_in_streaming():
    with LiveRig(make_config(**{"live.real_time_factor": 0.0}, links={"imu": {"latency_s": 0.008}})) as rig:
        imu = rig.listen("/drone/imu", Imu)
        told = rig.listen("/drone/imu/delivery", DeliveryMessage)
        rig.send(rig.hover())
        assert [imu.recv(SOON_S).stamp_ns for _ in range(3)] == [0, 2_500_000, 5_000_000]
        delays = [m.delivered_ns - m.stamp_ns for m in (told.recv(SOON_S) for _ in range(20))]
        assert set(delays) == {8 * MS}


# Requests


def test_pause_step_resume():
    with LiveRig(make_config(**{"live.real_time_factor": 0.0})) as rig:
        clock = rig.listen("/clock", Clock)
        refused = rig.call("/step", Step(count=1))
        assert not refused.accepted
        assert "/pause first" in refused.reason
        rig.send(rig.hover())
        clock.recv(SOON_S)
        paused = rig.call("/pause", Trigger())
        assert paused.accepted
        assert paused.phase == "paused"
        while clock.recv(SOON_S).stamp_ns < paused.stamp_ns:
            pass
        stepped = rig.call("/step", Step(count=3))
        assert stepped.accepted
        assert stepped.stamp_ns == paused.stamp_ns + 3 * PERIOD_NS
        assert stepped.phase == "paused"
        assert [m.stamp_ns for m in drain(clock, 0.05, least=3)][-1:] == [stepped.stamp_ns]
        assert rig.call("/resume", Trigger()).accepted
        assert clock.recv(SOON_S).stamp_ns == stepped.stamp_ns + PERIOD_NS


def test_requests_do_not_wait_for_the_end_of_a_slow_period():
    """A control period takes 50 s by the wall clock; what was flown of it is not flown twice."""
    slow = {"live.real_time_factor": 1e-4}
    with LiveRig(make_config(**slow)) as rig:
        imu = rig.listen("/drone/imu", Imu)
        rig.send(rig.hover())
        assert imu.recv(SOON_S).stamp_ns == 0  # the first period has begun
        assert rig.call("/pause", Trigger()).phase == "paused"
        assert rig.call("/resume", Trigger()).accepted
        assert rig.set({"live.fail_safe": "cut"}).accepted
        assert rig.call("/reset", Reset()).stamp_ns == 0
        assert rig.simulator.phase == "waiting"
        rig.send(rig.hover())
        assert imu.recv(SOON_S).stamp_ns == 0
        assert rig.set({"live.real_time_factor": 0.0}).accepted
        assert [imu.recv(SOON_S).stamp_ns for _ in range(8)] == [2_500_000 * k for k in range(1, 9)]
        status = rig.wait_for_status(lambda status: status.step_count >= 4)
        assert status.vehicles[0].command_count == 1


def test_a_paused_run_shows_all_its_pictures(monkeypatch: pytest.MonkeyPatch):
    """Those that were not ready are published before /pause and /step are answered, and no later."""
    _with_slow_cameras(monkeypatch, 0.03)
    with LiveRig(make_config(**{"live.real_time_factor": 0.0})) as rig:
        pictures = rig.listen("/drone/rgb", Image)
        rig.send(rig.hover())
        stream = rig.simulator.vehicles[0].publisher.topics["rgb"]
        assert pictures.recv(SOON_S).stamp_ns == 0
        end_ns = rig.call("/pause", Trigger()).stamp_ns
        assert stream.published_count == end_ns // (20 * MS) + 1
        for _ in range(3):
            begin_ns, end_ns = end_ns, rig.call("/step", Step(count=6)).stamp_ns
            assert stream.published_count == end_ns // (20 * MS) + 1
            assert end_ns == begin_ns + 6 * PERIOD_NS
        expected = list(range(20 * MS, end_ns + 1, 20 * MS))
        assert [m.stamp_ns for m in drain(pictures, least=len(expected))] == expected


def test_pause_ends_steps_that_wait_for_a_command(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("neurosim_core.live.simulator.FIRST_STEP_S", 4 * SOON_S)
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        rig.call("/pause", Trigger())
        rig.wait_for_status(lambda status: status.phase == "paused")  # "waiting" is said before, too
        replies: list[Any] = []
        stepping = threading.Thread(target=lambda: replies.append(rig.call("/step", Step(count=5))))
        stepping.start()
        rig.wait_for_status(lambda status: status.phase == "waiting")
        assert rig.call("/pause", Trigger()).accepted
        stepping.join(SOON_S)
        assert not replies[0].accepted
        assert replies[0].reason == "paused"


def test_steps_before_the_first_command_are_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("neurosim_core.live.simulator.FIRST_STEP_S", 0.1)
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        rig.call("/pause", Trigger())
        reply = rig.call("/step", Step(count=5))
        assert not reply.accepted
        assert reply.reason == "no command for drone has come yet: time begins with the first"
        assert reply.phase == "paused"


def _first(rig: LiveRig, count: int = 6) -> list[bytes]:
    """The first samples of a run, which carry noise, as bytes."""
    imu = rig.listen("/drone/imu", Imu)
    odometry = rig.listen("/drone/odometry", Odometry)
    while odometry.recv(SOON_S).stamp_ns != 0:
        pass
    rig.send(rig.hover(), stamp_ns=0)
    samples = [imu.recv(SOON_S) for _ in range(3)]
    imu.close()
    odometry.close()
    return [m.stamp_ns.to_bytes(8, "little") + m.specific_force.tobytes() for m in samples]


def test_reset_is_a_fresh_start():
    """Seed and start give the same first packets as a fresh simulator, whatever was flown before."""
    start = {"position": np.array([0.5, 0.25, 1.5]), "velocity": np.array([0.5, 0.0, 0.0])}
    with LiveRig(make_config(**LOCKSTEP, seed=7)) as rig:
        fresh = _first(rig)
    with LiveRig(make_config(**LOCKSTEP, seed=3)) as rig:
        other = _first(rig)
        odometry = rig.listen("/drone/odometry", Odometry)
        reply = rig.call("/reset", Reset(seed=7))
        assert reply.accepted
        assert (reply.stamp_ns, reply.phase) == (0, "waiting")
        again = _first(rig)
        assert rig.call("/reset", Reset(**start)).accepted
        while (moved := odometry.recv(SOON_S)).position.tolist() != start["position"].tolist():
            pass
        assert drain(odometry, 0.02) == []
    assert again == fresh
    assert other != fresh
    assert moved.stamp_ns == 0
    assert moved.velocity.tolist() == [0.5, 0.0, 0.0]
    assert moved.sequence == 0


def test_resets_that_cannot_be_are_refused():
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        assert "known: drone" in rig.call("/reset", Reset(vehicle="plane")).reason
        assert "seed" in rig.call("/reset", Reset(seed=-1)).reason
        assert rig.call("/reset", Reset(position=np.array([np.nan, 0.0, 0.0]))).reason
        assert rig.simulator.phase == "waiting"


def test_a_command_of_before_the_reset_comes_too_late():
    with LiveRig(make_config(**{"live.real_time_factor": 0.0})) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        rig.send(rig.hover())
        while (last_ns := odometry.recv(SOON_S).stamp_ns) < 50 * MS:
            pass
        rig.call("/reset", Reset())
        rig.send(rig.hover(), stamp_ns=last_ns)
        rig.wait_for_status(lambda status: status.vehicles[0].superseded_count == 1)
        assert rig.simulator.phase == "waiting"
        rig.send(rig.hover(), stamp_ns=0)
        rig.wait_for_status(lambda status: status.phase == "running")


def test_parameters_change_while_it_runs():
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        states = rig.fly(odometry, 2)
        assert rig.set({"live.fail_safe": "cut"}).accepted
        assert rig.simulator.vehicles[0].hold.live.fail_safe == "cut"
        assert rig.set({"links.odometry.latency_s": 0.008}).accepted
        rig.send(rig.hover(), stamp_ns=states[-1].stamp_ns)
        assert odometry.recv(SOON_S).stamp_ns == 15 * MS  # at tick 5
        wait_for(lambda: rig.simulator.stamp_ns == 25 * MS)
        refused = rig.set({"scene.rooms": 3})
        assert not refused.accepted
        assert "live.real_time_factor" in refused.reason


def test_gains_change_in_flight():
    row = [0.0, 0.0, 1.4, 0.0]
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        states = rig.fly(odometry, 3, lambda state: ("position", row))
        before = models_of(rig.config)["drone"]
        assert rig.set({"control.gains.position_gain_per_s2": 2.0}).accepted
        rig.send(row, mode="position", stamp_ns=states[-1].stamp_ns)
        after = odometry.recv(SOON_S)
        changed = rig.simulator.vehicles[0].model
    state = make_state(before)
    for _ in range(3):
        step(before, state, row, mode="position")
    assert same(states[-1], observe(state))
    forget_controllers(state)
    step(changed, state, row, mode="position")
    assert same(after, observe(state))
    assert changed.config.control.gains.position_gain_per_s2 == 2.0


# Ends


def test_a_collision_ends_the_run_until_the_reset():
    config = make_config(**{"vehicle.on_collision": "end", "live.real_time_factor": 0.0})
    with LiveRig(config) as rig:
        collisions = rig.listen("/drone/collision", Collision)
        rig.send(np.zeros(4))  # it falls
        ended = rig.wait_for_status(lambda status: status.phase == "ended")
        assert "drone collided at" in ended.reason
        assert collisions.recv(SOON_S).clearance_m <= 0.0
        assert not rig.call("/step", Step()).accepted
        assert rig.call("/reset", Reset()).phase == "waiting"
        rig.send(rig.hover())
        rig.wait_for_status(lambda status: status.phase == "running")


def test_motion_that_cannot_be_computed_ends_the_run():
    with LiveRig(make_config(**{"live.real_time_factor": 0.0})) as rig:
        assert rig.call("/reset", Reset(body_rate=np.array([1e9, 0.0, 0.0]))).accepted
        rig.send(rig.hover())
        ended = rig.wait_for_status(lambda status: status.phase == "ended")
        assert "the motion of drone cannot be computed" in ended.reason
        assert rig.call("/reset", Reset()).accepted


def test_the_end_of_the_flight_is_the_end_where_it_does_not_run_on():
    with LiveRig(make_config(duration_s=0.05, **{"live.run_on": False}, **LOCKSTEP)) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        rig.fly(odometry, 10)
        assert rig.join() == 0
        assert rig.simulator.reason == "the 0.05 s are over"


# Several vehicles, recording


def test_several_vehicles_fly_in_one_world():
    """Time waits for all; they report each other's touch."""
    config = make_config(
        **LOCKSTEP,
        sensors={"imu": IMU},
        vehicles={"red": {}, "blue": {"vehicle": {"preset": "crazyflie", "on_collision": "report"}}},
    )
    with LiveRig(config) as rig:
        states = {name: rig.listen(f"/{name}/odometry", Odometry) for name in ("red", "blue")}
        touches = {name: rig.listen(f"/{name}/collision", Collision) for name in ("red", "blue")}
        clock = rig.listen("/clock", Clock)
        samples = [rig.listen(f"/{name}/imu", Imu) for name in ("red", "blue")]
        first = {name: subscriber.recv(SOON_S) for name, subscriber in states.items()}
        rig.send(rig.hover("red"), vehicle="red")
        with pytest.raises(TimeoutError):
            clock.recv(0.05)
        rig.send(rig.hover("blue"), vehicle="blue")
        assert clock.recv(SOON_S).stamp_ns == PERIOD_NS
        assert [s.recv(SOON_S).stamp_ns for s in samples] == [0, 0]
        force = [s.recv(SOON_S).specific_force.tolist() for s in samples]
        assert force[0] != force[1]  # noise of their own
        touch = [drain(touches[name], 0.02, least=1) for name in ("red", "blue")]
        assert touch[0][0].clearance_m == pytest.approx(-0.4)  # they start at one place
        assert [len(found) for found in touch] == [1, 1]
        near = first["red"].position + np.array([0.3, 0.0, 0.0])
        refused = rig.call("/reset", Reset(position=near))
        assert "one of red, blue" in refused.reason
        assert rig.call("/reset", Reset(vehicle="blue", position=near)).accepted
        for name in ("red", "blue"):
            rig.send(rig.hover(name), vehicle=name)
        touch = [touches[name].recv(SOON_S) for name in ("red", "blue")]
        assert [m.stamp_ns for m in touch] == [PERIOD_NS, PERIOD_NS]
        assert touch[0].clearance_m == pytest.approx(0.3 - 0.4, abs=1e-3)
        status = rig.wait_for_status(lambda status: status.vehicles[1].collision_count)
        for name in ("red", "blue"):
            rig.send(rig.hover(name), vehicle=name, stamp_ns=PERIOD_NS)
        rig.wait_for_status(lambda status: status.step_count == 2)
        assert drain(touches["red"], 0.02) == []  # the same touch
        assert [vehicle.name for vehicle in status.vehicles] == ["red", "blue"]


@pytest.mark.parametrize("mode", ["lockstep", "streaming"])
def test_what_is_recorded_is_what_was_published(tmp_path: Path, mode: str):
    config = make_config(
        duration_s=0.1,
        links={"imu": {"latency_s": 0.01}},
        **{"live.mode": mode, "live.run_on": False, "live.real_time_factor": 0.0},
    )
    with LiveRig(config, record=tmp_path / "flight") as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        imu = rig.listen("/drone/imu", Imu)
        rgb = rig.listen("/drone/rgb", Image)
        events = rig.listen("/drone/events", Events)
        if mode == "lockstep":
            rig.fly(odometry, 20)
        else:
            rig.send(rig.hover())
        assert rig.join() == 0
        samples, pictures, windows = drain(imu, least=37), drain(rgb, least=6), drain(events, least=10)
    with Recording(tmp_path / "flight" / "flight.h5") as flight:
        packets: dict[str, list[Any]] = {}
        for packet in flight.packets():
            packets.setdefault(packet.sensor, []).append(packet)
        assert load_config(yaml.safe_load(flight.header.config_yaml)) == config.of("drone")
    assert [p.stamp_ns for p in packets["odometry"]] == [PERIOD_NS * k for k in range(21)]
    assert all(isinstance(p, Delivery) for p in packets["imu_link"])
    assert len(packets["imu"]) == len(packets["imu_link"]) == 41
    assert len(samples) == 37  # up to 90 ms: the others were under way
    assert all(
        np.array_equal(m.specific_force, p.specific_force)
        for m, p in zip(samples, packets["imu"], strict=False)
    )
    assert [m.stamp_ns for m in pictures] == [p.stamp_ns for p in packets["rgb"]]
    assert all(np.array_equal(m.data, p.data) for m, p in zip(pictures, packets["rgb"], strict=True))
    assert [len(m.t) for m in windows] == [len(p) for p in packets["events"]]
    assert (tmp_path / "flight" / "config.yaml").exists()


@pytest.mark.parametrize("mode", ["lockstep", "streaming"])
def test_the_end_of_a_run_keeps_what_is_under_way(monkeypatch: pytest.MonkeyPatch, mode: str):
    """Pictures that were not ready, and the events of a window that has not ended."""
    _with_slow_cameras(monkeypatch, 0.05)
    live = {"live.mode": mode, "live.run_on": False, "live.real_time_factor": 0.0}
    with LiveRig(make_config(duration_s=0.025, **live)) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        rgb = rig.listen("/drone/rgb", Image)
        events = rig.listen("/drone/events", Events)
        if mode == "lockstep":
            rig.fly(odometry, 5)
        else:
            rig.send(rig.hover())
        assert rig.join() == 0
        assert [m.stamp_ns for m in drain(rgb, least=2)] == [0, 20 * MS]
        assert [(m.start_ns, m.stamp_ns) for m in drain(events, least=3)] == [
            (0, 10 * MS),
            (10 * MS, 20 * MS),
            (20 * MS, 25 * MS),
        ]


def test_a_recording_is_not_replaced_unasked_and_resets_begin_new_files(tmp_path: Path):
    config = make_config(**LOCKSTEP)
    with LiveRig(config, record=tmp_path) as rig:
        odometry = rig.listen("/drone/odometry", Odometry)
        rig.call("/reset", Reset(seed=4))  # nothing was flown
        rig.send(rig.hover(), stamp_ns=0)
        while odometry.recv(SOON_S).stamp_ns == 0:
            pass
        rig.call("/reset", Reset(seed=5))
    assert sorted(path.name for path in tmp_path.glob("*.h5")) == ["flight-2.h5", "flight.h5"]
    with Recording(tmp_path / "flight.h5") as flight:
        stamps = [p.stamp_ns for p in flight.packets() if p.sensor == "odometry"]
        assert stamps == [0, PERIOD_NS]
        assert flight.header.seed == 4
    with pytest.raises(FileExistsError, match="already holds a flight"):
        LiveRig(config, record=tmp_path)
    with LiveRig(config, record=tmp_path, overwrite=True):
        pass
    assert not (tmp_path / "flight-2.h5").exists()


def test_status_is_told_about_five_times_a_second():
    with LiveRig(make_config(**LOCKSTEP)) as rig:
        status = rig.listen("/status", SimulatorStatus)
        first, second = status.recv(SOON_S), status.recv(SOON_S)
        assert second.wall_ns - first.wall_ns >= 190 * MS
        assert second.sequence == first.sequence + 1
        wait_for(lambda: status.recv(SOON_S).phase == "waiting")


# Bodies


@pytest.mark.parametrize("mode", ["lockstep", "streaming"])
def test_a_body_is_brought_in_and_taken_out(mode: str, tmp_path: Path):
    """By /set_parameters, whose answer comes when what was flown before has been rendered without it."""
    lens = {"width": 32, "height": 24, "horizontal_fov_rad": 1.2}
    depth = {"kind": "depth", "lens": lens, "rate_hz": 100}
    config = make_config(
        sensors={"depth": depth},
        **{
            "live.mode": mode,
            "live.command_every": 1000,
            "live.real_time_factor": 0.0,
            "renderer": "warp",
            "scene": room_scene(tmp_path),
            "path": {"kind": "hover", "position_m": [0.0, 0.0, 1.5]},
            "bodies": {"box": {"shape": {"kind": "box", "size_m": [0.5, 2.0, 2.0]}, "present": False}},
        },
    )

    def ask(rig: LiveRig, **values: Any) -> str:
        values = {f"bodies.box.{name.replace('__', '.')}": value for name, value in values.items()}
        return rig.call("/set_parameters", Parameters.of(values)).reason

    with LiveRig(config) as rig:
        pictures = rig.listen("/drone/depth", Image)
        announced = rig.listen("/simulation", Simulation)
        assert rig.call("/pause", Trigger()).accepted
        rig.send(rig.hover())

        def sees(stamp_ns: int) -> float:
            """Fly on to a stamp, and return how far it is to what is ahead then [m]."""
            begin_ns = rig.simulator.stamp_ns
            assert rig.call(
                "/step", Step(count=(stamp_ns - begin_ns) // PERIOD_NS, timeout_s=SOON_S)
            ).accepted
            while (picture := pictures.recv(SOON_S)).stamp_ns < stamp_ns:
                pass
            return float(picture.data[12, 16, 0])

        empty_m = sees(4 * PERIOD_NS)
        assert empty_m > 3.0
        assert ask(rig, present=True, motion__position_m="[2.0, 0.0, 1.5]") == ""
        assert sees(8 * PERIOD_NS) == pytest.approx(empty_m - (4.0 - 1.75), abs=0.02)
        assert ask(rig, motion__position_m="[2.5, 0.0, 1.5]") == ""
        assert sees(12 * PERIOD_NS) == pytest.approx(empty_m - (4.0 - 2.25), abs=0.02)
        assert ask(rig, present=False) == ""
        assert sees(16 * PERIOD_NS) == pytest.approx(empty_m, abs=0.02)
        said = [yaml.safe_load(each.config)["bodies"]["box"]["present"] for each in drain(announced, least=4)]
        assert said == [False, True, True, False]
        assert (
            "no body is called"
            in rig.call("/set_parameters", Parameters.of({"bodies.x.present": True})).reason
        )
