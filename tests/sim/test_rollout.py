"""A run as a whole: order, determinism, independence of how it is cut, collisions, failures."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from controller_commands import command_of
from core_counts import cores

import neurosim_core as ns
from neurosim_core import sim
from neurosim_core.control import Controller
from neurosim_core.packets import Collision, Events, Image, ImuSample, Odometry, Packet
from neurosim_core.runtime import cuda
from neurosim_core.runtime.pinned import PinnedMapping
from neurosim_core.vehicle import DynamicsError

LENS = {"width": 48, "height": 36, "horizontal_fov_rad": 1.5}
SENSORS = {
    "events": {"kind": "event_camera", "lens": LENS, "sampling_rate_hz": 500, "packet_rate_hz": 100},
    "rgb": {"kind": "rgb", "lens": LENS, "rate_hz": 20},
    "depth": {"kind": "depth", "lens": LENS, "rate_hz": 50},
    "imu": {
        "kind": "imu",
        "rate_hz": 333,
        "gyroscope_noise_density": 1e-3,
        "accelerometer_noise_density": 1e-2,
    },
    "odometry": {"kind": "odometry", "rate_hz": 200},
}
THROUGH_THE_WALL = {
    "kind": "line",
    "start_m": [0.0, 0.0, 1.5],
    "end_m": [0.0, 4.0, 1.5],
    "speed_max_m_s": 6.0,
}


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """A room of 6 x 4 x 3 m with a few coloured boxes on the floor, z up, its middle at (0, 0, 1.5)."""
    scene = trimesh.Scene()
    walls = trimesh.creation.box(extents=[6.0, 4.0, 3.0])
    walls.invert()
    walls.apply_translation([0.0, 0.0, 1.5])
    scene.add_geometry(walls, node_name="walls")
    rng = np.random.default_rng(0)
    for index in range(12):
        box = trimesh.creation.box(extents=rng.uniform(0.2, 0.6, size=3))
        angle = 0.5 * index
        box.apply_translation([2.6 * np.cos(angle), 1.7 * np.sin(angle), 0.5 + 0.2 * index % 2.0])
        color = [*rng.uniform(0.0, 1.0, size=3), 1.0]
        box.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(baseColorFactor=color)
        )
        scene.add_geometry(box, node_name=f"box_{index}")
    path = tmp_path_factory.mktemp("scene") / "room.glb"
    scene.export(path)
    return path


@pytest.fixture
def settings(room: Path, device: str) -> dict[str, Any]:
    return {
        "duration_s": 0.2,
        "device": device,
        "scene": {
            "kind": "mesh",
            "file": str(room),
            "up_axis": "z",
            "unit_m": 1.0,
            "inside_m": [0.0, 0.0, 1.5],
        },
        "render": {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1},
        "path": {"kind": "line", "start_m": [-1.0, 0.0, 1.5], "end_m": [1.0, 0.3, 1.4]},
        "sensors": SENSORS,
    }


def fly(settings: dict[str, Any], **overrides: Any) -> list[Packet]:
    return list(ns.run({**settings, **overrides}))


def fly_ahead(settings: dict[str, Any], lane_count: int, **overrides: Any) -> list[Packet]:
    """Fly with so many batches under way; on a CPU they are done one after the other, but read as late."""
    model = sim.make_model(ns.load_config({**settings, **overrides}))
    return list(sim.run_model(model, sim.make_state(model, in_flight=lane_count)))


def of(packets: list[Packet], sensor: str) -> list[Any]:
    return [packet for packet in packets if packet.sensor == sensor]


def content(packets: list[Packet]) -> list[tuple[Any, ...]]:
    """All bytes of the packets, to compare runs."""

    def plain(value: Any) -> Any:
        return (value.dtype.str, value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value

    return [(type(p).__name__, *((k, plain(v)) for k, v in sorted(vars(p).items()))) for p in packets]


def test_packets_come_in_order_and_none_is_missing(settings):
    packets = fly(settings)
    order = [(p.stamp_ns, list(SENSORS).index(p.sensor)) for p in packets]
    assert order == sorted(order)
    for name, count in (("rgb", 5), ("depth", 11), ("odometry", 41), ("imu", 67), ("events", 20)):
        assert [p.sequence for p in of(packets, name)] == list(range(count))
    assert [p.stamp_ns for p in of(packets, "imu")][:3] == [0, 3_003_003, 6_006_006]
    assert [p.stamp_ns for p in of(packets, "rgb")] == [k * 50_000_000 for k in range(5)]


def test_two_runs_give_the_same_bytes(settings):
    assert content(fly(settings)) == content(fly(settings))


@pytest.mark.parametrize("instants", [1, 3, 64])
def test_packets_do_not_depend_on_the_size_of_a_launch(settings, instants):
    assert content(fly(settings, instants_per_launch=instants)) == content(fly(settings))


@pytest.mark.parametrize("lane_count", [1, 2, 3])
@pytest.mark.parametrize("instants", [4, 64])
def test_packets_do_not_depend_on_the_batches_under_way(settings, lane_count, instants):
    """Also where events are many: the buffers for them grow, and scans are done again."""
    events = {**SENSORS["events"], "pixel": {"threshold_on": 0.01, "threshold_off": 0.01}}
    settings = {**settings, "sensors": {**SENSORS, "events": events}}
    ahead = fly_ahead(settings, lane_count, instants_per_launch=instants)
    assert content(ahead) == content(fly(settings))


def test_a_run_that_was_broken_off_can_go_on(settings):
    """What was under way is not lost, and nothing but `run_model` may follow."""
    model = sim.make_model(ns.load_config({**settings, "instants_per_launch": 8}))
    state = sim.make_state(model, in_flight=3)
    packets: list[Packet] = []
    for packet in sim.run_model(model, state):
        packets.append(packet)
        if packet.stamp_ns == state.stamp_ns == 80_000_000:
            break
    with pytest.raises(RuntimeError, match="interrupted"):
        sim.advance(model, state, 96_000_000)
    last = packets[-1]
    packets += sim.run_model(model, state)

    def others(packets: list[Packet]) -> list[Packet]:
        """Without those of the stamp where it broke off: it had another, which nobody took."""
        return [packet for packet in packets if packet.stamp_ns != last.stamp_ns]

    assert content(others(packets)) == content(others(fly(settings)))


def test_a_sensor_does_not_change_the_others(settings):
    """Whether pictures, IMU or odometry exist changes no event, although they share casts and boundaries."""
    alone = fly({**settings, "sensors": {"events": SENSORS["events"]}})
    together = of(fly(settings), "events")
    events = of(alone, "events")
    # the integration is cut at other stamps: positions differ by rounding and truncation, not by a pixel
    assert sum(len(e) for e in events) == pytest.approx(sum(len(e) for e in together), rel=1e-3)


def test_another_seed_changes_noise_and_nothing_else(settings):
    one, two = fly(settings), fly(settings, seed=1)
    assert content(of(one, "odometry")) == content(of(two, "odometry"))
    assert content(of(one, "events")) == content(of(two, "events"))
    assert content(of(one, "imu")) != content(of(two, "imu"))


def test_hovering_gives_no_event_and_reads_gravity(settings):
    packets = fly(
        settings,
        path={"kind": "hover", "position_m": [0.0, 0.0, 1.5]},
        sensors={"imu": {"kind": "imu", "rate_hz": 400}, "events": SENSORS["events"]},
    )
    assert sum(len(p) for p in of(packets, "events")) == 0
    for packet in of(packets, "imu"):
        assert isinstance(packet, ImuSample)
        np.testing.assert_allclose(packet.specific_force, [0.0, 0.0, 9.81], atol=1e-6)
        np.testing.assert_allclose(packet.angular_rate, 0.0, atol=1e-6)


def test_the_vehicle_follows_the_path(settings):
    config = ns.load_config({**settings, "duration_s": 1.0, "sensors": {"odometry": SENSORS["odometry"]}})
    model = sim.make_model(config)
    state = sim.make_state(model)
    for packet in sim.run_model(model, state):
        assert isinstance(packet, Odometry)
        wanted = model.path.evaluate([packet.stamp_ns]).position[0]
        assert np.linalg.norm(packet.position - wanted) < 0.02
    assert state.stamp_ns == model.duration_ns
    assert model.scene_on_device is None  # nobody looks: nothing is rendered


def test_depth_is_what_the_room_says(settings):
    """From its middle, looking along x, the wall is 3 m away and the camera 0.1 m ahead of the body."""
    depth = {"kind": "depth", "lens": LENS, "mount": {"position_m": [0.1, 0.0, 0.0]}, "rate_hz": 10}
    packets = fly(settings, path={"kind": "hover", "position_m": [0.0, 0.0, 1.5]}, sensors={"depth": depth})
    image = packets[0]
    assert isinstance(image, Image)
    assert (image.encoding, image.data.dtype, image.data.shape) == ("32FC1", np.float32, (36, 48))
    assert np.median(image.data[12:18, 22:26]) == pytest.approx(2.9, abs=0.5)  # boxes stand before the wall
    assert image.data.max() == pytest.approx(2.9, abs=1e-4)


def test_a_collision_ends_the_run_or_is_reported(settings):
    settings = {
        **settings,
        "path": THROUGH_THE_WALL,
        "duration_s": 1.5,
        "sensors": {"odometry": SENSORS["odometry"]},
    }
    ended = fly(settings)
    hit = ended[-1]
    assert isinstance(hit, Collision)
    assert -0.05 < hit.clearance_m <= 0.0  # 5 ms between checks at up to 6 m/s
    assert hit.position[1] == pytest.approx(2.0 - 0.2, abs=0.06)
    assert max(p.stamp_ns for p in ended) == hit.stamp_ns

    reported = fly(settings, vehicle={"on_collision": "report"})
    assert of(reported, "collision")[0].stamp_ns == hit.stamp_ns
    assert reported[-1].stamp_ns == 1_500_000_000
    assert content([p for p in reported if p.stamp_ns <= hit.stamp_ns]) == content(ended)


def test_where_a_collision_ends_does_not_depend_on_the_size_of_a_launch(settings):
    settings = {**settings, "path": THROUGH_THE_WALL, "duration_s": 1.5}
    ended = content(fly(settings))
    assert content(fly(settings, instants_per_launch=5)) == ended
    for lane_count in (1, 3):
        assert content(fly_ahead(settings, lane_count, instants_per_launch=5)) == ended


def test_an_outside_controller_flies_the_same(settings):
    """`step` with the commands of the path controller gives the packets of `run`, byte for byte."""
    config = ns.load_config(settings)
    expected = fly(settings)
    model = sim.make_model(config)
    inside, outside = sim.make_state(model), sim.make_state(model)
    inside.path_controller.update(inside.vehicle.arrays)
    packets: list[Packet] = []
    while outside.stamp_ns < model.duration_ns:
        outside_now = outside.vehicle.arrays
        inside.path_controller.update(outside_now)
        packets += ns.step(model, outside, outside_now.rotor_speed_command.numpy()[0])
    packets += sim.finish(outside)
    assert content(packets) == content(expected)


def test_a_vehicle_that_cannot_be_integrated_is_an_error(settings):
    """The packets before it are not lost."""
    config = ns.load_config({**settings, "sensors": {"odometry": SENSORS["odometry"]}})
    model = sim.make_model(config)
    state = sim.make_state(model)
    packets = sim.start(model, state)
    state.vehicle.arrays.body_rate.assign([[1e9, 1e9, 1e9]])
    packets += sim.advance(model, state, 80_000_000)
    assert isinstance(state.failure, DynamicsError)
    assert max(p.stamp_ns for p in packets) <= state.failure.stamp_ns == state.stamp_ns


@pytest.mark.parametrize("lane_count", [1, 3])
def test_a_failure_comes_after_the_packets_before_it(settings, lane_count):
    """It is raised where its batch is read, though later ones were launched."""
    sensors = {"odometry": SENSORS["odometry"], "events": SENSORS["events"]}
    model = sim.make_model(ns.load_config({**settings, "instants_per_launch": 8, "sensors": sensors}))
    state = sim.make_state(model, in_flight=lane_count)
    packets = sim.start(model, state)
    for end_ns in (16_000_000, 32_000_000):
        packets += sim.advance(model, state, end_ns)
    state.vehicle.arrays.body_rate.assign([[1e9, 1e9, 1e9]])
    with pytest.raises(DynamicsError) as caught:
        packets.extend(sim.run_model(model, state))
    assert caught.value.stamp_ns == 32_000_000
    assert state.stamp_ns == 32_000_000
    assert content(packets) == content(
        [p for p in fly({**settings, "sensors": sensors}) if p.stamp_ns <= 32_000_000]
    )


def test_the_last_packet_of_events_ends_with_the_run(settings):
    """A window that the run does not complete is cut at the last instant in it."""
    events = of(fly({**settings, "duration_s": 0.1155}), "events")
    assert [e.stamp_ns for e in events[-2:]] == [110_000_000, 114_000_000]
    assert events[-1].start_ns == 110_000_000


def test_events_of_a_run_are_sorted_within_their_windows(settings):
    for packet in of(fly(settings), "events"):
        assert isinstance(packet, Events)
        t = packet.numpy().t
        assert (np.diff(t) >= 0).all()
        assert ((t * 1000 > packet.start_ns - 1000) & (t * 1000 <= packet.stamp_ns)).all()


def test_leaving_the_scene_is_no_collision(settings):
    """Above a room without a roof, or beside a lone wall, there is nothing to hit."""
    outside = {"kind": "hover", "position_m": [0.0, 0.0, 9.0]}
    packets = fly({**settings, "path": outside, "sensors": {"odometry": SENSORS["odometry"]}})
    assert not of(packets, "collision")
    assert packets[-1].stamp_ns == 200_000_000


def test_an_unknown_device_is_named(settings):
    with pytest.raises(ValueError, match="cuda:77"):
        fly(settings, device="cuda:77")


# Flying for commands from outside


@pytest.fixture
def outside_model(settings) -> sim.Model:
    return sim.make_model(settings)


def hover(model: sim.Model) -> np.ndarray:
    return np.full(model.airframe.rotor_count, model.airframe.hover_rotor_speed_rad_s)


def test_cameras_in_another_thread_yield_the_same(outside_model):
    """`integrate_period` and `render_batch` give the packets of `step`, however far the flight is ahead."""
    model, command = outside_model, 1.01 * hover(outside_model)
    together = sim.make_state(model)
    expected = [p for _ in range(10) for p in sim.step(model, together, command)]
    apart = sim.make_state(model, render_backlog=32)
    packets, waiting = [], []
    for _ in range(10):
        flown, batches = sim.integrate_period(model, apart, command)
        packets += flown
        waiting += batches
    assert apart.counts["renders"] == 0
    for batch in waiting:
        packets += sim.render_batch(model, apart, batch)
    rank = {name: index for index, name in enumerate([*model.config.sensors, sim.COLLISION])}
    packets.sort(key=lambda p: (p.stamp_ns, rank[p.sensor]))
    assert content(packets) == content(expected)
    assert sim.observe(apart).position.tobytes() == sim.observe(together).position.tobytes()


def test_pictures_are_the_same_where_the_caller_has_room(outside_model):
    """Whoever gives memory for some of the pictures finds there what it would have got otherwise."""
    model, command = outside_model, 1.01 * hover(outside_model)
    rooms: list[np.ndarray] = []
    asked: list[str] = []

    def allocate_picture(name: str, stamp_ns: int, picture: np.ndarray) -> np.ndarray | None:
        asked.append(name)
        if len(asked) % 2:
            return None
        rooms.append(np.full_like(picture, 77))
        return rooms[-1]

    def fly_all(state: sim.State) -> list[Packet]:
        packets = []
        for _ in range(10):
            _, batches = sim.integrate_period(model, state, command)
            packets += [packet for batch in batches for packet in sim.render_batch(model, state, batch)]
        return packets

    expected = fly_all(sim.make_state(model, render_backlog=32))
    packets = fly_all(sim.make_state(model, render_backlog=32, allocate_picture=allocate_picture))
    assert content(packets) == content(expected)
    pictures = [packet for packet in packets if isinstance(packet, Image)]
    assert len(pictures) == len(asked) > 4
    assert sum(any(picture.data is room for room in rooms) for picture in pictures) == len(asked) // 2


def fly_steps(model: sim.Model, state: sim.State, count: int, *, ahead: bool) -> list[Packet]:
    """Packets of control periods in two parts, each planned ahead or not, with a camera off now and then."""
    command = 1.01 * hover(model)
    packets: list[Packet] = []
    for number in range(count):
        begun = sim.begin_step(model, state, command)
        with pytest.raises(RuntimeError, match="in flight"):
            sim.begin_step(model, state, command)
        packets += sim.end_step(model, state, begun)
        if ahead:
            sim.prepare_step(model, state)
        if number % 7 == 3:
            wanted = {"events", "rgb", "depth"} if number % 2 else {"rgb"}
            sim.select_cameras(model, state, wanted & set(model.config.sensors))
    return packets


@pytest.mark.parametrize("without", [(), ("events",), ("events", "rgb", "depth")])
def test_steps_in_two_parts_are_the_same(settings, without):
    """`begin_step` and `end_step` are `step`, planned ahead or not, whatever changes after the planning."""
    sensors = {name: sensor for name, sensor in SENSORS.items() if name not in without}
    model = sim.make_model(ns.load_config({**settings, "sensors": sensors}))
    found = [fly_steps(model, sim.make_state(model), 30, ahead=ahead) for ahead in (False, True)]
    assert content(found[0]) == content(found[1])
    together = sim.make_state(model)
    expected = [p for _ in range(4) for p in sim.step(model, together, 1.01 * hover(model))]
    assert content(found[0][: len(expected)]) == content(expected)


@pytest.mark.parametrize("instants", [1, 4])
def test_borrowed_pictures_are_those_of_the_step(settings, instants):
    """Of stamp 0, and of all batches of a control period: none is overwritten before the next step."""
    sensors = {**SENSORS, "rgb": {**SENSORS["rgb"], "rate_hz": 400}}
    model = sim.make_model(ns.load_config({**settings, "sensors": sensors, "instants_per_launch": instants}))
    states = [sim.make_state(model, in_flight=1, borrow_pictures=borrow) for borrow in (False, True)]
    for number in range(4):
        command = (1.0 + 0.1 * number) * hover(model)
        own, borrowed = (sim.step(model, state, command) for state in states)
        assert content(borrowed) == content(own)
        assert sum(packet.sensor == "rgb" for packet in own) == (3 if number == 0 else 2)


def test_only_images_are_lent(settings):
    """Packets of other types keep their picture: who records them later has it as it was."""
    lens = {"width": 12, "height": 8, "horizontal_fov_rad": 1.5}
    sensors = {"radiance": {"kind": "log_radiance", "rate_hz": 100, "lens": lens}}
    model = sim.make_model(ns.load_config({**settings, "sensors": sensors}))
    state = sim.make_state(model, in_flight=1, borrow_pictures=True)
    packets = [packet for _ in range(4) for packet in sim.step(model, state, 1.05 * hover(model))]
    before = [np.array(packet.data) for packet in packets]
    for _ in range(4):
        sim.step(model, state, 1.05 * hover(model))
    assert not np.array_equal(before[0], before[-1])
    for packet, data in zip(packets, before, strict=True):
        np.testing.assert_array_equal(packet.data, data)


class LateCopies:
    """Copies to the host are done when somebody waits for a milestone that was set after them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.waiting: list[Callable[[], None]] = []
        due: dict[int, list[Callable[[], None]]] = {}

        def late(copy: cuda.HostCopy, room: np.ndarray, row: int) -> None:
            self.waiting.append(functools.partial(np.copyto, room, copy.rows(row, 1)[0]))

        def wait(milestone: cuda.Fence) -> None:
            for operation in due.pop(id(milestone), ()):
                if operation in self.waiting:
                    operation()
                    self.waiting.remove(operation)

        monkeypatch.setattr(cuda.HostCopy, "fetch_into", late)
        monkeypatch.setattr(cuda.Fence, "set", lambda m: due.update({id(m): list(self.waiting)}))
        monkeypatch.setattr(cuda.Fence, "wait", wait)


