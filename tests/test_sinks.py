"""Where the packets of a flight go: sinks of our own and of outside packages, by kind."""

from __future__ import annotations

import signal
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import yaml
from small_room import room_scene

import cortex
import cortex.messages
import neurosim_core as ns
from neurosim_core.io import open_events
from neurosim_core.live.recorder import Recorder
from neurosim_core.sensors.event_labels import LabelledEvents
from neurosim_core.sinks import SinkConfig, SinkContext
from neurosim_core.view import sinks as view_sinks


@ns.register("sink", "test_list")
class ListSinkConfig(SinkConfig):
    """Keeps what it is given; `fails_at` is the packet that it cannot take."""

    kind: Literal["test_list"] = "test_list"
    fails_at: int = -1
    error: Literal["OSError", "KeyError"] = "OSError"
    is_optional = False

    def open(self, context: SinkContext) -> ListSink:
        """Return the sink."""
        sink = ListSink(self, context)
        OPENED.append(sink)
        return sink


@ns.register("sink", "test_weak")
class WeakSinkConfig(ListSinkConfig):
    """The same, and the flight goes on without it."""

    kind: Literal["test_weak"] = "test_weak"  # type: ignore[assignment]
    is_optional = True


class ListSink:
    def __init__(self, config: ListSinkConfig, context: SinkContext) -> None:
        self.config, self.context = config, context
        self.packets: list[ns.Packet] = []
        self.closed: list[bool] = []

    def write(self, packet: ns.Packet) -> None:
        if len(self.packets) == self.config.fails_at:
            raise {"OSError": OSError, "KeyError": KeyError}[self.config.error]("the line is dead")
        self.packets.append(packet)

    def close(self, *, complete: bool = True) -> None:
        self.closed.append(complete)


OPENED: list[ListSink] = []


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> dict[str, Any]:
    return room_scene(tmp_path_factory.mktemp("room"))


@pytest.fixture(autouse=True)
def none_opened():
    OPENED.clear()


LENS = {"width": 32, "height": 24, "horizontal_fov_rad": 1.4}


def settings(scene: dict[str, Any], **sinks: Any) -> ns.SimulationConfig:
    return ns.load_config(
        {
            "scene": scene,
            "device": "cpu",
            "duration_s": 0.2,
            "path": {"kind": "line", "start_m": [-0.2, 0.0, 1.2], "end_m": [0.2, 0.0, 1.2]},
            "sensors": {
                "events": {"kind": "event_camera", "lens": LENS, "pixel": {"threshold_on": 0.02}},
                "depth": {"kind": "depth", "lens": LENS, "rate_hz": 20.0},
                "odometry": {"kind": "odometry", "rate_hz": 100.0},
            },
            "sinks": {"recording": {"kind": "hdf5"}, **sinks},
        }
    )


def recorded(folder: Path, name: str = "flight.h5") -> list[ns.Packet]:
    with ns.Recording(folder / name) as recording:
        return list(recording.packets())


def test_the_overview_says_the_real_time_factor_of_the_report(scene, tmp_path, monkeypatch):
    """Also where other sinks take long to open."""
    said = []

    def open_late(config: ListSinkConfig, context: SinkContext) -> ListSink:
        time.sleep(1.0)
        return ListSink(config, context)

    monkeypatch.setattr(ListSinkConfig, "open", open_late)
    monkeypatch.setattr(
        view_sinks, "save_overview", lambda *_, **given: said.append(given["real_time_factor"])
    )
    sinks = {"slow": {"kind": "test_list"}, "overview": {"kind": "overview"}}
    report = ns.fly(settings(scene, **sinks), tmp_path)
    assert said == [pytest.approx(report.real_time_factor, rel=0.3)]  # of the time after the last packet


def test_an_outside_sink_gets_what_the_recording_gets(scene, tmp_path):
    config = settings(scene, mine={"kind": "test_list"})
    ns.fly(yaml.safe_load(ns.to_yaml(config)), str(tmp_path))  # as programs write it
    (sink,) = OPENED
    assert (sink.context.name, sink.context.folder, sink.context.stem) == ("mine", tmp_path, "flight")
    assert [s.name for s in sink.context.header.sensors] == ["events", "depth", "odometry"]
    kept = recorded(tmp_path)
    assert [(p.sensor, p.stamp_ns) for p in sink.packets] == [(p.sensor, p.stamp_ns) for p in kept]
    assert sum(len(p) for p in sink.packets if isinstance(p, ns.Events)) > 100
    assert sink.closed == [True]
    assert {path.name for path in tmp_path.iterdir()} == {"config.yaml", "flight.h5"}


