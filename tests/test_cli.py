"""The command line: what it leaves, what it says, and how it fails."""

from __future__ import annotations

import os
import re
import resource
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image

import neurosim_core.live.serve
from neurosim_core import cli
from neurosim_core.config import load_config
from neurosim_core.flight import new_folder
from neurosim_core.packets import Events
from neurosim_core.record import Recording
from neurosim_core.scene.hall import HallConfig

ROOT = Path(__file__).resolve().parents[1]
LENS = {"width": 48, "height": 36, "horizontal_fov_rad": 1.5}
SETTINGS = {
    "duration_s": 0.3,
    "scene": {"kind": "apartment", "rooms": 1},
    "render": {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1},
    "sensors": {
        "events": {"kind": "event_camera", "lens": LENS},
        "rgb": {"kind": "rgb", "lens": LENS},
        "depth": {"kind": "depth", "lens": LENS},
        "imu": {"kind": "imu"},
        "odometry": {"kind": "odometry"},
    },
}


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("flown")
    (folder / "scene.yaml").write_text(yaml.safe_dump(SETTINGS))
    arguments = ("run", "scene.yaml", "--out", "flight", "--seed", "3", "--device", "cpu")
    done = subprocess.run(
        [sys.executable, "-m", "neurosim_core", *arguments],
        capture_output=True,
        text=True,
        cwd=folder,
        env=dict(os.environ),  # without the COLUMNS that GNU readline has put where Python does not see it
        timeout=900,
    )
    assert done.returncode == 0, done.stderr
    return folder / "flight", done.stdout


def test_run_leaves_a_flight_that_can_be_read_back(flown):
    folder, _ = flown
    assert {p.name for p in folder.iterdir()} == {"config.yaml", "flight.h5", "flight.rrd", "overview.png"}
    config = load_config(folder / "config.yaml")
    assert (config.duration_s, config.seed) == (0.3, 3)
    with Recording(folder / "flight.h5") as flight:
        packets = list(flight.packets())
    assert {p.sensor for p in packets} == set(SETTINGS["sensors"])
    assert sum(p.sensor == "rgb" for p in packets) == 7
    assert packets[-1].stamp_ns == 300_000_000
    assert load_config(yaml.safe_load(flight.header.config_yaml)) == config


def test_the_report_says_what_was_flown(flown):
    folder, said = flown
    with Recording(folder / "flight.h5") as flight:
        events = sum(len(p) for p in flight.packets() if isinstance(p, Events))
    for part in (
        "real-time factor",
        "collisions",
        "none",
        "of the dynamics (rkmk4, at most 1 ms), ",
        "pixels of ",
        "thresholds 0.2 on, 0.2 off, ideal",
        "set-up: kernels, first packet",
        "compiled dynamics",
        "motor_lag",
        "time went to",
        f"{events:,}",
        "packets",
        "rgb 7",
    ):
        assert part in said
    spent = {
        row[1]: float(row[2])
        for row in re.finditer(r"(?m)^(\S.*?) +(\d+\.\d\d) +\d+ %", said.split("time went to")[1])
    }
    assert {"set-up: libraries, settings", "recording and drawing", "files completed"} <= spent.keys()
    assert spent.pop("all") == pytest.approx(
        sum(spent.values()), abs=0.005 * (len(spent) + 5)
    )  # rounded rows


