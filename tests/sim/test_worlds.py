"""World i of a batch is the ordinary simulation with its seed and its commands, to the byte."""

from __future__ import annotations

import dataclasses
import itertools
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from allocations import allocations
from core_counts import cores
from world_rig import RIG, UNSHADOWED, assert_same, commands_of, fly_alone, room, scene_of, settings, snapshot

import neurosim_core as ns
from neurosim_core.packets import Collision, Events
from neurosim_core.runtime import cuda
from neurosim_core.sim import Simulation, StartState
from neurosim_core.vehicle.arrays import STATUS_TERMS


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Path:
    return room(tmp_path_factory.mktemp("plain") / "room.glb")


@pytest.fixture(scope="module")
def textured(tmp_path_factory) -> Path:
    return room(tmp_path_factory.mktemp("textured") / "room.glb", textured=True)


def record(worlds: Any, commands: np.ndarray, *, mode: str = "rates", **start: Any) -> list[list[dict]]:
    """Fly from a reset on; return what each world yields, [step][world], with the reset first."""
    steps = [worlds.reset(**start)]
    seen = [[snapshot(steps[0], world) for world in range(worlds.count)]]
    for command in commands:
        observation = worlds.step(command, mode=mode)
        seen.append([snapshot(observation, world) for world in range(worlds.count)])
    return seen


def event_count(seen: list[list[dict]], name: str = "front") -> int:
    return sum(len(world[name][0]) for step in seen for world in step)


@pytest.mark.parametrize("mode", ["rates", "attitude", "position", "velocity", "motor_speeds"])
def test_each_world_is_a_single_simulation(mode, plain, device):
    """Events, pictures, IMU with noise and states, for commands of every level."""
    commands = commands_of(mode, 8, 3)
    seen = record(Simulation(settings(plain, device), worlds=3), commands, mode=mode)
    assert event_count(seen) > 300
    for world in range(3):
        alone = fly_alone(settings(plain, device, seed=7 + world), commands[:, world], mode=mode)
        for step, packets in enumerate(alone):
            assert_same(seen[step][world], packets)


def test_places_of_their_own(plain):
    """Each vehicle begins where it is told."""
    position = np.array([[1.0, 0.5, 1.0], [-1.5, -0.5, 2.0]])
    orientation = np.array([[0.0, 0.0, 1.0, 2.0], [0.1, 0.2, 0.3, 0.4]])
    commands = commands_of("rates", 4, 2)
    worlds = Simulation(settings(plain), worlds=2, seeds=[3, 11])
    seen = record(worlds, commands, position=position, orientation=orientation, velocity=[1.0, 0.0, 0.0])
    for world, seed in enumerate((3, 11)):
        start = StartState(position=position[world], orientation=orientation[world], velocity=[1.0, 0.0, 0.0])
        alone = fly_alone(settings(plain, seed=seed), commands[:, world], start=start)
        for step, packets in enumerate(alone):
            assert_same(seen[step][world], packets)
    (packets,) = fly_alone(settings(plain, seed=3), commands[:0, 0])  # where the path begins
    for still in (None, wp.zeros((2, 3), dtype=float, device="cpu")):
        assert_same(snapshot(worlds.reset(velocity=still), 0), packets)


@pytest.mark.parametrize("render", [{}, {"lighting": {"mode": "unshadowed"}}], ids=["baked", "unshadowed"])
def test_scenes_of_their_own(render, plain, textured):
    """Worlds in two scenes, of which one has textures, are what they are alone."""
    commands = commands_of("rates", 6, 3)
    worlds = Simulation(
        settings(plain, render=render),
        worlds=3,
        scenes=[scene_of(plain), scene_of(textured)],
        scene_of_world=[1, 0, 1],
    )
    seen = record(worlds, commands)
    pictures = [seen[0][world]["rgb"] for world in range(3)]
    assert not np.array_equal(pictures[0], pictures[1])
    assert np.array_equal(pictures[0], pictures[2])
    for world, path in enumerate((textured, plain, textured)):
        alone = fly_alone(settings(path, seed=7 + world, render=render), commands[:, world])
        for step, packets in enumerate(alone):
            assert_same(seen[step][world], packets)


NOISE = {
    "threshold_spread": {"sigma_on": 0.02, "sigma_off": 0.02},
    "low_pass": {"cutoff_hz": 200.0},
    "refractory_s": 5e-4,
    "leak": {"rate_hz": 5.0},
    "shot_noise": {"rate_hz": 20.0},
    "hot_pixels": {"fraction": 0.01},
}


