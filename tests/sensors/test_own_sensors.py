"""What is left out in a sensor of one's own is said by its name, before or when it is flown."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray
from small_room import room_scene

import neurosim_core as ns
from neurosim_core.flight import fly
from neurosim_core.sensors import (
    FrameContext,
    FrameSensor,
    FrameSensorConfig,
    ImageSensorConfig,
    Launches,
    RateHz,
    RenderRequest,
    Sampler,
    SamplerContext,
    StateSensorConfig,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Height(ns.Packet):
    """Height above the origin."""

    height_m: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Loose(ns.Packet):
    """Its array says nothing of its axes."""

    air: NDArray[np.float64]


class HeightConfig(StateSensorConfig):
    """Reads the height; `wrong` says what is left out."""

    kind: Literal["test_height"] = "test_height"
    rate_hz: RateHz = 100.0
    wrong: str = ""

    packet_type = Height

    def make(self, context: SamplerContext) -> Sampler:
        """Return the sensor at work."""
        return HeightSampler(self.wrong, context)


class HeightSampler(Sampler):
    """Copies positions."""

    def __init__(self, wrong: str, context: SamplerContext) -> None:
        self._wrong, self._position = wrong, context.vehicle.arrays.position
        shape = (context.slot_count, context.vehicle.count)
        if wrong == "slot":
            self.arrays = {"position": wp.zeros(context.vehicle.count, dtype=wp.vec3d, device="cpu")}
        elif wrong == "reader":
            ns.sensors.make_reader(context, lambda *_: 0.0, wp.float64(1.0), {}, Height, rate_hz=100.0)
        elif wrong != "arrays":
            self.arrays = {"position": wp.zeros(shape, dtype=wp.vec3d, device="cpu")}

    def measure(self, slot: int) -> None:
        """Copy the present positions into a slot."""
        wp.copy(self.arrays["position"][slot], self._position)

    def packet(self, rows: Any, **header: Any) -> Any:
        """Return one sample as a packet, or what was asked for instead."""
        height_m = float(rows["positon" if self._wrong == "row" else "position"][2])
        packet = Height(height_m=height_m, **({} if self._wrong == "header" else header))
        return {"": packet, "none": None, "number": height_m}.get(self._wrong, packet)


@pytest.fixture(scope="module")
def hover(tmp_path_factory):
    """Return settings of a hover with the sensor in a small room."""
    scene = room_scene(tmp_path_factory.mktemp("room"))
    path = {"kind": "hover", "position_m": [0.0, 0.0, 1.2]}
    base = ns.load_config({"scene": scene, "duration_s": 0.05, "device": "cpu", "path": path, "sensors": {}})

    def make(wrong: str = "") -> ns.SimulationConfig:
        return base.model_copy(update={"sensors": {"height": HeightConfig(wrong=wrong)}})

    return make


def test_the_sensor_is_right_where_nothing_is_left_out(hover):
    assert [packet.height_m for packet in ns.run(hover())] == pytest.approx([1.2] * 6, abs=1e-3)


@pytest.mark.parametrize(
    ("wrong", "error", "said"),
    [
        ("arrays", TypeError, r"sensor 'height': HeightSampler must set `self\.arrays`"),
        (
            "reader",
            TypeError,
            r"sensor 'height': it must read by a Warp function \(@wp\.func\), got <function",
        ),
        ("slot", ValueError, r"sensor 'height': arrays\['position'\] needs shape \[slot, world, \.\.\.\]"),
        ("row", KeyError, r"sensor 'height': no array 'positon' was measured, known: \['position'\]"),
        ("header", ValueError, r"packet\(\) must pass the header on: Height\(\.\.\., \*\*header\)"),
        ("number", TypeError, r"packet\(\) must return a packet or None, got 1\.2"),
    ],
)
def test_what_a_sampler_lacks_is_said(hover, wrong, error, said):
    with pytest.raises(error, match=said):
        list(ns.run(hover(wrong)))


def test_a_sensor_that_never_gives_a_packet_is_said(hover, tmp_path, capsys):
    fly(hover("none"), tmp_path, rerun=False)
    assert "height none of 6: its packet() returned None each time" in capsys.readouterr().out


def class_with(*, base: type[Any] = StateSensorConfig, **members: Any) -> type[Any]:
    return type("OwnConfig", (base,), {"__module__": __name__, **members})


KIND = {"__annotations__": {"kind": str}, "kind": "own"}
RATE = {"__annotations__": {"kind": str, "rate_hz": float}, "kind": "own", "rate_hz": 100.0}


@pytest.mark.parametrize(
    ("members", "said"),
    [
        (RATE, "OwnConfig.packet_type must be a subclass of ns.Packet, got None: add `packet_type = "),
        ({**RATE, "packet_type": Loose}, r"Loose\.air: the array needs axes, such as Annotated\["),
        ({**KIND, "packet_type": Height}, "OwnConfig needs a field `rate_hz: RateHz = 100.0`"),
        ({"packet_type": Height}, r'OwnConfig needs a field `kind: Literal\["own"\] = "own"`'),
        (
            {**KIND, "base": ImageSensorConfig},
            'OwnConfig must name a render output, such as output = "depth"',
        ),
    ],
)
def test_what_a_class_lacks_is_said_when_it_is_registered(members, said):
    with pytest.raises(TypeError, match=said):
        ns.register("sensor", "own")(class_with(**members))
    assert "own" not in ns.registry.kinds("sensor")


def test_a_kind_has_one_name():
    with pytest.raises(ValueError, match=r"'test_hight', but its field `kind` is 'test_height'"):
        ns.register("sensor", "test_hight")(HeightConfig)


def test_a_rate_without_bounds_is_said_by_the_sensor():
    @ns.register("sensor", "test_fast")
    class Fast(StateSensorConfig):
        kind: Literal["test_fast"] = "test_fast"
        rate_hz: float = 100.0
        packet_type = Height

    with pytest.raises(ns.ConfigError, match=r"sensors: fast: rate_hz must be in \(0, 1e9\], got -5"):
        ns.load_config({"sensors": {"fast": {"kind": "test_fast", "rate_hz": -5}}})


def test_errors_and_kinds_of_sensors_are_said_as_they_are_written():
    with pytest.raises(
        ns.ConfigError, match=r"must be a number, or a list of 3 numbers, .*got \[0\.1, 0\.1\]"
    ):
        ns.load_config({"sensors": {"air": {"kind": "barometer", "errors": {"white": [0.1, 0.1]}}}})
    with pytest.raises(ns.ConfigError, match=r"errors\.white: .*greater than or equal to 0, got -1"):
        ns.load_config({"sensors": {"air": {"kind": "barometer", "errors": {"white": -1}}}})
    with pytest.raises(ns.ConfigError, match="got 'barometr'; did you mean 'barometer'"):
        ns.load_config({"sensors": {"air": {"kind": "barometr"}}})


GOOD = """
from dataclasses import dataclass
from typing import Literal
import neurosim_core as ns

