"""Moving bodies in a run: events where and when outlines pass, the same bits however a run is cut."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import warp as wp

import neurosim_core as ns
from neurosim_core import sim
from neurosim_core.packets import Events, Image, Packet

LENS = {"width": 64, "height": 48, "horizontal_fov_rad": 1.2}
RATE_HZ = 400.0
WALL_M = 4.0
"""Distance of the wall in front of the camera [m]."""


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """An empty room of 10 x 10 x 6 m of one light colour, its middle at (-1, 0, 0)."""
    walls = trimesh.creation.box(extents=[10.0, 10.0, 6.0])
    walls.invert()
    walls.apply_translation([WALL_M - 5.0, 0.0, 0.0])
    path = tmp_path_factory.mktemp("scene") / "room.glb"
    trimesh.Scene(walls).export(path)
    return path


def settings(room: Path, device: str, bodies: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """A vehicle that hovers in the origin and looks along +x."""
    lamps = {"kind": "mesh", "file": str(room), "up_axis": "z", "unit_m": 1.0, "inside_m": [0.0, 0.0, 0.0]}
    return {
        "duration_s": 0.25,
        "device": device,
        "scene": lamps,
        "render": {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1},
        "path": {"kind": "hover", "position_m": [0.0, 0.0, 0.0]},
        "bodies": bodies,
        "sensors": {
            "events": {
                "kind": "event_camera",
                "lens": LENS,
                "mount": {"position_m": [0.0, 0.0, 0.0]},
                "sampling_rate_hz": RATE_HZ,
                "packet_rate_hz": 40,
            },
            "rgb": {"kind": "rgb", "lens": LENS, "mount": {"position_m": [0.0, 0.0, 0.0]}, "rate_hz": 40},
            "depth": {"kind": "depth", "lens": LENS, "rate_hz": 50},
            "odometry": {"kind": "odometry", "rate_hz": 100},
        },
        **changes,
    }


BLACK = {"kind": "plain", "color": [0.0, 0.0, 0.0]}
SLIDING = {
    "shape": {"kind": "box", "size_m": [0.001, 0.4, 0.5]},
    "surface": BLACK,
    "motion": {"position_m": [2.0, 0.9, 0.0], "velocity_m_s": [0.0, -7.2, 0.0]},
}
"""A thin black board that crosses the view from left to right."""
BUSY = {
    "ball": {
        "shape": {"kind": "sphere", "radius_m": 0.3},
        "surface": {"kind": "checker", "square_m": 0.1},
        "motion": {
            "position_m": [2.0, 0.0, 0.0],
            "orbit": {"radius_m": 0.6, "rate_hz": 2.0, "axis": [1.0, 0.0, 0.0]},
            "spin_rad_s": [1.0, 5.0, 9.0],
        },
    },
    "board": SLIDING,
}


def events_of(packets: list[Packet]) -> np.ndarray:
    """Stamp [us], column, row, polarity of all events, in the order of time."""
    arrays = [packet.numpy() for packet in packets if isinstance(packet, Events)]
    return np.concatenate([np.stack([a.t, a.x, a.y, a.polarity], axis=1).astype(np.int64) for a in arrays])


def content(packets: list[Packet]) -> list[tuple[Any, ...]]:
    """All bytes of the packets, sensor by sensor."""

    def plain(value: Any) -> Any:
        return (value.dtype.str, value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value

    rows = [(p.sensor, p.sequence, *((k, plain(v)) for k, v in sorted(vars(p).items()))) for p in packets]
    return sorted(rows, key=lambda row: row[:2])


def test_edges_of_a_board_give_events_when_they_pass(room, device):
    """Pixels fire between renders around the analytic instant: dark, then bright as the board leaves.

    Each pixel is one ray, through its centre.

    A step between two renders is taken as linear in log radiance, so events lie in the interval of the step.
    """
    render = {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1}
    packets = list(ns.run(settings(room, device, {"board": SLIDING}, render=render)))
    fired = events_of(packets)
    fx = 0.5 * LENS["width"] / math.tan(0.5 * LENS["horizontal_fov_rad"])
    tick_us = 1e6 / RATE_HZ
    row = 24
    columns = np.arange(8, 56)
    y = 2.0 * (0.5 * LENS["width"] - (columns + 0.5)) / fx  # where a pixel's ray meets the plane of the board
    for column, y_m in zip(columns, y, strict=True):
        at = fired[(fired[:, 1] == column) & (fired[:, 2] == row)]
        for polarity, edge_m in ((0, -0.2), (1, 0.2)):  # its right edge comes first, the left one last
            crossing_us = 1e6 * (0.9 + edge_m - y_m) / 7.2
            stamps = at[at[:, 3] == polarity, 0]
            if not 0.0 < crossing_us < 0.25e6 - tick_us:
                assert not len(stamps)
                continue
            first = math.floor(crossing_us / tick_us) * tick_us
            assert len(stamps) > 5  # from white to black: many thresholds
            assert stamps.min() >= first - 1  # stamps are whole microseconds
            assert stamps.max() <= first + tick_us + 1
    # Nothing fires where the board is not: the vehicle hovers on the spot.
    rows = fired[:, 2] + 0.5 - 24.0
    assert np.abs(rows).max() <= 0.25 * fx / 2.0 + 0.5
    assert len(np.unique(fired[:, 1])) > 45


def test_pictures_show_bodies_where_they_are_at_the_stamp(room, device):
    """The middle of the black board in each picture, against its motion."""
    packets = list(ns.run(settings(room, device, {"board": SLIDING})))
    pictures = [p for p in packets if isinstance(p, Image) and p.sensor == "rgb"]
    assert len(pictures) == 11
    fx = 0.5 * LENS["width"] / math.tan(0.5 * LENS["horizontal_fov_rad"])
    seen = 0
    for picture in pictures:
        columns = np.nonzero(picture.data[24].max(axis=-1) == 0)[0]
        y_m = 0.9 - 7.2e-9 * picture.stamp_ns
        expected = 0.5 * LENS["width"] - fx * y_m / 2.0
        if 6.0 < expected < 58.0:
            assert np.mean(columns + 0.5) == pytest.approx(expected, abs=0.51)
            seen += 1
    assert seen > 8


@pytest.mark.parametrize("instants", [1, 64])
def test_batches_change_no_bit(room, device, instants):
    expected = list(ns.run(settings(room, device, BUSY)))
    cut = list(ns.run(settings(room, device, BUSY, instants_per_launch=instants)))
    assert content(cut) == content(expected)
    assert len(events_of(cut)) > 10_000


def test_batches_in_flight_and_graphs_change_no_bit(room, device):
    """On CUDA a second batch in the same buffers is recorded, and replayed from then on; bodies move on."""
    model = sim.make_model(ns.load_config(settings(room, device, BUSY, instants_per_launch=5)))
    one, two = (list(sim.run_model(model, sim.make_state(model, in_flight=n))) for n in (1, 2))
    assert content(one) == content(two)
    pictures = [p.data.tobytes() for p in one if isinstance(p, Image) and p.sensor == "depth"]
    assert len(set(pictures)) == len(pictures) == 13


def test_a_second_episode_begins_with_bodies_where_they_were(room, device):
    model = sim.make_model(ns.load_config(settings(room, device, BUSY)))
    first, second = (list(sim.run_model(model, sim.make_state(model))) for _ in range(2))
    assert content(first) == content(second)


def test_steps_from_outside_see_the_same_bodies(room, device):
    """Control periods of 5 ms, held rotor speeds: pictures are those of a run at the same states."""
    config = ns.load_config(settings(room, device, BUSY, duration_s=0.1))
    model = sim.make_model(config)
    state = sim.make_state(model)
    packets: list[Packet] = []
    while state.launched_ns < model.duration_ns:
        packets += sim.step(model, state, None)
    packets += sim.finish(state)
    expected = list(ns.run(config))
    # The vehicle hovers with or without a controller, to 1e-9 m: compared are pictures, not its state.
    for name in ("depth", "rgb"):
        stepped = [p for p in packets if p.sensor == name]
        flown = [p for p in expected if p.sensor == name]
        assert [p.stamp_ns for p in stepped] == [p.stamp_ns for p in flown]
        for a, b in zip(stepped, flown, strict=True):
            assert (np.abs(a.data.astype(float) - b.data) < 1e-3).mean() > 0.999


def test_a_run_without_cameras_loads_no_body(room):
    lost = {"lost": {"shape": {"kind": "mesh", "file": "/nowhere/lost.glb"}}}
    imu = {"imu": {"kind": "imu"}}
    model = sim.make_model(ns.load_config(settings(room, "cpu", lost, sensors=imu)))
    assert model.bodies == ()
    with pytest.raises(ValueError, match=r"lost.glb: no such file"):
        sim.make_model(ns.load_config(settings(room, "cpu", lost)))


BOX = {"shape": {"kind": "box", "size_m": [0.2, 0.6, 0.6]}, "surface": BLACK}


@pytest.mark.parametrize("adaptive", [False, True])
def test_a_body_is_shown_moved_and_hidden_while_time_goes_on(room, device, adaptive):
    """From then on pictures are those of a run with the body there always; its appearance makes events."""

    def model_of(**body: Any) -> sim.Model:
        config = settings(room, device, {"box": {**BOX, **body}})
        if adaptive:
            config["sensors"]["events"]["max_displacement_px"] = 0.5
        return sim.make_model(ns.load_config(config))

    def fly(model: sim.Model, state: sim.State) -> list[Packet]:
        rotors = np.full(model.airframe.rotor_count, model.airframe.hover_rotor_speed_rad_s)
        return [packet for _ in range(10) for packet in sim.step(model, state, rotors)]

    def depths(packets: list[Packet]) -> list[np.ndarray]:
        return [p.data for p in packets if isinstance(p, Image) and p.sensor == "depth"]

    near = {"position_m": [2.1, 0.2, 0.0]}
    far = {"position_m": [3.1, -0.5, 0.0]}
    models = [model_of(present=False), model_of(motion=near), model_of(motion=far), model_of(present=False)]
    changing = sim.make_state(models[0])
    flown = [fly(models[0], changing)]
    for model in models[1:]:
        sim.move_bodies(changing.groups, model.config.bodies)
        flown.append(fly(models[0], changing))
    for index, model in enumerate(models):
        state = sim.make_state(model)
        expected = [fly(model, state) for _ in models][index]
        for ours, theirs in zip(depths(flown[index]), depths(expected), strict=True):
            assert np.array_equal(ours, theirs)
    assert depths(flown[1])[-1][24, 30] == pytest.approx(1.9, abs=1e-3)  # the camera sits 0.1 m ahead
    fired = [len(events_of(packets)) for packets in flown]
    assert fired[0] == 0
    assert min(fired[1:]) > 200  # about 200 pixels see it come or go


def test_what_cannot_be_thrown_is_said(room):
    """A wrong shape or dtype, no bodies, and a sensor that knows how bodies of the configuration move."""

    def throw(bodies: dict[str, Any], dtype: Any, count: int, **changes: Any) -> None:
        worlds = ns.Simulation(settings(room, "cpu", bodies, **changes), worlds=2)
        start: Any = wp.zeros((2, count), dtype=dtype, device="cpu")
        worlds.throw_bodies(start, start)

    ball = {"ball": {"shape": {"kind": "sphere"}}}
    flow = {"flow": {"kind": "optical_flow", "lens": LENS}}
    for dtype, count in ((wp.vec3d, 2), (wp.vec3, 1)):
        with pytest.raises(ValueError, match=r"position must be vec3d of shape \(2, 1\)"):
            throw(ball, dtype, count)
    with pytest.raises(ValueError, match="no bodies to throw"):
        throw({}, wp.vec3d, 0)
    with pytest.raises(ValueError, match="throw_bodies: cameras that process their pictures"):
        throw(ball, wp.vec3d, 1, sensors=flow)