def test_launches_are_others_when_memory_was_pinned_anew(settings, monkeypatch):
    """The same addresses may be those of a mapping that is gone: a graph of them is not replayed."""
    keys: list[Any] = []

    def launch(graphs: cuda.GraphCache, key: Any, launch: Callable[[], Any], **_: Any) -> None:
        keys.append(key)
        launch()

    monkeypatch.setattr(cuda.GraphCache, "run", launch)
    sensors = {"rgb": {**SENSORS["rgb"], "rate_hz": 200}}
    model = sim.make_model(ns.load_config({**settings, "device": "cpu", "sensors": sensors}))
    room = np.zeros((LENS["height"], LENS["width"], 3), np.uint8)
    state = sim.make_state(model, in_flight=1, allocate_picture=lambda *_: room)
    for _ in range(8):
        sim.step(model, state, None)
    known = set(keys)
    assert len(known) < len(keys)
    keys.clear()
    sim.step(model, state, None)
    again = set(keys)
    monkeypatch.setattr(PinnedMapping, "made_count", PinnedMapping.made_count + 1)
    keys.clear()
    sim.step(model, state, None)
    assert again <= known
    assert set(keys) - known


@pytest.mark.parametrize("names", [("rgb",), ("rgb", "depth"), ("events", "rgb", "depth")])
def test_a_device_writes_pictures_into_room_of_the_caller(settings, monkeypatch, names):
    """They are there after `settle`; nothing waits for them where there is nothing else."""
    copies = LateCopies(monkeypatch)
    sensors = {name: {**SENSORS[name], "rate_hz": 100.0} for name in names if name != "events"}
    if "events" in names:
        sensors["events"] = SENSORS["events"]
    model = sim.make_model(ns.load_config({**settings, "device": "cpu", "sensors": sensors}))
    command = 1.01 * hover(model)
    together = sim.make_state(model)
    expected = [p for _ in range(10) for p in sim.step(model, together, command)]
    rooms: list[np.ndarray] = []

    def allocate_picture(name: str, stamp_ns: int, picture: np.ndarray) -> np.ndarray | None:
        rooms.append(np.full_like(picture, 77))
        return rooms[-1]

    state = sim.make_state(model, allocate_picture=allocate_picture)
    packets = []
    unfinished_count = 0
    for _ in range(10):
        some = sim.step(model, state, command)
        unfinished_count += bool(copies.waiting)
        sim.settle(state)
        assert not copies.waiting
        packets += some
    assert content(packets) == content(expected)
    pictures = [packet for packet in packets if isinstance(packet, Image)]
    assert len(pictures) == len(rooms) > 5
    assert all(picture.data is room for picture, room in zip(pictures, rooms, strict=True))
    assert (unfinished_count > 4) == ("events" not in names)