def test_the_overview_is_a_picture(flown):
    folder, _ = flown
    picture = np.asarray(Image.open(folder / "overview.png").convert("RGB"))
    assert picture.shape == (900, 1600, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 1000


def test_a_recording_gives_back_what_the_run_yields(flown):
    """The file holds the packets of the same run in this process, byte for byte."""
    import neurosim_core as ns

    folder, _ = flown
    with Recording(folder / "flight.h5") as flight:
        for read, made in zip(flight.packets(), ns.run(folder / "config.yaml"), strict=True):
            assert type(read) is type(made)
            for name, value in vars(made).items():
                np.testing.assert_array_equal(getattr(read, name), value, err_msg=name)


def test_a_rerun_file_can_be_made_from_the_recording(flown, tmp_path):
    folder, _ = flown
    assert cli.main(["view", str(folder), "--save", str(tmp_path / "again.rrd")]) == 0
    assert (tmp_path / "again.rrd").stat().st_size > 100_000


def test_an_animation_can_be_made_from_the_recording(flown, tmp_path):
    """Four pictures in 0.3 s at 10 Hz, the plan beside the pictures; the path grows."""
    folder, _ = flown
    assert cli.main(["view", str(folder), "--save", str(tmp_path / "film.webp")]) == 0
    with Image.open(tmp_path / "film.webp") as film:
        assert (film.n_frames, film.height) == (4, 220)
        frames = []
        for index in (0, 3):
            film.seek(index)
            frames.append(np.asarray(film.convert("RGB")).astype(int))
    assert (np.abs(frames[1] - frames[0]).max(axis=2) > 60).sum() > 200


@pytest.mark.parametrize("name", ["converted.h5", "events.raw"])
def test_an_animation_of_events_alone_is_refused_and_says_what_can_be_made(flown, tmp_path, capsys, name):
    file = tmp_path / name
    assert cli.main(["convert", str(flown[0] / "flight.h5"), str(tmp_path / "events.raw")]) == 0
    if name != "events.raw":
        assert cli.main(["convert", str(tmp_path / "events.raw"), str(file)]) == 0
    assert cli.main(["view", str(file), "--save", str(tmp_path / "film.webp")]) == 1
    told = capsys.readouterr().err
    assert f"an animation needs pictures in colour, and {file} has none" in told
    assert f"save a file for Rerun, as {tmp_path / 'film.rrd'}" in told
    assert cli.main(["view", str(tmp_path / "nosuch"), "--save", str(tmp_path / "film.webp")]) == 1
    assert f"`neurosim run --out {tmp_path / 'nosuch'}` makes one" in capsys.readouterr().err


def test_an_animation_of_a_converted_flight_has_no_plan(flown, tmp_path):
    """Pictures and poses that come from a file of another format are without their scene."""
    pytest.importorskip("rosbags")
    assert cli.main(["convert", str(flown[0] / "flight.h5"), str(tmp_path / "flight.mcap")]) == 0
    assert cli.main(["view", str(tmp_path / "flight.mcap"), "--save", str(tmp_path / "film.webp")]) == 0
    with Image.open(tmp_path / "film.webp") as film:
        assert film.size == (2 * round(220 * 48 / 36) + 6, 220)  # the picture and the events


def test_view_serves_a_file_on_its_port_and_ends_with_its_viewer(flown):
    """Killed by SIGTERM it takes the viewer along: nobody listens on the port any more."""
    folder, _ = flown
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "neurosim_core", "view", str(folder), "--web", "--no-browser"]
    with subprocess.Popen([*command, "--port", str(port)], stdout=subprocess.PIPE, text=True) as view:
        assert view.stdout is not None
        assert view.stdout.readline().startswith(f"open http://127.0.0.1:{port}/?url=")
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=30.0) as page:
            assert b"wasm" in page.read()
        view.terminate()
        assert view.wait(30.0) == 130
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0


def test_view_without_a_display_says_what_to_do(flown, monkeypatch, capfd):
    folder, _ = flown
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, "")
    assert cli.main(["view", str(folder)]) == 1
    assert "there is no display to open a window on: `neurosim view FILE --web`" in capfd.readouterr().err


@pytest.mark.parametrize("name", ["film.gif", "film.webp", "again.rrd"])
def test_a_full_disk_is_told_with_the_name_of_what_is_saved(flown, tmp_path, capsys, name):
    """A limit on the size of files acts like a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5_000, before[1]))
    try:
        status = cli.main(["view", str(flown[0]), "--save", str(tmp_path / name)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert status == 1
    assert f"cannot write {tmp_path / name}: File too large" in capsys.readouterr().err
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize(
    "command", ["scene {room} --out {out}", "compare {flight} --out {out}", "dataset --flights 1 --out {out}"]
)
def test_what_cannot_be_written_is_named(flown, tmp_path, capsys, command):
    """As a path that goes through a file."""
    (tmp_path / "file").touch()
    out = tmp_path / "file" / "out.png"
    room = tmp_path / "room.glb"
    trimesh.creation.box(extents=(4, 4, 3)).export(room)
    arguments = command.format(room=room, flight=flown[0] / "flight.h5", out=out).split()
    assert cli.main(arguments) == 1
    assert f"neurosim: cannot write {out}: " in capsys.readouterr().err


def test_a_full_disk_keeps_what_was_flown(tmp_path):
    """A limit on the size of files acts like a full disk: flight.rrd is given up, then the flight ends."""
    lens = {**LENS, "width": 192, "height": 144}
    sensors = {**SETTINGS["sensors"], "rgb": {"kind": "rgb", "lens": lens, "rate_hz": 200.0}}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({**SETTINGS, "sensors": sensors}))
    code = """