@pytest.mark.parametrize("noisy", [False, True])
def test_pixels_and_lenses_of_their_own(noisy, plain, device):
    """Thresholds, noise and field of view that differ from world to world."""
    pixel = {"threshold_on": 0.12, "threshold_off": 0.1, **(NOISE if noisy else {})}
    rig = {"front": {**RIG["front"], "pixel": pixel}, "imu": RIG["imu"]}
    given = {
        "front.threshold_on": [0.1, 0.2, 0.15],
        "front.threshold_off": [0.3, 0.1, 0.1],
        "front.lens.horizontal_fov_rad": [1.2, 1.5, 1.2],
    }
    if noisy:
        given |= {"front.refractory_s": [1e-3, 0.0, 2e-3], "front.shot_noise.rate_hz": [1.0, 100.0, 30.0]}
    commands = commands_of("rates", 6, 3)
    config = settings(plain, device, sensors=rig)
    seen = record(Simulation(config, worlds=3, parameters=given), commands)
    assert event_count(seen) > 100
    for world in range(3):
        own = {key.replace("front.", "sensors.front."): values[world] for key, values in given.items()}
        own = {
            key if ".lens." in key else key.replace("front.", "front.pixel."): value
            for key, value in own.items()
        }
        overrides = {**own, "seed": 7 + world}
        alone = fly_alone(config, commands[:, world], overrides=overrides)
        for step, packets in enumerate(alone):
            assert_same(seen[step][world], packets)


@pytest.mark.parametrize(("by_tile", "limit"), [(True, 256), (False, 256), (False, 2)])
def test_walks_that_rays_share(textured, by_tile, limit):
    """The instants of a tile share a search of the tree in each world, which changes nothing.

    Tile by tile, as on a CPU, and as blocks of CUDA do it, which leave pixels to another kernel, and with
    short lists more pixels than there is room for.
    """
    front = {**RIG["front"], "sampling_rate_hz": 600}  # 6 instants: 4 together, then 2
    rig = {"front": front, "rgb": RIG["rgb"]}
    walking = {**UNSHADOWED, "candidate_lists": {"face_count_max": limit}}
    commands = commands_of("rates", 4, 2)
    config = settings(textured, sensors=rig, render=walking)
    model = ns.make_model(ns.load_config(config))
    arrays: Any = model.scene_on_device
    arrays = dataclasses.replace(arrays, terms=arrays.terms._replace(by_tile=by_tile))
    shared = dataclasses.replace(model, scene_on_device=arrays)
    seen = record(Simulation(config, worlds=2, models=[shared]), commands)
    for world in range(2):
        for render in (walking, {**UNSHADOWED, "cpu_traversal": "warp", "candidate_lists": None}):
            config = settings(textured, seed=7 + world, sensors=rig, render=render)
            for step, packets in enumerate(fly_alone(config, commands[:, world])):
                assert_same(seen[step][world], packets)


@pytest.mark.parametrize(("front_hz", "side_hz"), [(50, 250), (30, 400)])
@pytest.mark.parametrize("noisy", [False, True])
def test_event_cameras_that_miss_steps(front_hz, side_hz, noisy, plain):
    """Steps without a frame of one camera or the other, or with now two and now three, change no event."""
    pixel = {"threshold_on": 0.12, "threshold_off": 0.1, **(NOISE if noisy else {})}
    rig = {
        name: {**RIG["front"], "sampling_rate_hz": rate, "packet_rate_hz": rate, "pixel": pixel}
        for name, rate in (("front", front_hz), ("side", side_hz))
    }
    commands = commands_of("rates", 12, 2)
    seen = record(Simulation(settings(plain, sensors=rig), worlds=2), commands)
    for world in range(2):
        alone = fly_alone(settings(plain, seed=7 + world, sensors=rig), commands[:, world])
        for name in rig:
            found = [p.numpy() for step in alone for p in step if isinstance(p, Events) and p.sensor == name]
            of_steps = [step[world][name] for step in seen]
            for column, expected in zip(in_order(of_steps), in_order(found), strict=True):
                np.testing.assert_array_equal(column, expected)
            assert sum(len(part[0]) for part in found) > 100


def in_order(parts: list[tuple]) -> list[np.ndarray]:
    """Return t, x, y and polarity of several packets in one, sorted by (t, y, x, polarity)."""
    t, x, y, polarity = (np.concatenate([part[index] for part in parts]) for index in range(4))
    order = np.lexsort((polarity, x, y, t))
    return [t[order], x[order], y[order], polarity[order]]