@pytest.mark.parametrize(
    ("error", "raised", "said"),
    [("OSError", OSError, "sinks.mine: the line is dead"), ("KeyError", KeyError, "the line is dead")],
)
def test_one_that_fails_ends_the_flight_and_the_others_are_whole(
    scene, tmp_path, capsys, error, raised, said
):
    mine = {"kind": "test_list", "fails_at": 5, "error": error}
    with pytest.raises(raised, match=said):
        ns.fly(settings(scene, mine=mine, overview={"kind": "overview"}), tmp_path)
    assert len(recorded(tmp_path)) == 6  # the recording comes before it
    assert (tmp_path / "overview.png").exists()
    assert "overview.png" in capsys.readouterr().out  # the report is printed all the same


def test_one_that_cannot_be_opened_leaves_no_flight_that_seems_complete(scene, tmp_path):
    (tmp_path / "events.raw").mkdir()
    mine = {"kind": "event_file", "name": "events.raw"}
    with pytest.raises(IsADirectoryError):
        ns.fly(settings(scene, overview={"kind": "overview"}, mine=mine), tmp_path)
    assert not (tmp_path / "overview.png").exists()
    with ns.Recording(tmp_path / "flight.h5") as recording:
        assert not recording.clean


@pytest.mark.parametrize("error", ["OSError", "KeyError"])
def test_one_that_fails_live_is_told_and_the_recording_says_that_it_is_not_complete(scene, tmp_path, error):
    config = settings(scene, mine={"kind": "test_list", "fails_at": 5, "error": error})
    model = ns.make_model(config)
    recorder = Recorder({"drone": tmp_path}, {"drone": model})
    recorder.begin({"drone": 0}, replace=False)

    def record() -> None:
        for packet in ns.run_model(model, ns.make_state(model)):
            recorder.write("drone", packet)
        recorder.close()

    with pytest.raises((OSError, KeyError), match="the line is dead"):
        record()
    with ns.Recording(tmp_path / "flight.h5") as recording:
        assert (len(list(recording.packets())), recording.clean) == (6, False)


def test_a_live_run_that_would_record_nothing_is_refused(scene, tmp_path):
    config = settings(scene, recording={"kind": "cortex"})
    with pytest.raises(ValueError, match="none of `sinks` records a live run"):
        Recorder({"drone": tmp_path}, {"drone": ns.make_model(config)})


def test_an_optional_one_does_not(scene, tmp_path, capsys):
    ns.fly(settings(scene, mine={"kind": "test_weak", "fails_at": 5}), tmp_path)
    assert "mine is given up: the line is dead" in capsys.readouterr().out
    assert OPENED[0].closed == [False]
    assert recorded(tmp_path)[-1].stamp_ns == 200_000_000


def test_live_runs_hand_their_packets_to_it_too(scene, tmp_path):
    config = settings(scene, mine={"kind": "test_list"}, rerun={"kind": "rerun"})
    model = ns.make_model(config)
    recorder = Recorder({"drone": tmp_path}, {"drone": model})
    packets = list(ns.run_model(model, ns.make_state(model)))
    for _ in range(2):  # the second time after a reset
        recorder.begin({"drone": 0}, replace=False)
        for packet in packets:
            recorder.write("drone", packet)
    recorder.close()
    assert [(sink.context.stem, len(sink.packets)) for sink in OPENED] == [
        ("flight", len(packets)),
        ("flight-2", len(packets)),
    ]
    assert len(recorded(tmp_path, "flight-2.h5")) == len(packets)
    assert not list(tmp_path.glob("*.rrd"))  # a viewer shows what is live


@pytest.mark.parametrize("name", ["events.raw", "events.csv", "bag.mcap"])
def test_events_go_to_files_of_other_tools(scene, tmp_path, name):
    if name.endswith(".mcap"):
        pytest.importorskip("rosbags")
    ns.fly(settings(scene, other={"kind": "event_file", "name": name}), tmp_path)
    reader = open_events(tmp_path / name, size=(32, 24))
    blocks = list(reader.blocks())
    reader.close()
    wanted = [p.numpy() for p in recorded(tmp_path) if isinstance(p, ns.Events)]
    for column in range(4):
        found = np.concatenate([block[column] for block in blocks])
        assert (found == np.concatenate([events[column] for events in wanted])).all()


def test_an_event_file_that_cannot_be_written_is_refused_at_once(scene, tmp_path, monkeypatch):
    """Before the set-up, and no folder is left behind."""
    monkeypatch.setattr("neurosim_core.flight.make_model", None)
    left = {"kind": "event_file", "name": "events.raw", "sensor": "left"}
    with pytest.raises(ValueError, match=r"sinks\.other: no event camera 'left', known: events"):
        ns.fly(settings(scene, other=left), tmp_path / "flight")
    monkeypatch.setitem(sys.modules, "cortex_ros2_bridge.bag_file", None)  # as where rosbags is missing
    with pytest.raises(ImportError, match="bags of ROS 2 need rosbags"):
        ns.fly(settings(scene, other={"kind": "event_file", "name": "bag.mcap"}), tmp_path / "flight")
    assert not (tmp_path / "flight").exists()