def test_flying_further_than_the_cameras_can_follow_is_an_error(outside_model):
    state = sim.make_state(outside_model, in_flight=1, render_backlog=3)
    sim.integrate_period(outside_model, state, None)  # the start and one period
    assert sim.render_backlog_left(state) == 1
    sim.integrate_period(outside_model, state, None)
    with pytest.raises(RuntimeError, match="3 batches wait"):
        sim.integrate_period(outside_model, state, None)


def test_what_is_left_out_shows(outside_model):
    """Pictures miss in the sequence; a window of events is longer, and what happened in it is not lost."""
    model, command = outside_model, 1.02 * hover(outside_model)
    state = sim.make_state(model, render_backlog=32)
    packets, left_out = [], 0
    for period in range(24):
        _, batches = sim.integrate_period(model, state, command)
        for batch in batches:
            if 8 <= period < 12:
                left_out += sim.skip_batch(model, state, batch)
            else:
                packets += sim.render_batch(model, state, batch)
    assert left_out > 0
    windows = of(packets, "events")
    assert all(a.stamp_ns == b.start_ns for a, b in itertools.pairwise(windows))
    assert max(w.stamp_ns - w.start_ns for w in windows) > min(w.stamp_ns - w.start_ns for w in windows)
    pictures = of(packets, "rgb")
    assert [p.sequence for p in pictures] != list(range(len(pictures)))
    assert all(p.stamp_ns == round(p.sequence * 1e9 / SENSORS["rgb"]["rate_hz"]) for p in pictures)