import resource, signal
from neurosim_core.cli import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, 1_500_000))
raise SystemExit(main(["run", "scene.yaml", "--out", "flight", "--device", "cpu"]))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=900
    )
    assert done.returncode == 1
    assert "real-time factor" in done.stdout  # the report
    kept = re.search(r"neurosim: .*File too large; flight.h5 is kept up to ([\d.]+) s\n", done.stderr)
    assert kept, done.stderr
    with Recording(tmp_path / "flight" / "flight.h5") as recording:
        packets = list(recording.packets())
    assert packets[-1].stamp_ns == round(float(kept[1]) * 1e9) > 0
    if not (tmp_path / "flight" / "flight.rrd").exists():
        assert "flight.rrd is given up" in done.stdout


def test_a_nearly_full_disk_is_left_to_the_recording(tmp_path, monkeypatch, capsys):
    """Before the first packet is written, not when both files have filled it."""
    sizes = []

    def little(folder):
        sizes.append((folder / "flight.h5").stat().st_size)
        return SimpleNamespace(free=1_000_000)

    monkeypatch.setattr("shutil.disk_usage", little)
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(SETTINGS))
    flight = tmp_path / "flight"
    assert cli.main(["run", str(tmp_path / "scene.yaml"), "--out", str(flight), "--device", "cpu"]) == 0
    assert "flight.rrd is given up: less than 32 MB are left" in capsys.readouterr().out
    assert not (flight / "flight.rrd").exists()
    with Recording(flight / "flight.h5") as recording:
        assert len(list(recording.packets("rgb"))) > 1
    assert len(sizes) == 1
    assert sizes[0] < 0.5 * (flight / "flight.h5").stat().st_size


def test_a_folder_that_cannot_be_written_is_said_before_anything_is_prepared(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert cli.main(["run", "--out", str(tmp_path / "file" / "flight")]) == 1
    said, errors = capsys.readouterr()
    assert "preparing" not in said
    assert f"cannot write to {tmp_path / 'file' / 'flight'}: Not a directory" in errors


def test_a_run_without_sensors_is_a_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "--duration", "0.1", "--set", "sensors={}", "--set", "scene.rooms=1"]) == 0
    assert "0.000 s" not in capsys.readouterr().out


def test_a_flight_without_odometry_shows_the_planned_path(tmp_path, monkeypatch):
    file = tmp_path / "scene.yaml"
    file.write_text(yaml.safe_dump({**SETTINGS, "sensors": {"rgb": SETTINGS["sensors"]["rgb"]}}))
    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "scene.yaml", "--out", "flight"]) == 0
    plan = np.asarray(Image.open(tmp_path / "flight" / "overview.png").convert("RGB"))[:, 1000:]
    assert ((plan == (0x2B, 0x8A, 0x3E)).all(axis=-1)).sum() > 5  # the mark and name of the start


def test_a_flight_is_not_overwritten_unasked(flown, capsys):
    folder, _ = flown
    assert cli.main(["run", "--out", str(folder)]) == 1
    assert "--overwrite" in capsys.readouterr().err


def test_an_interrupted_run_is_kept_whole(tmp_path):
    """Ctrl-C ends the flight between two packets: the file is closed, the picture drawn, the status tells."""
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({**SETTINGS, "duration_s": 60.0}))
    command = [sys.executable, "-m", "neurosim_core", "run", "scene.yaml", "--out", "cut", "--no-rrd"]
    run = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    file = tmp_path / "cut" / "flight.h5"
    deadline = time.monotonic() + 120
    while not (file.exists() and file.stat().st_size > 1_000_000):
        assert run.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    run.send_signal(signal.SIGINT)
    said, errors = run.communicate(timeout=300.0)
    assert run.returncode == 130, errors
    assert "interrupted" in said
    assert (tmp_path / "cut" / "overview.png").exists()
    with Recording(file) as flight:
        assert flight.clean
        assert flight.packet_count("imu") > 10


