"""What `neurosim view` leaves in files, while simulators come, begin again and go."""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
import trimesh
from fake_simulator import HEIGHT, MS, ROTORS, SENSORS, WIDTH, FakeSimulator, make_events
from processes import SOON_S, wait_for
from rerun_file import Rows, read, scalars

from cortex import Node
from cortex import messages as msg
from neurosim_core.live import viewer as viewer_module
from neurosim_core.live.messages import to_message, to_packet
from neurosim_core.live.session import ViewOptions
from neurosim_core.live.viewer import view, watch
from neurosim_core.packets import EventArrays
from neurosim_core.sensors.event_labels import LabelledEvents
from neurosim_core.view.pictures import event_picture
from neurosim_core.view.rerun_sdk import RerunFiles

BODY = "/world/vehicles/drone"

pytestmark = pytest.mark.usefixtures("runtime")


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A scene that is loaded at once."""
    path = tmp_path_factory.mktemp("scene") / "box.glb"
    trimesh.creation.box((4, 4, 3)).export(path)
    return str(path)


class Watcher:
    """A viewer in a thread, which writes files."""

    def __init__(self, path: Path, **options: Any) -> None:
        self.said: list[str] = []
        self._stop = threading.Event()
        self._pool = ThreadPoolExecutor(1)
        self.result: Future[int] = self._pool.submit(self._run, path, options)

    def _run(self, path: Path, options: dict[str, Any]) -> int:
        to_the_end = options.pop("to_the_end", False)
        shown = ViewOptions(**options)
        with Node("viewer") as node:
            outlet = RerunFiles(path, self.said.append)
            return watch(node, outlet, shown, stop=self._stop, say=self.said.append, to_the_end=to_the_end)

    def wait_for(self, text: str) -> None:
        """Wait until it has said something."""
        wait_for(lambda: self.result.done() or any(text in line for line in self.said))
        assert any(text in line for line in self.said), (self.said, self.result)

    def end(self) -> int:
        """End it, and return what it returned."""
        self._stop.set()
        self._pool.shutdown()
        return self.result.result()


@pytest.fixture
def start() -> Iterator[Callable[..., Watcher]]:
    """Starts viewers, and ends them."""
    watchers: list[Watcher] = []

    def make(path: Path, **options: Any) -> Watcher:
        watchers.append(Watcher(path, **options))
        return watchers[-1]

    yield make
    for watcher in watchers:
        watcher._stop.set()
        watcher._pool.shutdown()


def grows_to(
    path: Path, check: Callable[[Rows], object], meanwhile: Callable[[], object] = lambda: None
) -> Rows:
    """Wait until what is in a file, which is still written, fulfils a condition."""
    rows: Rows = {}

    def fulfilled() -> bool:
        nonlocal rows
        meanwhile()
        # it has no recording yet, or its last message is half written
        with contextlib.suppress(FileNotFoundError, ValueError, RuntimeError):
            rows = read(path)
        return bool(rows and check(rows))

    wait_for(fulfilled, every_s=0.1)
    return rows


def test_what_is_published_is_in_the_file(tmp_path, box, start):
    """Every sample at its stamp, one picture of events per window, path, commands, timing, losses, status."""
    file = tmp_path / "live.rrd"
    watcher = start(file, event_window_ns=30 * MS, image_rate_hz=1000.0)
    with FakeSimulator(box) as simulator:
        simulator.announce()
        simulator.wait_for_cameras()
        for k in range(101):
            simulator.state(k)
            if k % 2 and k < 99:
                simulator.sensors["dvs"].publish(make_events(k // 2))
        simulator.image(1)
        simulator.status(0, "waiting")
        wait_for(lambda: simulator.statuses.counters.published == 1)
        grows_to(file, lambda rows: "/status" in rows and "/world/scene/room/0" in rows)
        simulator.status(500 * MS, dropped=9)
        simulator.commands["rates"].publish(
            msg.RateThrustCommand(stamp_ns=480 * MS, thrust_n=5.0, body_rate=np.arange(3.0))
        )
        half = np.array([0.0, 0.0, np.sin(0.25), np.cos(0.25)])
        for _ in range(2):  # without a stamp: it is shown when it comes
            simulator.commands["attitude"].publish(
                msg.AttitudeCommand(stamp_ns=0, thrust_n=6.0, orientation=half)
            )
        simulator.commands["motor_speeds"].publish(msg.MotorCommand(stamp_ns=490 * MS, speed=np.ones(7)))
        simulator.commands["motor_speeds"].publish(msg.MotorCommand(stamp_ns=495 * MS, speed=ROTORS))
        simulator.collisions.publish(msg.Collision(stamp_ns=7, position=np.ones(3), clearance_m=-0.1))
        wait_for(lambda: simulator.statuses.counters.published == 2)
        grows_to(file, lambda rows: len(scalars(rows, "/simulator/timing")) == 1)
    assert watcher.end() == 130
    rows = read(file)

    stamps = [5 * MS * k for k in range(101)]
    force = scalars(rows, "/plots/drone/imu/specific_force")
    assert force == [(t, [k, 0.0, 9.81]) for k, t in enumerate(stamps)]
    assert scalars(rows, "/plots/drone/odometry/speed") == [(t, [5.0]) for t in stamps]
    rotors = scalars(rows, "/plots/drone/odometry/rotor_speed")
    assert rotors == [(t, list(ROTORS + k)) for k, t in enumerate(stamps)]
    poses = [(t, v["translation"][0][0]) for t, v in rows[BODY] if t is not None]
    assert [t for t, _ in poses] == stamps
    assert [x for _, x in poses] == pytest.approx([0.01 * k for k in range(101)], rel=1e-6)  # float32

    pictures = rows[f"{BODY}/dvs/image"]
    assert [t for t, _ in pictures] == [30 * MS * (k + 1) for k in range(16)]
    for k, (_, values) in enumerate(pictures):
        parts = [make_events(j) for j in range(3 * k, 3 * k + 3)]
        joined = EventArrays(
            *(np.concatenate([getattr(p, name) for p in parts]) for name in ("t", "x", "y", "polarity"))
        )
        with PIL.Image.open(io.BytesIO(bytes(values["blob"][0]))) as found:
            assert (
                np.asarray(found.convert("RGB")) == event_picture(joined, width=WIDTH, height=HEIGHT)
            ).all()
    assert [t for t, _ in rows[f"{BODY}/rgb/image"]] == [50 * MS]
    assert [t for t, _ in rows[f"{BODY}/z/image"]] == [50 * MS]

    assert rows["/world/paths/drone"][0][1]["strips"] == [np.arange(9.0).reshape(3, 3).tolist()]
    assert [v["positions"] for _, v in rows["/world/collisions/drone"]] == [[[1.0, 1.0, 1.0]]]
    assert scalars(rows, "/plots/drone/command/rates") == [(480 * MS, [5.0, 0.0, 1.0, 2.0])]
    attitudes = scalars(rows, "/plots/drone/command/attitude")
    assert [t for t, _ in attitudes] == [0, 500 * MS]
    assert attitudes[1][1] == pytest.approx([6.0, 0.0, 0.0, 0.5])
    assert scalars(rows, "/plots/drone/command/motor_speeds") == [(495 * MS, list(ROTORS))]
    assert scalars(rows, "/simulator/timing") == [(500 * MS, [2.0, 3.0, 0.5, 1.0])]
    assert scalars(rows, "/simulator/real_time_factor") == [(500 * MS, [0.5])]
    assert scalars(rows, "/simulator/losses") == [
        (0, [0.0, 0.0, 3.0, 5.0, 0.0]),
        (500 * MS, [36.0, 0.0, 3.0, 5.0, 0.0]),
    ]
    text = rows["/status"][-1][1]["text"][0]
    assert re.search(
        r"\*\*running\*\*.*0\.500 s, 100 control periods, 0\.50 of 1 x real time", text, re.DOTALL
    )
    assert "| drone/dvs | on | 100 | 1 | 50 | 9 | 0 | 0 | 0 |" in text  # 50 windows in half a second
    assert "| drone/rgb | on | 100 | 1 | 50 | 9 | 0 | 2 | 0 |" in text
    assert "| drone/z | off | - | 1 | 50 | 9 | 0 | 0 | 0 |" in text


def test_labelled_events_and_a_second_odometry_are_shown(tmp_path, box, start):
    file = tmp_path / "live.rrd"
    sensors = {
        "dvs": {**SENSORS["dvs"], "labels": ["cause"]},
        "imu": SENSORS["imu"],
        "truth": {"kind": "odometry", "rate_hz": 10.0},
    }
    watcher = start(file, only=["dvs", "imu", "truth"])
    with FakeSimulator(box, overrides={"sensors": sensors}) as simulator:
        simulator.announce()
        simulator.wait_for_cameras()
        simulator.state(1)
        still = {"orientation": np.array([0.0, 0.0, 0.0, 1.0]), "body_rate": np.zeros(3)}
        state = {"position": np.ones(3), "velocity": np.array([0.0, 0.0, 2.0]), **still}
        simulator.sensors["truth"].publish(msg.Odometry(stamp_ns=9 * MS, **state))
        none = np.zeros(0, np.float32)
        truth = {"depth": none, "flow": none.reshape(0, 2), "labels": "{}", "cause": np.zeros(40, np.uint8)}
        truth |= {"instance": none.astype(np.int32), "semantic": none.astype(np.int32)}
        for k in range(5):
            labelled = LabelledEvents(**vars(to_packet(make_events(k), "dvs")) | truth)
            simulator.sensors["dvs"].publish(to_message(labelled))
        grows_to(file, lambda rows: f"{BODY}/dvs/image" in rows and "/plots/drone/truth/speed" in rows)
    watcher.end()
    rows = read(file)
    assert scalars(rows, "/plots/drone/truth/speed") == [(9 * MS, [2.0])]
    assert scalars(rows, "/plots/drone/odometry/speed") == [(5 * MS, [5.0])]
    assert [t for t, _ in rows[f"{BODY}/dvs/image"]] == [20 * MS, 40 * MS]


def test_a_link_that_is_set_in_flight_is_shown(tmp_path, box, start, monkeypatch):
    file = tmp_path / "live.rrd"
    watcher = start(file)
    with FakeSimulator(box) as simulator:
        simulator.announce()
        simulator.change({"links.imu.latency_s": 0.008})
        deliveries = simulator.node.publisher("/drone/imu/delivery", msg.Delivery)
        assert deliveries.wait_for_subscribers(timeout_s=SOON_S)
        delivery = msg.Delivery(stamp_ns=5 * MS, delivered_ns=13 * MS, size_bytes=48, sequence=0)
        deliveries.publish(delivery)
        simulator.state(1)
        grows_to(file, lambda rows: "/plots/drone/links/imu" in rows)
    watcher.end()
    assert scalars(read(file), "/plots/drone/links/imu") == [(5 * MS, [8.0])]


def test_a_body_that_is_brought_in_is_shown(tmp_path, box, start):
    """In a recording of its own: what a recording shows of a body holds for all of it."""
    watcher = start(tmp_path / "live.rrd")
    ball = {"shape": {"kind": "sphere", "radius_m": 0.2}, "present": False}
    with FakeSimulator(box, overrides={"bodies": {"ball": ball}}) as simulator:
        simulator.announce()
        simulator.state(1)
        grows_to(tmp_path / "live.rrd", lambda rows: "/world/scene/room/0" in rows)
        simulator.change({"bodies.ball.present": True})
        wait_for(lambda: (tmp_path / "live-2.rrd").exists())
        grows_to(
            tmp_path / "live-2.rrd",
            lambda rows: "/world/bodies/ball" in rows,
            meanwhile=lambda: simulator.state(2),
        )
    watcher.end()
    assert "/world/bodies/ball/0" not in read(tmp_path / "live.rrd")
    assert "/world/bodies/ball/0" in read(tmp_path / "live-2.rrd")


def test_pictures_are_limited_by_the_wall_clock(tmp_path, box, start):
    """Of images that come up to 500 times a second, 20 are shown, of windows of events 50."""
    file = tmp_path / "live.rrd"
    watcher = start(file, image_rate_hz=20.0)
    with FakeSimulator(box) as simulator:
        simulator.announce()
        simulator.wait_for_cameras()
        begin_s, k = time.monotonic(), 0
        while time.monotonic() - begin_s < 1.0 or k <= 100:
            simulator.image(k)
            simulator.sensors["dvs"].publish(make_events(k))
            k += 1
            time.sleep(2e-3)  # faster ones would keep the interpreter, which the viewer shares here
        elapsed_s = time.monotonic() - begin_s
        simulator.status(50 * MS * k)
        grows_to(file, lambda rows: "/status" in rows)
    watcher.end()
    rows = read(file)
    for camera, rate_hz in (("rgb", 20.0), ("z", 20.0), ("dvs", 50.0)):
        count = len(rows[f"{BODY}/{camera}/image"])
        late_s = 1.0  # half a second at the end, and as much of windows that are ahead
        assert 5 <= count <= rate_hz * (elapsed_s + late_s), camera  # a busy machine may show fewer


def test_a_reset_begins_a_new_file(tmp_path, box, start, monkeypatch):
    """What is left over of the run before does not come into it; a file that is there already is kept."""
    (tmp_path / "live-2.rrd").write_bytes(b"mine")
    watcher = start(tmp_path / "live.rrd", image_rate_hz=1000.0)
    with FakeSimulator(box) as simulator:
        simulator.announce()
        simulator.wait_for_cameras()
        for k in range(101):
            simulator.state(k)
        simulator.image(9)
        grows_to(tmp_path / "live.rrd", lambda rows: f"{BODY}/rgb/image" in rows)
        for k in range(11):
            simulator.state(k)
        wait_for(lambda: (tmp_path / "live-3.rrd").exists())
        simulator.image(10)
        simulator.status(50 * MS)
        grows_to(tmp_path / "live-3.rrd", lambda rows: "/status" in rows)
        simulator.image(1)
        grows_to(tmp_path / "live-3.rrd", lambda rows: f"{BODY}/rgb/image" in rows)
    watcher.end()
    assert (tmp_path / "live-2.rrd").read_bytes() == b"mine"
    old, new = read(tmp_path / "live.rrd"), read(tmp_path / "live-3.rrd")
    for rows, count in ((old, 101), (new, 11)):
        assert [t for t, _ in scalars(rows, "/plots/drone/odometry/speed")] == [
            5 * MS * k for k in range(count)
        ]
        assert len(rows["/world/paths/drone"]) == 1
    assert [t for t, _ in old[f"{BODY}/rgb/image"]] == [450 * MS]
    assert [t for t, _ in new[f"{BODY}/rgb/image"]] == [50 * MS]
    assert "/world/scene/room/0" in new


def test_a_file_that_comes_up_meanwhile_is_kept(tmp_path, box, start):
    watcher = start(tmp_path / "live.rrd")
    watcher.wait_for("waiting for a simulator")
    (tmp_path / "live.rrd").write_bytes(b"mine")
    with FakeSimulator(box) as simulator:
        simulator.announce()
    watcher.end()
    assert (tmp_path / "live.rrd").read_bytes() == b"mine"
    assert watcher.said[-1] == f"wrote {tmp_path / 'live-2.rrd'}"


def test_only_what_is_shown_is_subscribed_to(tmp_path, box, start):
    watcher = start(tmp_path / "live.rrd", only=["dvs"])
    with FakeSimulator(box) as simulator:
        simulator.announce()
        assert simulator.sensors["dvs"].wait_for_subscribers(timeout_s=SOON_S)
        watcher.wait_for("showing drone: odometry, dvs (streaming)")
        assert [simulator.sensors[name].subscriber_count for name in ("rgb", "z", "imu")] == [0, 0, 0]
        watcher.end()


def test_an_unknown_sensor_is_an_error_once_the_known_are_known(tmp_path, box, start):
    watcher = start(tmp_path / "live.rrd", only=["imuu"])
    with FakeSimulator(box) as simulator:
        simulator.announce(wait=False)
        with pytest.raises(ValueError, match=r"unknown sensor 'imuu', known: odometry, dvs, rgb, z, imu"):
            watcher.result.result(SOON_S)
    assert not (tmp_path / "live.rrd").exists()


def test_simulators_come_and_go(tmp_path, box, start, monkeypatch):
    """Gone and back, with a scene whose file is not there: each in a file of its own."""
    monkeypatch.setattr(viewer_module, "OVER_S", 0.0)  # would end it at once
    watcher = start(tmp_path / "live.rrd", to_the_end=True)
    for count, (name, scene) in enumerate((("live", box), ("live-2", "nowhere.glb")), start=1):
        with FakeSimulator(scene) as simulator:
            simulator.announce()
            simulator.state(4)
            grows_to(
                tmp_path / f"{name}.rrd",
                lambda rows: "/status" in rows,
                meanwhile=lambda: simulator.status(20 * MS),  # one may go to those that listened to the last
            )
        wait_for(lambda: sum("is gone" in line for line in watcher.said) == count)  # noqa: B023
    assert not watcher.result.done()
    watcher.end()
    assert any("shown without the scene" in line and "nowhere.glb" in line for line in watcher.said)
    for name in ("live", "live-2"):
        speeds = scalars(read(tmp_path / f"{name}.rrd"), "/plots/drone/odometry/speed")
        assert {t for t, _ in speeds} == {20 * MS}


def test_a_file_is_closed_when_the_flight_is_over(tmp_path, box, start, monkeypatch):
    """With all that had come, though it was not yet sent."""
    monkeypatch.setattr(viewer_module, "SEND_S", 1e9)
    watcher = start(tmp_path / "live.rrd", to_the_end=True)
    with FakeSimulator(box, run_on=False) as simulator:
        simulator.announce()
        simulator.state(3)
        simulator.status(20 * MS, "ended")
        grows_to(tmp_path / "live.rrd", lambda rows: "/status" in rows)
        assert not watcher.result.done()
        simulator.state(4)
    assert watcher.result.result(SOON_S) == 0
    rows = read(tmp_path / "live.rrd")
    assert "it is over" in rows["/status"][0][1]["text"][0]
    assert [t for t, _ in scalars(rows, "/plots/drone/odometry/speed")] == [15 * MS, 20 * MS]
    assert watcher.said[-1] == f"wrote {tmp_path / 'live.rrd'}"


def test_a_publisher_of_another_type_is_named(tmp_path, box, start):
    watcher = start(tmp_path / "live.rrd")
    with FakeSimulator(box) as simulator, Node("other") as other:
        other.publisher("/drone/imu", msg.Clock)
        simulator.announce()
        watcher.wait_for("/drone/imu is of another type")
        simulator.state(1)
        grows_to(tmp_path / "live.rrd", lambda rows: "/plots/drone/imu/specific_force" in rows)
        watcher.end()


@contextlib.contextmanager
def viewer_process(file: Path) -> Iterator[subprocess.Popen[str]]:
    """`neurosim view --save`, once it waits for a simulator."""
    command = [sys.executable, "-m", "neurosim_core", "view", "--save", str(file)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stderr is not None
            line = process.stdout.readline()
            assert "waiting for a simulator" in line, process.stderr.read()
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_and_close_the_file(tmp_path, box, number):
    """As its own process; the file holds what came before."""
    file = tmp_path / "live.rrd"
    with viewer_process(file) as process, FakeSimulator(box) as simulator:
        simulator.announce()
        for k in range(100):
            simulator.state(k)
        simulator.status(500 * MS)
        grows_to(file, lambda rows: "/status" in rows)
        process.send_signal(number)
        out, errors = process.communicate(timeout=SOON_S)
        assert process.returncode == 130, errors
        assert "Traceback" not in errors
        assert out.endswith(f"wrote {file}\n")
    assert len(scalars(read(file), "/plots/drone/odometry/speed")) == 100


def test_waiting_is_interrupted(tmp_path):
    with viewer_process(tmp_path / "live.rrd") as process:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=SOON_S)
        assert process.returncode == 130, errors
        assert "Traceback" not in errors
    assert not (tmp_path / "live.rrd").exists()


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"web": True, "event_window_s": 0.0}, r"the event window must be 0.0001 to 10 s, got 0.0"),
        ({"web": True, "image_rate_hz": float("nan")}, "the image rate must be > 0"),
        ({"web": True, "port": 70_000}, "a port is 0 to 65535, got 70000"),
        ({"web": True, "only": [""]}, "sensors to show are names, such as events,imu, got ''"),
        ({"web": True, "only": ["", ""]}, "got ','"),
        ({"save": Path("q.txt")}, r"a file of Rerun ends in .rrd, got q.txt"),
        ({}, "no display to open a window on: `neurosim view --web`.*--save"),
    ],
)
def test_wrong_arguments_are_refused(options, reason, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ValueError, match=reason):
        view(**options)


def test_a_file_that_cannot_be_written_is_refused_at_once(tmp_path):
    with pytest.raises(OSError, match=r"cannot write .*: there is no folder .*nowhere"):
        view(save=tmp_path / "nowhere" / "f.rrd")
    with pytest.raises(OSError, match="it is a folder"):
        view(save=tmp_path)
    assert not (tmp_path / "nowhere").exists()
    (tmp_path / "x.rrd").write_bytes(b"mine")
    with pytest.raises(FileExistsError, match=r"x.rrd is there already: name another file"):
        view(save=tmp_path / "x.rrd")
    assert (tmp_path / "x.rrd").read_bytes() == b"mine"


def test_memory_stays(tmp_path, box, start):
    """Thousands of messages leave no more behind than the buffers of the first ones."""

    def resident_mb() -> float:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    file = tmp_path / "live.rrd"
    watcher = start(file, image_rate_hz=100.0)
    with FakeSimulator(box) as simulator:
        simulator.announce()
        simulator.wait_for_cameras()
        sizes_mb, written = [], 0
        for k in range(6000):
            simulator.state(k)
            if k % 2:
                simulator.sensors["dvs"].publish(make_events(k // 2, count=4000))
            if k % 10 == 0:
                simulator.image(k // 10)
                simulator.status(5 * MS * k)
            if k % 2000 == 1999:
                wait_for(lambda before=written: file.stat().st_size > before)
                written = file.stat().st_size
                sizes_mb.append(resident_mb())
    watcher.end()
    assert len(read(file)[f"{BODY}/dvs/image"]) > 10  # at most 100 a second of the wall clock
    assert sizes_mb[2] - sizes_mb[0] < 20.0  # the events of 2000 windows, 13 bytes each, would be 100 MB