def test_a_camera_that_nobody_wants_is_not_rendered(outside_model):
    model = outside_model
    state = sim.make_state(model)
    sim.select_cameras(model, state, ())
    for _ in range(4):
        packets = sim.step(model, state, None)
        assert {p.sensor for p in packets} <= {"imu", "odometry"}
    assert state.counts["renders"] == 0
    sim.select_cameras(model, state, ["rgb"])
    pictures = [p for _ in range(20) for p in sim.step(model, state, None) if p.sensor == "rgb"]
    assert state.counts["renders"] == len(pictures) > 0
    with pytest.raises(ValueError, match=r"unknown cameras \['nix'\], known: "):
        sim.select_cameras(model, state, ["nix"])


def test_an_event_camera_that_comes_back_starts_from_what_it_sees(outside_model):
    """Its first window begins at the first instant it saw; nothing of the time before is in it."""
    model, command = outside_model, 1.2 * hover(outside_model)
    state = sim.make_state(model)
    windows = of([p for _ in range(10) for p in sim.step(model, state, command)], "events")
    sim.select_cameras(model, state, ())
    for _ in range(5):
        assert not of(sim.step(model, state, command), "events")
    away_until_ns = state.stamp_ns
    sim.select_cameras(model, state, ["events"])
    later = of([p for _ in range(10) for p in sim.step(model, state, command)], "events")
    assert [p.sequence for p in later] == [len(windows) + k for k in range(len(later))]
    assert later[0].start_ns > away_until_ns
    assert all(a.stamp_ns == b.start_ns for a, b in itertools.pairwise(later))
    t = np.concatenate([p.numpy().t for p in later])
    assert len(t)
    assert t.min() * 1000 > later[0].start_ns - 1000