@pytest.mark.parametrize("labels", [[], ["depth"]])
def test_a_flight_is_published(scene, tmp_path, monkeypatch, labels):
    """A reliable reader gets every packet, as it is recorded; events with their truth, if they have it."""
    monkeypatch.setenv("CORTEX_RUNTIME_DIR", str(tmp_path))
    found: dict[str, list[Any]] = {"events": [], "odometry": []}
    plain = settings(scene, out={"kind": "cortex", "wait_s": 30.0}).model_dump(mode="json")
    config = ns.load_config(plain, overrides={"sensors.events.labels": labels})
    flying = threading.Thread(target=ns.fly, args=(config, tmp_path / "flight"))
    with cortex.Node("reader") as node:
        events = ns.message_type(LabelledEvents) if labels else cortex.messages.Events
        kinds = {"events": events, "odometry": cortex.messages.Odometry, "depth": cortex.messages.Image}
        subscribers = {
            name: node.subscriber(f"/drone/{name}", kind, policy=cortex.reliable())
            for name, kind in kinds.items()
        }
        flying.start()
        for name, messages in found.items():
            while not messages or messages[-1].stamp_ns < 200_000_000:
                messages.append(subscribers[name].recv(60.0))
        flying.join(60.0)
    for name, messages in found.items():
        kept = [packet for packet in recorded(tmp_path / "flight") if packet.sensor == name]
        assert [message.stamp_ns for message in messages] == [packet.stamp_ns for packet in kept]
    assert (found["odometry"][-1].position == kept[-1].position).all()
    if labels:
        kept = [packet for packet in recorded(tmp_path / "flight") if packet.sensor == "events"]
        assert all((m.depth == p.depth).all() for m, p in zip(found["events"], kept, strict=True))
        assert sum(len(message.depth) for message in found["events"]) > 100


def test_a_flight_that_waits_for_its_readers_waits_once_and_can_be_stopped(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("CORTEX_RUNTIME_DIR", str(tmp_path))
    waits: list[float] = []

    def nobody(_: Any, timeout_s: float) -> bool:
        waits.append(timeout_s)
        time.sleep(0.1)
        return False

    monkeypatch.setattr(cortex.Publisher, "wait_for_subscribers", nobody)
    ns.fly(settings(scene, out={"kind": "cortex", "wait_s": 0.3}), tmp_path / "alone")
    assert len(waits) <= 3  # nine, if each of three sensors was waited for

    def interrupt(*_: Any, **__: Any) -> bool:
        signal.raise_signal(signal.SIGINT)
        return False

    monkeypatch.setattr(cortex.Publisher, "wait_for_subscribers", interrupt)
    report = ns.fly(settings(scene, out={"kind": "cortex", "wait_s": 3600.0}), tmp_path / "flight")
    assert (report.interrupted, report.simulated_ns) == (True, 0)


def test_settings_change_the_default_set_or_replace_it():
    kinds = {"recording": "hdf5", "rerun": "rerun", "overview": "overview"}

    def loaded(source: Any = None, **overrides: Any) -> dict[str, str]:
        config = ns.load_config(source, overrides=overrides)
        assert ns.load_config(yaml.safe_load(ns.to_yaml(config))) == config
        return {name: sink.kind for name, sink in config.sinks.items()}

    mine = {"mine": {"kind": "test_list"}}
    assert loaded() == kinds
    assert loaded({"sinks+": {**mine, "rerun": None}}) == {
        "recording": "hdf5",
        "overview": "overview",
        "mine": "test_list",
    }
    assert loaded({"sinks": mine}) == {"mine": "test_list"}
    assert loaded(**{"sinks.overview": None}) == {"recording": "hdf5", "rerun": "rerun"}
    with pytest.raises(ns.ConfigError, match=r"give `sinks`, which replace the default set, or `sinks\+`"):
        loaded({"sinks": mine, "sinks+": mine})
    with pytest.raises(ns.ConfigError, match=r"sinks: mine would write flight.h5, and so does recording"):
        loaded({"sinks+": {"mine": {"kind": "hdf5"}}})
    with pytest.raises(ns.ConfigError, match=r"mine would write flight.h5, and so does recording"):
        loaded({"sinks+": {"mine": {"kind": "event_file", "name": "flight.h5"}}})
    with pytest.raises(ns.ConfigError, match=r"sinks.mine.name: config.yaml: no format of events has this"):
        loaded({"sinks": {"mine": {"kind": "event_file", "name": "config.yaml"}}})
    with pytest.raises(ns.ConfigError, match=r"sinks.mine.name: a.es: this format is only read"):
        loaded({"sinks": {"mine": {"kind": "event_file", "name": "a.es"}}})
    with pytest.raises(ns.ConfigError, match=r"sinks.mine.kind: must be one of .*'test_list'"):
        loaded({"sinks": {"mine": {"kind": "test_lis"}}})


def test_a_nearly_full_disk_makes_only_files_give_way_that_are_there(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1_000))
    (tmp_path / "mine").mkdir()  # as the sink is called
    ns.fly(settings(scene, mine={"kind": "test_weak"}), tmp_path)
    assert OPENED[0].closed == [True]  # it has no file