def test_a_signal_ends_a_command_that_cannot_say_so():
    program = (
        "import os, signal\n"
        "from neurosim_core.signals import handle_signals, leave_at_once\n"
        "os.close(2)\n"
        "with handle_signals(leave_at_once):\n"
        "    signal.raise_signal(signal.SIGINT)\n"
    )
    assert subprocess.run([sys.executable, "-c", program], timeout=60.0).returncode == 130


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (
            "convert in.csv out.raw --set pixel.threshold_on=0.3 --seed 0",
            "--seed, --set: for a video, and this",
        ),
        ("convert in.mp4 out.h5 --from-zero --to evt3", "--to, --from-zero: for a file of events, and this"),
        ("view flight --save film.mp4", "--save writes a flight as .rrd, .webp or .gif, got film.mp4"),
        ("view --save film.webp", "--save writes a live run as .rrd, got film.webp"),
        ("serve --lockstep --factor 2", "--factor is for streaming"),
    ],
)
def test_options_without_effect_are_refused(tmp_path, monkeypatch, capsys, command, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in.csv").write_text("t,x,y,p\n1,2,3,1\n")
    assert cli.main(command.split()) == 1
    assert said in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["in.csv"]


def test_a_size_that_a_file_does_not_say_is_said(tmp_path, capsys):
    (tmp_path / "in.csv").write_text("t,x,y,p\n1,2,3,1\n")
    assert cli.main(["convert", str(tmp_path / "in.csv"), str(tmp_path / "out.raw")]) == 0
    assert "the size of the sensor is not in the file: 3x4 is" in " ".join(capsys.readouterr().out.split())


def test_an_interrupted_conversion_leaves_nothing(tmp_path):
    count, draft = 5_000_000, tmp_path / ".out.csv.part"
    zeros = np.zeros(count, np.uint8)
    np.savez(tmp_path / "in.npz", t=np.arange(count), x=zeros, y=zeros, p=zeros)
    command = [sys.executable, "-m", "neurosim_core", "convert", "in.npz", "out.csv", "--size", "4x4"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as conversion:
        while not draft.exists():
            assert conversion.poll() is None
            time.sleep(0.01)
        conversion.send_signal(signal.SIGINT)
        assert conversion.communicate(timeout=60.0)[1] == "neurosim: interrupted\n"
    assert conversion.returncode == 130
    assert [file.name for file in tmp_path.iterdir()] == ["in.npz"]


def test_folders_are_numbered_when_none_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for expected in ("flight", "flight-2", "flight-3"):
        folder = new_folder(None)
        assert folder == Path(expected)
        folder.mkdir()


@pytest.mark.parametrize(
    ("command", "live"),
    [
        (["run"], {}),
        (["serve", "--lockstep"], {"mode": "lockstep", "run_on": False}),
        (["up"], {"run_on": False}),
    ],
)
def test_printed_settings_are_settings(tmp_path, capsys, command, live):
    assert cli.main([*command, "--print-config", "--set", "scene.seed=3", "--duration", "2"]) == 0
    said = capsys.readouterr().out
    file = tmp_path / "scene.yaml"
    file.write_text(said)
    assert load_config(file) == load_config({"scene": {"seed": 3}, "duration_s": 2.0, "live": live})
    assert sum(line.lstrip().startswith("#") for line in said.splitlines()) > 50


def test_serve_has_its_scene_read_by_another_process(monkeypatch):
    def serve(config, *, reader, **_):
        assert len(reader.scene(config.scene).faces) > 12
        return 7

    monkeypatch.setattr(neurosim_core.live.serve, "serve", serve)
    monkeypatch.setattr(HallConfig, "load", None)
    assert cli.main(["serve", "--set", "scene.kind=hall", "--set", "scene.seed=3"]) == 7


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run", "nothing.yaml"], "nothing.yaml"),
        (["run", "--set", "links.imu.latency_s=8"], "got 8; if these are milliseconds, write 0.008"),
        (["run", "--set", "scene.romms=3"], "did you mean 'rooms'"),
        (["run", "--set", "duration_s"], "KEY=VALUE"),
        (["run", "--device", "cuda:77"], "cuda:77"),
        (["run", "--duration", "-1"], "--duration: Input should be greater than 0, got -1.0"),
        (["serve", "--factor", "-1"], "--factor: Input should be greater than or equal to 0, got -1.0"),
        (["serve", "--set", "live.mode=fast"], "--set live.mode: Input should be 'lockstep' or 'streaming'"),
        (["bench", "streaming", "--device", "gpu", "--sampling-rate", "5"], "--device: must be auto, cpu"),
        (["run", "--set", "scene={kind: mesh, file: nothing.glb}"], "nothing.glb"),
        (["scene", "nothing.glb"], "nothing.glb"),
        (["view", "nowhere"], "no flight at"),
        (["run", sys.executable], "kind: mesh"),
        (["run", "--out", sys.executable], "--out must name a folder"),
    ],
)
def test_what_goes_wrong_is_said_in_one_line(arguments, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == 1
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "threads"), [(["learn", "eval", "absent"], None), (["view", "absent.h5"], "1")]
)
def test_only_learning_has_many_threads_of_blas(command, threads, monkeypatch, capsys):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "restored afterwards")
    del os.environ["OPENBLAS_NUM_THREADS"]
    assert cli.main(command) == 1
    assert os.environ.get("OPENBLAS_NUM_THREADS") == threads
    capsys.readouterr()


def test_debug_shows_where_an_error_arose(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"nothing\.yaml") as error:
        cli.main(["--debug", "run", "nothing.yaml"])
    assert error.traceback[-1].path.name == "settings_file.py"