@pytest.mark.parametrize(
    ("mode", "setpoint"),
    [
        ("rates", [5.5, 0.1, -0.2, 0.3]),
        ("attitude", [5.5, 0.0, 0.05, 0.0, 1.0]),
        ("velocity", [0.4, -0.2, 0.1, 0.5]),
        ("position", [0.3, 0.2, 1.5, 0.4]),
    ],
)
def test_a_setpoint_is_what_its_controller_makes_of_the_state(outside_model, mode, setpoint):
    """Independent: the controller computes rotor speeds by itself, which are commanded as such."""
    model = outside_model
    direct, by_hand = sim.make_state(model), sim.make_state(model)
    controller = Controller(mode, model.airframe, model.config.control.gains, device=model.device)
    for _ in range(6):
        a = sim.step(model, direct, setpoint, mode=mode)
        now = sim.observe(by_hand)
        speeds = command_of(
            controller,
            setpoint,
            position=now.position,
            velocity=now.velocity,
            orientation=now.orientation,
            body_rate=now.body_rate,
            rotor_speed=now.rotor_speed,
        )
        b = sim.step(model, by_hand, speeds[0])
        assert content(a) == content(b)


def test_an_episode_can_start_elsewhere_and_with_another_seed(settings):
    sensors = {"imu": {"kind": "imu", "gyroscope_noise_density": 1e-3}, "odometry": {"kind": "odometry"}}
    model = sim.make_model(ns.load_config({**settings, "sensors": sensors}))
    start = sim.StartState(position=[0.5, 0.2, 1.1], velocity=[0.1, 0.0, 0.0])
    first = [sim.step(model, sim.make_state(model, seed=s, start=start), None) for s in (1, 1, 2)]
    assert content(first[0]) == content(first[1])
    assert content(of(first[0], "imu")) != content(of(first[2], "imu"))
    assert of(first[0], "odometry")[0].position.tolist() == [0.5, 0.2, 1.1]
    with pytest.raises(ValueError, match="position"):
        sim.make_state(model, start=sim.StartState(position=[0.0, np.nan, 1.0]))