@dataclass(frozen=True, kw_only=True, eq=False)
class Mark(ns.Packet):
    level: float

@ns.register("sensor", "{kind}")
class MarkConfig(ns.sensors.StateSensorConfig):
    kind: Literal["{kind}"] = "{kind}"
    rate_hz: ns.sensors.RateHz = 100.0
    packet_type = Mark
"""


def test_plug_ins_that_fail_leave_nothing_and_others_are_known_to_recordings(tmp_path):
    (tmp_path / "good_marks.py").write_text(GOOD.format(kind="good_mark"))
    (tmp_path / "bad_marks.py").write_text(GOOD.format(kind="bad_mark") + "import not_there\n")
    folder = tmp_path / "marks-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: marks\nVersion: 1.0\n")
    entries = "[neurosim.plugins]\nbad = bad_marks\ngood = good_marks\n"
    (folder / "entry_points.txt").write_text(entries)
    code = """
import sys
import neurosim_core as ns
from neurosim_core.record import RecordingHeader, RecordingWriter
if sys.argv[1] == "write":
    import good_marks
    with RecordingWriter("marks.h5", RecordingHeader(config_yaml="", seed=0, version="")) as writer:
        writer.write(good_marks.Mark(level=2.5, sensor="marks"))
else:
    with ns.Recording("marks.h5") as recording:
        print(type(next(recording.packets())).__module__, recording.notes)
    print("bad_mark" in ns.registry.kinds("sensor"), "good_mark" in ns.registry.kinds("sensor"))
    try:
        ns.load_config({"sensors": {"mark": {"kind": "bad_mark"}}})
    except ns.ConfigError as error:
        print(error)