@pytest.mark.parametrize("command", ["run", "serve", "fly", "up"])
def test_errors_in_a_file_are_said_of_the_file(command, tmp_path, capsys):
    """Nobody has typed an option: the file and its keys are named, and what is typed beside it as it is."""
    file = tmp_path / "scene.yaml"
    file.write_text("{duration_s: -5, seed: -1, device: gpu, live: {real_time_factor: -1}}")
    assert cli.main([command, str(file)]) == 1
    head, *lines = capsys.readouterr().err.splitlines()
    assert head == f"neurosim: {file} is not a valid configuration:"
    keys = {"  duration_s", "  seed", "  device", "  live.real_time_factor"}
    assert {line.split(":")[0] for line in lines} == keys
    assert cli.main([command, str(file), "--set", "device=amd", "--seed", "-2"]) == 1
    head, *lines = capsys.readouterr().err.splitlines()
    assert head == f"neurosim: {file} is not a valid configuration:"
    keys = {"  duration_s", "  --seed", "  --set device", "  live.real_time_factor"}
    assert {line.split(":")[0] for line in lines} == keys


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["device=gpu"], "--set device: must be auto, cpu, cuda"),
        (["duration_s=-5"], "--set duration_s: Input should be greater than 0, got -5"),
        (["sensors.evnts.rate_hz=3"], "--set sensors.evnts.rate_hz: sensors.evnts.kind: required"),
        (["seed=3", "cat.dog=3"], "--set cat.dog: cat: unknown key"),
        (["scene.kind=mesh"], "--set scene.kind: scene.file: required"),
        (["scene.seed=[3"], "--set scene.seed: the value '[3' is not YAML"),
    ],
)
def test_errors_of_set_are_said_of_it(settings, said, capsys):
    options = [part for text in settings for part in ("--set", text)]
    assert cli.main(["run", *options]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"neurosim: {said}")


def test_a_scene_is_given_by_its_file(tmp_path, capsys):
    """It replaces the scene of the settings file; its own settings may follow."""
    file = tmp_path / "settings.yaml"
    file.write_text("scene: {kind: apartment, rooms: 2}")
    room = tmp_path / "room.glb"
    trimesh.creation.box((4.0, 4.0, 3.0)).export(room)
    scene = ["--scene", str(room)]
    assert cli.main(["run", str(file), *scene, "--set", "scene.unit_m=2.0", "--print-config"]) == 0
    chosen = yaml.safe_load(capsys.readouterr().out)["scene"]
    assert (chosen["kind"], chosen["file"], chosen["unit_m"]) == ("mesh", str(room), 2.0)
    assert cli.main(["run", str(file), "--scene", "none.glb"]) == 1
    assert "none.glb: no such file" in capsys.readouterr().err


def test_options_are_not_abbreviated(capsys):
    with pytest.raises(SystemExit, match="2"):
        cli.main(["run", "--ou", "x"])
    assert "unrecognized arguments: --ou" in capsys.readouterr().err


def test_sensors_that_are_absent_are_said_first(tmp_path, monkeypatch, capsys):
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({**SETTINGS, "sensors": {"imu": {"kind": "imu"}}}))
    monkeypatch.chdir(tmp_path)
    status = cli.main(["run", "scene.yaml", "--duration", "0.05", "--no-rrd"])
    said, errors = capsys.readouterr()
    assert status == 0, errors
    first = said.partition(" flies ")[0]
    assert "apartment with 1 room, seed" in first
    assert "Absent of the default sensors: events, rgb, depth, odometry." in first
    assert max(map(len, first.splitlines())) > 80  # lines are not broken for a pipe as for a narrow terminal


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("neurosim", "argparse"),
        ("neurosim", "yaml"),
        ("neurosim", "neurosim_core.cli"),
        ("cortex", "cortex.cli"),
        ("cortex-ros2-bridge", "cortex_ros2_bridge.cli"),
    ],
)
def test_ctrl_c_while_a_command_is_imported_ends_it_quietly(name, module):
    """From the first line of the module that the command is in."""
    tomllib = pytest.importorskip("tomllib")
    home = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["scripts"][name]
    program = f"""
import signal, sys
class Interrupts:
    def find_spec(self, name, *_):
        if name == {module!r}:
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupts())
sys.modules.pop({module!r}, None)
from {home.partition(":")[0]} import main
sys.exit(main())
"""
    done = subprocess.run([sys.executable, "-c", program, "--help"], capture_output=True, timeout=60.0)
    assert (done.returncode, done.stdout, done.stderr) == (130, b"", b"")