def test_a_fleet_shares_its_scene(settings):
    fleet = {"a": {}, "b": {"path": {"kind": "hover", "position_m": [0.5, 0.0, 1.0]}, "sensors": {}}}
    config = ns.load_config({**settings, "vehicles": fleet})
    models = sim.make_fleet(config)
    assert list(models) == ["a", "b"]
    assert models["a"].scene is models["b"].scene
    assert not models["b"].groups
    alone = fly(settings)
    assert content(list(sim.run_model(models["a"], sim.make_state(models["a"])))) == content(alone)
    with pytest.raises(ValueError, match="one vehicle, got a, b"):
        sim.make_model(config)


def test_gains_can_change_between_two_periods(outside_model):
    """A pilot that was replaced is not asked any more, though its launches may be kept in a graph."""
    model = outside_model
    changed, steady = sim.make_state(model), sim.make_state(model)
    setpoint = [0.6, 0.4, 1.6, 0.3]
    for state in (changed, steady):
        for _ in range(4):
            sim.step(model, state, setpoint, mode="position")
    gains = model.config.control.gains
    softer = gains.model_copy(update={"position_gain_per_s2": 0.2 * gains.position_gain_per_s2})
    control = model.config.control.model_copy(update={"gains": softer})
    other = dataclasses.replace(model, config=model.config.model_copy(update={"control": control}))
    sim.forget_controllers(changed)
    for _ in range(8):
        sim.step(other, changed, setpoint, mode="position")
        sim.step(model, steady, setpoint, mode="position")
    fresh = sim.make_state(model)
    for period in range(12):
        if period == 4:
            sim.forget_controllers(fresh)
        sim.step(model if period < 4 else other, fresh, setpoint, mode="position")
    assert sim.observe(changed).position.tobytes() == sim.observe(fresh).position.tobytes()
    assert sim.observe(changed).position.tobytes() != sim.observe(steady).position.tobytes()