"""
    environment = {
        "PYTHONPATH": f"{tmp_path}:{Path(ns.__file__).parents[1]}",
        "PATH": "",
        "HOME": str(tmp_path),
    }
    for mode in ("write", "read"):
        done = subprocess.run(
            [sys.executable, "-c", code, mode],
            capture_output=True, text=True, cwd=tmp_path, env=environment, timeout=600, check=True,
        )  # fmt: skip
    lines = done.stdout.splitlines()
    assert lines[:2] == ["good_marks ()", "False True"]
    assert "got 'bad_mark'; did you mean 'good_mark'?" in lines[-1]
    assert "the plug-in bad (bad_marks) cannot be loaded: No module named 'not_there'" in done.stderr


def test_messages_of_own_sensors_come_from_their_packets():
    kind = ns.message_type(Height)
    assert ns.to_packet(kind(stamp_ns=3, height_m=1.5, sequence=2, frame_id=""), "height").height_m == 1.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Brightness(ns.Packet):
    """The mean of a rendered instant."""

    log_radiance: float


class BrightnessConfig(FrameSensorConfig):
    """Takes the mean of every rendered instant."""

    kind: Literal["test_brightness"] = "test_brightness"
    rate_hz: RateHz = 200.0

    packet_type = Brightness

    def render_request(self) -> RenderRequest:
        """Return what it asks of the renderer."""
        return RenderRequest(frozenset(["log_radiance"]), rate_hz=self.rate_hz, every_instant=True)

    def make(self, context: FrameContext) -> FrameSensor:
        """Return the sensor at work, in one world or in many."""
        return BrightnessSensor(context)


class BrightnessSensor(FrameSensor):
    """Has the means of the last batch in `results`, shape [N, K]."""

    def __init__(self, context: FrameContext) -> None:
        self._name, self._count = context.name, 0
        self.results = np.zeros((len(context.seeds), context.instant_count))

    def _look(self, frames: Any, count: int) -> None:
        rows = frames.numpy().reshape(len(self.results), -1, *frames.shape[1:])
        self.results[:, :count] = rows[:, :count].mean(axis=(2, 3))

    def begin(self, frames: Any, stamp_ns: int, mask: Any) -> None:
        """Take the mean of the first instant, too."""
        self._look(frames, 1)

    def plan(self, frames: Any, stamps_ns: Any, end_ns: int) -> Launches:
        """Return what looks: it waits, and cannot be recorded."""
        return Launches(None, lambda: self._look(frames, len(stamps_ns)))

    def begin_read(self, stamps_ns: Any, *, until_ns: int) -> Any:
        """Return what gives the packets of a batch."""
        rows = list(zip(stamps_ns, self.results[0].tolist(), strict=False))

        def packets() -> list[ns.Packet]:
            found = [
                Brightness(log_radiance=mean, stamp_ns=stamp, sensor=self._name, sequence=self._count + place)
                for place, (stamp, mean) in enumerate(rows)
                if stamp <= until_ns
            ]
            self._count += len(found)
            return [*found]

        return packets


def test_one_frame_sensor_is_for_one_world_and_for_many(tmp_path):
    """Its packets in a run are its results in worlds."""
    camera = BrightnessConfig(lens={"width": 16, "height": 12, "horizontal_fov_rad": 1.5})
    path = {"kind": "circle", "center_m": [0.0, 0.0, 1.2], "radius_m": 0.4, "speed_max_m_s": 0.5}
    settings = {
        "scene": room_scene(tmp_path),
        "duration_s": 0.1,
        "device": "cpu",
        "path": path,
        "sensors": {},
    }
    config = ns.load_config(settings).model_copy(update={"sensors": {"mean": camera}})
    packets = list(ns.run(config))
    assert [packet.stamp_ns for packet in packets] == list(range(0, 100_000_001, 5_000_000))
    worlds = ns.Simulation(config, worlds=2)
    found = [worlds.reset().frames["mean"][:, 0].copy()]
    while len(found) < len(packets):
        found += list(worlds.rollout(1).frames["mean"].T.copy())
    expected = np.array([packet.log_radiance for packet in packets])
    assert len(np.unique(expected)) > 10
    np.testing.assert_array_equal(np.array(found), np.stack([expected, expected], axis=1))