@pytest.mark.parametrize("several", ["scenes", "lenses"])
def test_walks_that_cannot_be_shared(several, plain, textured, caplog):
    """They are left out and that is said; what finds the rays' hits without the setting does so here."""
    caplog.set_level("INFO", logger="neurosim_core.sim.scene_table")
    rig = {"front": RIG["front"]}
    given: dict[str, Any] = {"scenes": [scene_of(plain), scene_of(textured)]}
    if several == "lenses":
        given = {"parameters": {"front.lens.horizontal_fov_rad": [1.2, 1.5]}}
    made = [
        Simulation(
            settings(plain, sensors=rig, render={**UNSHADOWED, **walk}),
            worlds=2,
            **given,
        )
        for walk in ({}, {"candidate_lists": {}})
    ]
    assert caplog.text.count("render.candidate_lists is not used") == 1
    commands = commands_of("rates", 3, 2)
    plainly, walking = (record(worlds, commands) for worlds in made)
    assert event_count(plainly) > 100
    for step, other in zip(plainly, walking, strict=True):
        for world in range(2):
            for column, expected in zip(other[world]["front"], step[world]["front"], strict=True):
                np.testing.assert_array_equal(column, expected)


def test_what_moves_by_itself(plain):
    """Bodies that pass, gusts and turbulence: by the clock and the seed of each world."""
    ball = {
        "shape": {"kind": "sphere", "radius_m": 0.3},
        "motion": {"position_m": [1.5, -1.0, 1.5], "velocity_m_s": [0.0, 8.0, 0.0]},
    }
    turbulence = {"parameters": {"turbulence": {"wind_20ft_m_s": 15.0}}, "on_collision": "report"}
    rig = {"front": RIG["front"], "odometry": RIG["odometry"]}
    config = settings(plain, sensors=rig, bodies={"ball": ball}, vehicle=turbulence)
    commands = commands_of("position", 6, 2)
    worlds = Simulation(config, worlds=2)
    for episode in range(2):  # the second begins with all that the first has left
        seen = record(worlds, commands, mode="position")
        assert event_count(seen) > 100, episode
        for world in range(2):
            alone = fly_alone({**config, "seed": 7 + world}, commands[:, world], mode="position")
            for step, packets in enumerate(alone):
                assert_same(seen[step][world], packets)


@pytest.mark.parametrize("on_device", [False, True])
def test_a_world_that_is_reset_alone(on_device, plain, device):
    """It begins like a fresh simulation, and the others do not notice."""
    rig = {**RIG, "front": {**RIG["front"], "pixel": {"threshold_on": 0.12, **NOISE}}}
    rig["rgb"] = {**RIG["rgb"], "rate_hz": 100}
    config = settings(plain, device, sensors=rig, vehicle={"on_collision": "report"})
    commands = commands_of("rates", 7, 3)
    worlds = Simulation(config, worlds=3)
    seen = record(worlds, commands[:3])
    mask: Any = np.array([0, 1, 0], dtype=np.uint8)
    worlds.reset(mask=wp.array(mask, dtype=wp.uint8, device=device) if on_device else mask.astype(bool))
    first = snapshot(worlds.reset(mask=mask), 1)  # again: nothing is left of the one before
    for command in commands[3:]:
        observation = worlds.step(command)
        seen.append([snapshot(observation, world) for world in range(3)])
    for world in range(3):
        alone = fly_alone({**config, "seed": 7 + world}, commands[3 * (world == 1) :, world])
        after = [first, *(step[world] for step in seen[4:])] if world == 1 else [s[world] for s in seen]
        for step, packets in enumerate(alone):
            assert_same(after[step], packets)
    assert worlds.reset(mask=mask).clock_ns.numpy().tolist() == [70_000_000, 0, 70_000_000]


def test_new_seeds(plain):
    """After a reset with other seeds everything random is that of these seeds."""
    rig = {**RIG, "front": {**RIG["front"], "pixel": {"threshold_on": 0.12, **NOISE}}}
    config = settings(plain, sensors=rig)
    commands = commands_of("rates", 3, 2)
    worlds = Simulation(config, worlds=2)
    before = record(worlds, commands)
    again = record(worlds, commands, seed=[40, 2])
    same = record(worlds, commands, seed=7)
    assert event_count(before) == event_count(same) != event_count(again)
    for world, seed in enumerate((40, 2)):
        alone = fly_alone({**config, "seed": seed}, commands[:, world])
        for step, packets in enumerate(alone):
            assert_same(again[step][world], packets)