def test_what_was_measured_before_a_failure_is_returned(outside_model):
    """`step` and `integrate_period` return it, and raise when they are asked to go on."""
    model = outside_model
    for fly_on in (sim.step, lambda *a: sim.integrate_period(*a)[0]):
        state = sim.make_state(model, render_backlog=32)
        fly_on(model, state, None)
        state.vehicle.arrays.body_rate.assign([[1e9, 1e9, 1e9]])
        packets = fly_on(model, state, None)
        assert isinstance(state.failure, DynamicsError)
        assert all(p.stamp_ns <= state.failure.stamp_ns for p in packets)
        with pytest.raises(DynamicsError):
            fly_on(model, state, None)


ADAPTIVE = {
    "events": {**SENSORS["events"], "sampling_rate_hz": 2000, "max_displacement_px": 0.3},
    "imu": SENSORS["imu"],
}


def events_of(packets: list[Packet], sensor: str = "events") -> list[tuple[Any, ...]]:
    return content(of(packets, sensor))


def test_adaptive_sampling_leaves_ticks_out_and_every_packet_comes(settings):
    model = sim.make_model(ns.load_config({**settings, "sensors": ADAPTIVE}))
    state = sim.make_state(model)
    packets = of(list(sim.run_model(model, state)), "events")
    assert [p.stamp_ns for p in packets] == [k * 10_000_000 for k in range(1, 21)]
    assert state.counts["renders"] + state.counts["ticks left out"] == 401
    assert 21 < state.counts["renders"] < 200  # the ends of packets, and more
    assert sum(len(p.t) for p in packets) > 1000


def test_a_displacement_that_nothing_stays_below_gives_the_events_of_the_fixed_rate(settings):
    fixed = {"events": {**SENSORS["events"], "sampling_rate_hz": 1000}}
    every = {"events": {**fixed["events"], "max_displacement_px": 1e-6}}
    path = {"kind": "circle", "radius_m": 0.5, "center_m": [0.0, 0.0, 1.5], "ramp_s": 0.1}
    runs = [fly(settings, sensors=sensors, path=path) for sensors in (fixed, every)]
    assert sum(len(packet.t) for packet in runs[0]) > 1000
    assert events_of(runs[0]) == events_of(runs[1])


@pytest.mark.parametrize("lane_count", [1, 2, 3])
@pytest.mark.parametrize("instants", [1, 5, 64])
def test_adaptive_events_do_not_depend_on_batches(settings, lane_count, instants):
    expected = fly(settings, sensors=ADAPTIVE)
    got = fly_ahead(settings, lane_count, sensors=ADAPTIVE, instants_per_launch=instants)
    assert content(got) == content(expected)


def test_adaptive_events_do_not_depend_on_the_number_of_threads(settings):
    runs = []
    for count in (1, 3):
        with cores(count):
            runs.append(content(fly(settings, sensors=ADAPTIVE)))
    assert runs[0] == runs[1]


def test_adaptive_events_do_not_depend_on_the_other_cameras(settings):
    """Nor on whether somebody looks at them."""
    alone = fly(settings, sensors=ADAPTIVE)
    others = {
        **ADAPTIVE,
        "rgb": SENSORS["rgb"],
        "depth": SENSORS["depth"],
        "coarse": {**ADAPTIVE["events"], "max_displacement_px": 2.0},
        "slow": {**ADAPTIVE["events"], "packet_rate_hz": 25},
    }
    together = fly(settings, sensors=others)
    assert events_of(together) == events_of(alone)
    seen_alone = fly(settings, sensors={"rgb": SENSORS["rgb"], "events": ADAPTIVE["events"]})
    assert content(of(together, "rgb")) == content(of(seen_alone, "rgb"))


def test_where_a_collision_ends_adaptive_events_does_not_depend_on_the_size_of_a_launch(settings):
    crash = {**settings, "path": THROUGH_THE_WALL, "duration_s": 3.0, "sensors": ADAPTIVE}
    one, other = (fly(crash, instants_per_launch=k) for k in (3, 50))
    assert of(one, "collision")
    assert content(one) == content(other)


def test_adaptive_cameras_in_another_thread_yield_the_same(settings):
    config = ns.load_config({**settings, "sensors": ADAPTIVE})
    model = sim.make_model(config)
    stepped, flown = (sim.make_state(model, render_backlog=backlog) for backlog in (1, 8))
    speeds = [[460.0, 480.0, 470.0, 455.0]] * 10 + [[450.0, 440.0, 460.0, 470.0]] * 10
    expected = [p for command in speeds for p in sim.step(model, stepped, command)]
    got: list[Packet] = []
    waiting: list[sim.Batch] = []
    for command in speeds:
        packets, batches = sim.integrate_period(model, flown, command)
        got += packets
        waiting += batches
        while len(waiting) > 3:
            got += sim.render_batch(model, flown, waiting.pop(0))
    for batch in waiting:
        got += sim.render_batch(model, flown, batch)
    assert events_of(got) == events_of(expected)
    assert sum(len(packet.t) for packet in of(got, "events")) > 10


def test_an_adaptive_camera_that_comes_back_sees_the_first_tick(settings):
    """Also if its content has hardly moved since; and a batch that is skipped makes a window longer."""
    model = sim.make_model(ns.load_config({**settings, "sensors": ADAPTIVE}))
    command = 1.05 * hover(model)
    state = sim.make_state(model, render_backlog=32)
    for _ in range(10):
        sim.step(model, state, command)
    sim.select_cameras(model, state, ())
    sim.step(model, state, command)
    away_until_ns = state.stamp_ns
    sim.select_cameras(model, state, ["events"])
    later = of([p for _ in range(6) for p in sim.step(model, state, command)], "events")
    assert later[0].start_ns == away_until_ns + 500_000
    packets: list[Packet] = []
    for period in range(16):
        for batch in sim.integrate_period(model, state, command)[1]:
            looks = sim.skip_batch if 4 <= period < 8 else sim.render_batch
            found = looks(model, state, batch)
            packets += found if isinstance(found, list) else []
    windows = of(packets, "events")
    assert windows[0].start_ns == later[-1].stamp_ns
    assert all(a.stamp_ns == b.start_ns for a, b in itertools.pairwise(windows))
    assert {w.stamp_ns - w.start_ns for w in windows} == {10_000_000, 30_000_000}


def test_an_adaptive_camera_needs_a_renderer_that_knows_where_things_are(settings):
    model = sim.make_model(ns.load_config({**settings, "sensors": ADAPTIVE, "renderer": "synthetic"}))
    with pytest.raises(ValueError, match="needs the renderer 'warp'"):
        sim.make_state(model)