def test_more_events_than_fit(textured):
    """Of each render the rows from the top that fit are kept, as a single camera does; losses are counted."""
    capacity = 1450
    rig = {"front": {**RIG["front"], "pixel": {"threshold_on": 0.03, "threshold_off": 0.03}}}
    config = settings(textured, sensors=rig)
    turning = {"body_rate": [0.0, 0.0, 3.0]}
    commands = commands_of("rates", 6, 2)
    commands[:, :, 3] = [[3.0, 0.0]] * 3 + [[0.0, 3.0]] * 3
    seen = record(Simulation(config, worlds=2, event_capacity=capacity), commands, **turning)
    lost = [[step[world]["dropped"]["front"] for step in seen] for world in range(2)]
    assert all(0 < sum(count > 0 for count in counts) < 6 for counts in lost)
    overrides = {"sensors.front.pixel.event_count_max": capacity // 4}
    for world in range(2):
        own = {**config, "seed": 7 + world}
        start = StartState(**turning)
        limited = fly_alone(own, commands[:, world], overrides=overrides, start=start)
        free = fly_alone(own, commands[:, world], start=start)
        for step, count in enumerate(lost[world]):
            assert len(seen[step][world]["front"][0]) <= capacity
            assert_same(seen[step][world], limited[step] if count else free[step])


def test_as_many_events_as_each_world_may_have(textured):
    """What a frame may yield at most differs from world to world."""
    rig = {"front": {**RIG["front"], "pixel": {"threshold_on": 0.03, "threshold_off": 0.03}}}
    config = settings(textured, sensors=rig)
    commands = commands_of("rates", 4, 2)
    given = {"front.event_count_max": [100_000, 100]}
    worlds = Simulation(config, worlds=2, parameters=given, event_capacity=50_000)
    seen = record(worlds, commands, body_rate=[0.0, 0.0, 3.0])
    lost = [sum(step[world]["dropped"]["front"] for step in seen) for world in range(2)]
    assert lost[0] == 0 < lost[1]
    for world, most in enumerate(given["front.event_count_max"]):
        own = {"sensors.front.pixel.event_count_max": most, "seed": 7 + world}
        start = StartState(body_rate=[0.0, 0.0, 3.0])
        for step, packets in enumerate(fly_alone(config, commands[:, world], overrides=own, start=start)):
            assert_same(seen[step][world], packets)


def test_random_phases_in_some_worlds(plain):
    """Voltages of stochastic pixels begin at a random phase in one world, and at 0 in the other."""
    pixel = {"stochastic": {"k1": 5.3, "k2": 20.0, "k3": 1e-4, "k4": 1e-7, "k5": 5e-9, "k6": 1e-5}}
    rig = {"front": {**RIG["front"], "pixel": pixel}}
    config = settings(plain, sensors=rig)
    commands = commands_of("rates", 3, 2)
    seen = record(
        Simulation(config, worlds=2, parameters={"front.stochastic.random_phase": [1, 0]}), commands
    )
    for world, phase in enumerate((True, False)):
        own = {"sensors.front.pixel.stochastic.random_phase": phase, "seed": 7 + world}
        for step, packets in enumerate(fly_alone(config, commands[:, world], overrides=own)):
            assert_same(seen[step][world], packets)


def test_a_collision_holds_one_world(plain):
    """It is told and held where it touched; the other flies on as if alone."""
    config = settings(plain, vehicle={"on_collision": "end"})
    commands = np.zeros((30, 2, 4))
    commands[:, 0] = [0.0, 6.0, 0.0, 0.0]  # to the left, where the wall is
    seen = record(Simulation(config, worlds=2), commands, mode="velocity", velocity=[[0, 7, 0], [0, 0, 0]])
    collided = [step[0]["collided"] for step in seen]
    touch = collided.index(1)
    assert 5 < touch < 30
    assert all(collided[touch:])
    assert not any(step[1]["collided"] or step[1]["status"] for step in seen)
    assert STATUS_TERMS[seen[-1][0]["status"]] == "collision"
    for step in seen[touch:]:
        for value, held in zip(step[0]["state"], seen[touch][0]["state"], strict=True):
            np.testing.assert_array_equal(value, held)
    start = StartState(velocity=[0.0, 7.0, 0.0])
    alone = fly_alone(config, commands[:, 0], mode="velocity", start=start)
    assert len(alone) == touch + 1
    (hit,) = [packet for packet in alone[-1] if isinstance(packet, Collision)]
    np.testing.assert_array_equal(seen[touch][0]["state"][0], hit.position)
    for step, packets in enumerate(alone[:-1]):
        assert_same(seen[step][0], packets)
    other = fly_alone({**config, "seed": 8}, commands[:, 1], mode="velocity")
    for step, packets in enumerate(other):
        assert_same(seen[step][1], packets)


def test_touches_are_reported_while_they_last(plain):
    config = settings(plain, vehicle={"on_collision": "report"})
    worlds = Simulation(config, worlds=2)
    worlds.reset(position=[[0.0, 1.7, 1.5], [0.0, 0.0, 1.5]], velocity=[0.0, 6.0, 0.0])
    told = [worlds.step(None).collided.numpy().tolist() for _ in range(14)]
    assert [told[0], told[3], told[13]] == [[0, 0], [1, 0], [0, 0]]  # at 6 m/s it touches from 1.8 to 2.2 m


def test_a_motion_that_cannot_be_integrated_holds_one_world(plain):
    """A command that is no number, on the device, where nobody looks at it."""
    rig = {"front": RIG["front"]}
    worlds = Simulation(settings(plain, sensors=rig), worlds=2)
    worlds.reset()
    commands = commands_of("rates", 3, 2)
    commands[1, 0, 0] = np.nan
    for command in commands:
        observation = worlds.step(wp.array(command, dtype=wp.float64, device="cpu"))
    assert [STATUS_TERMS[code] for code in observation.status.numpy()] == ["rotor_speed_command", "ok"]
    assert observation.state.stamp_ns.numpy().tolist() == [10_000_000, 30_000_000]
    assert not observation.collided.numpy().any()
    assert not worlds.reset().status.numpy().any()


def test_neither_batch_nor_threads_change_a_byte(plain):
    """Four worlds together are two and two, on one core or three."""
    rig = {"front": RIG["front"], "rgb": RIG["rgb"], "imu": RIG["imu"]}
    commands = commands_of("rates", 4, 4)
    together = record(Simulation(settings(plain, sensors=rig), worlds=4), commands)
    for core_count, first in itertools.product((1, 3), (0, 2)):
        with cores(core_count):
            half = Simulation(settings(plain, sensors=rig), worlds=2, seeds=[7 + first, 8 + first])
            apart = record(half, commands[:, first : first + 2])
        for step, worlds in enumerate(apart):
            for index, seen in enumerate(worlds):
                for name in ("front", "imu", "state"):
                    for a, b in zip(seen[name], together[step][first + index][name], strict=True):
                        np.testing.assert_array_equal(a, b)


def test_events_that_are_not_sorted(plain):
    """They are the same, of each world together."""
    commands = commands_of("rates", 4, 2)
    rig = {"front": RIG["front"]}
    ordered = record(Simulation(settings(plain, sensors=rig), worlds=2), commands)
    loose = record(Simulation(settings(plain, sensors=rig), worlds=2, sorted=False), commands)
    for a, b in zip(ordered, loose, strict=True):
        for world in range(2):
            t, x, y, polarity = b[world]["front"]
            order = np.lexsort((polarity, x, y, t))
            for column, expected in zip((t, x, y, polarity), a[world]["front"], strict=True):
                np.testing.assert_array_equal(column[order], expected)


def test_results_are_arrays_of_others_without_a_copy(plain):
    """NumPy sees, through DLPack, the memory that the next step writes to."""
    worlds = Simulation(settings(plain), worlds=2)
    observation = worlds.reset()
    position, pictures = observation.state.position, observation.images["rgb"]
    seen: Any = np.from_dlpack(position)
    assert seen.__array_interface__["data"][0] == position.ptr
    assert np.from_dlpack(pictures).__array_interface__["data"][0] == pictures.ptr
    before = seen.copy()
    for command in commands_of("rates", 3, 2):
        worlds.step(command)
    assert (seen != before).all()


def test_four_thousand_worlds(plain, device):
    """The last of them is a single simulation as well."""
    camera = {**RIG["front"], "lens": {"width": 16, "height": 12, "horizontal_fov_rad": 1.5}}
    config = settings(plain, device, sensors={"front": camera})
    commands = commands_of("rates", 2, 4096)
    worlds = Simulation(config, worlds=4096)
    seen = [snapshot(worlds.reset(), 4095)]
    seen += [snapshot(worlds.step(command), 4095) for command in commands]
    alone = fly_alone({**config, "seed": 7 + 4095}, commands[:, 4095])
    for step, packets in enumerate(alone):
        assert_same(seen[step], packets)
    assert len(alone) == 3


def test_results_are_tensors_without_a_copy(plain):
    """PyTorch sees the memory that the next step writes to; commands may be tensors."""
    torch = pytest.importorskip("torch")
    rig = {name: RIG[name] for name in ("front", "rgb", "imu")}
    worlds = Simulation(settings(plain, sensors=rig), worlds=2)
    observation = worlds.reset()
    pictures = torch.from_dlpack(observation.images["rgb"])
    position = torch.from_dlpack(observation.state.position)
    assert (pictures.shape, pictures.dtype) == ((2, 28, 36, 3), torch.uint8)
    assert (position.shape, position.dtype) == ((2, 3), torch.float64)
    before = position.clone()
    commands = torch.tensor([[6.0, 0.0, 2.0, 0.0], [9.0, 0.0, 0.0, 0.0]], dtype=torch.float32)
    for _ in range(4):
        observation = worlds.step(commands)
    assert pictures.data_ptr() == observation.images["rgb"].ptr
    assert (position[:, 2] != before[:, 2]).all()
    assert torch.from_dlpack(observation.samples["imu"].arrays["specific_force"]).shape == (2, 2, 3)
    counts = torch.from_dlpack(observation.events["front"].counts)
    offsets = torch.from_dlpack(observation.events["front"].offsets)
    assert torch.equal(torch.diff(offsets), counts)
    assert counts.sum() > 0
    alone = Simulation(settings(plain, sensors=rig), worlds=2)
    alone.reset()
    for _ in range(4):
        other = alone.step(wp.array(commands.numpy(), dtype=wp.float32, device="cpu"))
    np.testing.assert_array_equal(position.numpy(), other.state.position.numpy())


def test_a_step_allocates_nothing(plain):
    """Of the device, once every pattern has been flown: what a graph of it needs."""
    worlds = Simulation(settings(plain), worlds=2)
    worlds.reset()
    commands = commands_of("rates", 8, 2)
    for command in commands[:4]:
        worlds.step(command)
    with allocations() as made:
        for command in commands[4:]:
            worlds.step(command)
    assert made == []


@pytest.mark.parametrize(
    ("changes", "arguments", "message"),
    [
        ({}, {"worlds": 0}, r"worlds must be in \[1, 4096\], got 0"),
        ({"renderer": "synthetic"}, {}, "renderer 'warp', got 'synthetic'"),
        ({}, {"parameters": {"front.threshold_on": [0.1]}}, r"shape \[2\], got \[1\]"),
        ({}, {"parameters": {"front.threshold_on": [0.1, -1.0]}}, "'front' in world 1: pixel.threshold_on"),
        ({}, {"parameters": {"back.threshold_on": [0.1, 0.1]}}, "known: front, rgb"),
        ({}, {"parameters": {"front.sampling_rate_hz": [1, 2]}}, "worlds cannot differ in"),
        ({}, {"parameters": {"front.lens.width": [36, 40]}}, "pictures of one size"),
        ({}, {"parameters": {"front.lens.horizontal_fov_rad": [1.0, 1.5]}}, "'front' and 'depth' share"),
        ({}, {"scene_of_world": [0, 1]}, r"scene_of_world must be in \[0, 0\], got 0 to 1"),
        ({}, {"seeds": [1, 2, 3]}, r"shape \[2\]"),
        ({}, {"event_capacity": 0}, "event_capacity"),
        (
            {},
            {"event_capacity": 2**30},
            r"exceed 2\^31 events: give an event_capacity of at most 1073741823",
        ),
        ({"vehicles": {"a": {}, "b": {}}}, {}, "one vehicle, got a, b"),
        ({"control": {"rate_hz": 120}}, {}, "rate_hz must divide control.rate_hz = 120"),
    ],
)
def test_what_is_refused(changes, arguments, message, plain):
    with pytest.raises(ValueError, match=message):
        Simulation(settings(plain, **changes), **{"worlds": 2, **arguments})


@pytest.mark.parametrize(
    ("front", "message"),
    [({"max_displacement_px": 1.0}, "single runs"), ({"pixel": {"readout": {}}}, "readout of 'front'")],
)
def test_cameras_that_are_refused(front, message, plain):
    rig = {"front": {**RIG["front"], **front}}
    with pytest.raises(ValueError, match=message):
        Simulation(settings(plain, sensors=rig), worlds=2)


def test_models_that_were_made_before(plain, textured):
    """They are taken as they are, or refused if they are something else than the configuration says."""
    config = ns.load_config(settings(plain))
    models = [ns.make_model(ns.load_config(settings(path))) for path in (plain, textured)]
    commands = commands_of("rates", 2, 2)
    simulation = Simulation(config, worlds=2, models=models)
    assert [model.config.scene for model in simulation.models] == [model.config.scene for model in models]
    seen = record(simulation, commands)
    for world, path in enumerate((plain, textured)):
        for step, packets in enumerate(fly_alone(settings(path, seed=7 + world), commands[:, world])):
            assert_same(seen[step][world], packets)
    moving = {"ball": {"shape": {"kind": "sphere", "radius_m": 0.3}, "motion": {"position_m": [1, 0, 1]}}}
    for changes, message in (
        ({"bodies": moving}, r"models\[0\] has the bodies \[\]"),
        ({"render": {}}, r"models\[0\] was made with other settings of `render`"),
    ):
        with pytest.raises(ValueError, match=message):
            Simulation(settings(plain, **changes), worlds=2, models=models[:1])
    elsewhere = dataclasses.replace(models[1], device="cuda:7")
    with pytest.raises(ValueError, match=r"models\[1\] is on cuda:7, but the worlds are on cpu"):
        Simulation(config, worlds=2, models=[models[0], elsewhere])
    for none in ({"models": ()}, {"scenes": ()}, {"scenes": []}):
        with pytest.raises(ValueError, match="must have at least one scene"):
            Simulation(config, worlds=2, **none)


def test_patterns_that_never_come_again(plain):
    """They change no event, and what is kept of them is bounded."""
    imu = {**RIG["imu"], "rate_hz": 333.333}
    front = {**RIG["front"], "sampling_rate_hz": 59.94, "packet_rate_hz": 59.94}
    config = settings(plain, sensors={"front": front, "imu": imu})
    commands = commands_of("rates", 12, 1)
    seen = record(Simulation(config, worlds=1), commands)
    packets = [p for step in fly_alone(config, commands[:, 0]) for p in step]
    found = [p.numpy() for p in packets if isinstance(p, Events)]
    for column, expected in zip(in_order([s[0]["front"] for s in seen]), in_order(found), strict=True):
        np.testing.assert_array_equal(column, expected)
    worlds = Simulation(settings(plain, sensors={"imu": imu}), worlds=1)
    worlds.reset()
    observations = [weakref.ref(worlds.step()) for _ in range(5000)]
    assert sum(observation() is not None for observation in observations) <= 4096


def test_that_graphs_are_given_up_is_said_once(plain, monkeypatch, caplog):
    """A CUDA device gives them up where patterns are too many."""

    def give_up(graphs: cuda.GraphCache, key: Any, launch: Callable[[], Any], **_: Any) -> None:
        graphs.dropped_count += 1
        launch()

    worlds = Simulation(settings(plain, sensors={"front": RIG["front"]}), worlds=1)
    worlds.reset()
    worlds.step()
    assert not caplog.records
    monkeypatch.setattr(cuda.GraphCache, "run", give_up)
    for _ in range(2):
        worlds.step()
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "more patterns than there is room for graphs" in caplog.text


def test_more_than_32_bits_can_count(plain):
    """Said before anything is allocated: event buffers, and candidate lists."""
    lens = {"width": 640, "height": 480, "horizontal_fov_rad": 1.5}
    rig = {"front": {**RIG["front"], "lens": lens, "sampling_rate_hz": 100}}
    with pytest.raises(ValueError, match="4096 worlds with a capacity of 614400 events each"):
        Simulation(settings(plain, sensors=rig, control={"rate_hz": 100}), worlds=4096)
    walking = {**UNSHADOWED, "candidate_lists": {"face_count_max": 4096}}
    rig["front"]["lens"] = {**lens, "width": 128, "height": 128}
    with pytest.raises(ValueError, match=r"groups of instants of 256 tiles .* are more than 2.31"):
        Simulation(settings(plain, sensors=rig, render=walking), worlds=4096)


def test_wrong_calls(plain):
    worlds = Simulation(settings(plain), worlds=2)
    with pytest.raises(RuntimeError, match=r"reset\(\) must be called"):
        worlds.step()
    with pytest.raises(ValueError, match="the first reset must reset all worlds"):
        worlds.reset(mask=[True, False])
    worlds.reset()
    with pytest.raises(ValueError, match=r"mode 'rates' takes rows"):
        worlds.step(np.zeros((3, 4)))
    with pytest.raises(ValueError, match=r"commands must have shape \[2, 4\], got \[2, 3\]"):
        worlds.step(wp.zeros((2, 3), dtype=wp.float64, device="cpu"))
    with pytest.raises(ValueError, match="commands must be float32 or float64"):
        worlds.step(wp.zeros((2, 4), dtype=wp.int32, device="cpu"))
    with pytest.raises(ValueError, match=r"orientation must not be 0"):
        worlds.reset(orientation=[0.0, 0.0, 0.0, 0.0])
    worlds.step(np.zeros(4))
    with pytest.raises(ValueError, match="tick together, which is every 20000000 ns; it is 10000000 ns"):
        worlds.reset(mask=np.array([True, False]))  # rgb takes a picture every other step
    worlds.step(np.zeros(4))
    with pytest.raises(ValueError, match=r"seed must be uint64 of shape \[2\]"):
        worlds.reset(mask=np.array([True, False]), seed=wp.zeros(2, dtype=wp.int32, device="cpu"))
    worlds.reset(mask=np.array([True, False]))


@pytest.mark.parametrize("noisy", [False, True])
@pytest.mark.parametrize("on_device", [False, True])
def test_a_world_that_begins_anew_with_another_seed(noisy, on_device, plain):
    """It is a single simulation with that seed, and the other world does not notice."""
    pixel = {"threshold_on": 0.12, "threshold_off": 0.1, **(NOISE if noisy else {})}
    rig = {"front": {**RIG["front"], "pixel": pixel}, "imu": RIG["imu"]}
    commands = commands_of("rates", 6, 2)
    worlds = Simulation(settings(plain, sensors=rig), worlds=2)
    worlds.reset()
    for command in commands[:3]:
        worlds.step(command)
    seeds: Any = np.array([11, 12], np.uint64)
    given = wp.array(seeds, dtype=wp.uint64, device="cpu") if on_device else seeds
    worlds.reset(mask=np.array([False, True]), seed=given)
    assert worlds.seeds == [7, 12]
    seen = [worlds.step(command) for command in commands[3:]][-1]
    on = fly_alone(settings(plain, seed=7, sensors=rig), commands[:, 0])
    assert_same(snapshot(seen, 0), on[-1])
    anew = fly_alone(settings(plain, seed=12, sensors=rig), commands[3:, 1])
    assert_same(snapshot(seen, 1), anew[-1])


def test_a_reset_that_is_refused_changes_nothing(plain):
    """Seeds, starts and the mask are checked before any of them counts."""
    torch = pytest.importorskip("torch")
    rig = {"front": {**RIG["front"], "pixel": {"threshold_on": 0.12, **NOISE}}}
    worlds = Simulation(settings(plain, sensors=rig), worlds=2)
    commands = commands_of("rates", 4, 2)
    worlds.reset(position=[0.5, 0.0, 1.5])
    for wrong, message in (
        ({"seed": 3, "position": [1.0, 2.0]}, "position"),
        ({"position": [1.0, 0.0, 1.0], "orientation": np.zeros(4)}, "orientation must not be 0"),
        ({"seed": 3, "velocity": wp.zeros((2, 2), dtype=float, device="cpu")}, "velocity must have shape"),
        ({"mask": np.array([1, 0, 0], np.uint8), "position": [1.0, 0.0, 1.0]}, "mask must be"),
        ({"seed": 3, "velocity": torch.zeros((2, 3), requires_grad=True)}, r"give tensor\.detach\(\)"),
    ):
        with pytest.raises(ValueError, match=message):
            worlds.reset(**wrong)
    assert worlds.seeds == [7, 8]
    seen = [worlds.step(command) for command in commands][-1]
    start = StartState(position=[0.5, 0.0, 1.5])
    for world in range(2):
        alone = fly_alone(settings(plain, seed=7 + world, sensors=rig), commands[:, world], start=start)
        assert_same(snapshot(seen, world), alone[-1])


def test_a_flight_without_cameras(plain):
    """States and IMU alone."""
    config = ns.load_config(settings(plain, sensors={"imu": RIG["imu"], "odometry": RIG["odometry"]}))
    commands = commands_of("rates", 5, 2)
    seen = record(Simulation(config, worlds=2), commands)
    for world in range(2):
        alone = fly_alone(
            settings(plain, seed=7 + world, sensors={"imu": RIG["imu"], "odometry": RIG["odometry"]}),
            commands[:, world],
        )
        for step, packets in enumerate(alone):
            assert_same(seen[step][world], packets)


def test_worlds_that_follow_the_path_fly_as_a_run_does():
    """From the first control period on: the controller commands at stamp 0, and anew after a reset."""
    config = ns.load_config(
        {
            "duration_s": 0.1,
            "device": "cpu",
            "scene": {"kind": "hall", "size_m": [8, 6, 3]},
            "sensors": {"odometry": {"kind": "odometry"}},
        }
    )
    flown = [packet.position for packet in ns.run(config) if isinstance(packet, ns.Odometry)]
    worlds = Simulation(config, worlds=2)
    for _ in range(2):
        positions = [worlds.reset().state.position.numpy()[1].copy()]
        positions += [worlds.rollout(1).state.position.numpy()[1].copy() for _ in range(20)]
        np.testing.assert_array_equal(positions, flown)
