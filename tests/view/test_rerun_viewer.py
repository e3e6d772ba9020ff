"""The viewer's process: who can reach it, and when it ends."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.parse
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from processes import SOON_S, children_of, gone, wait_for
from rerun_file import read, scalars

from neurosim_core.view import rerun_viewer
from neurosim_core.view.rerun_viewer import RerunViewer, ViewerEnded


def listening(pid: int) -> set[tuple[str, int]]:
    """Addresses and ports on which a process listens."""
    sockets = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # it closes files while they are listed
            sockets.update(re.findall(r"socket:\[(\d+)\]", os.readlink(entry)))
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in sockets:
                address, port = fields[1].split(":")
                raw = bytes.fromhex(address)
                found.add((socket.inet_ntoa(raw[::-1]) if len(raw) == 4 else address, int(port, 16)))
    return found


def test_it_listens_on_this_machine_only():
    before = children_of(os.getpid())
    with RerunViewer(web=True) as viewer:
        (pid,) = children_of(os.getpid()) - before
        recording = viewer.open("flight 1").recording
        recording.log("text", rr.TextDocument("hello"))
        recording.flush(timeout_sec=SOON_S)
        ports = {int(port) for port in re.findall(r"127\.0\.0\.1:(\d+)", viewer.page_url)}
        assert len(ports) == 2
        assert listening(pid) == {("127.0.0.1", port) for port in ports}
        assert viewer.page_url.endswith(f"/?url=rerun%2B{viewer.data_url.removeprefix('rerun+')}")
        with urllib.request.urlopen(viewer.page_url, timeout=SOON_S) as page:
            assert b"wasm" in page.read()
        recording.disconnect()
        assert not viewer.ended
    assert viewer.ended


def test_a_served_file_is_all_there_and_costs_nothing_more(tmp_path):
    """What another client is given; a server that reads the file itself used a core for as long as it ran."""
    shown, saved = tmp_path / "shown.rrd", tmp_path / "saved.rrd"
    logged = rr.RecordingStream("neurosim")
    logged.save(shown)
    for k in range(100):
        logged.set_time("sim_time", duration=np.timedelta64(10 * k, "ms"))
        logged.log("speed", rr.Scalars(k))
    logged.disconnect()
    code = "import sys; from pathlib import Path; from neurosim_core.view.rerun_viewer import show_file\n"
    code += "show_file(Path(sys.argv[1]), web=True, open_browser=False)"
    command = [sys.executable, "-c", code, shown]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as viewer:
        assert viewer.stdout is not None
        page = urllib.parse.urlsplit(viewer.stdout.readline().removeprefix("open "))
        (url,) = urllib.parse.parse_qs(page.query)["url"]
        (pid,) = children_of(viewer.pid)

        def used_ticks() -> int:
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            return int(fields[11]) + int(fields[12])

        def idle() -> bool:
            before = used_ticks()
            time.sleep(0.5)
            return used_ticks() - before <= 1

        try:
            wait_for(idle)
            copy = [rerun_viewer._executable(), url.strip(), "--bind", "127.0.0.1", "--save", saved]
            with subprocess.Popen(copy, env={**os.environ, "RERUN_APP_ONLY": "true"}) as client:
                wait_for(lambda: saved.exists() and idle())
                viewer.terminate()
                assert client.wait(SOON_S) == 0
        finally:
            viewer.terminate()
    assert scalars(read(saved), "/speed") == [(k * 10_000_000, [k]) for k in range(100)]


def test_a_signal_ends_it_while_its_server_takes_nothing(monkeypatch, tmp_path):
    """The stand-in listens, and reads nothing: Rerun would wait for it, whatever signals come."""
    silent, shown = tmp_path / "rerun", tmp_path / "shown.rrd"
    silent.write_text(
        f"#!{sys.executable}\n"
        "import signal, socket, sys\n"
        "ports = (int(sys.argv[sys.argv.index(o) + 1]) for o in ('--port', '--web-viewer-port'))\n"
        "servers = [socket.create_server(('127.0.0.1', port)) for port in ports]\n"
        "signal.pause()\n"
    )
    silent.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(silent))
    logged = rr.RecordingStream("neurosim")
    logged.save(shown)
    logged.log("text", rr.TextDocument("hello"))
    logged.disconnect()
    code = "import sys; from pathlib import Path; from neurosim_core.view.rerun_viewer import show_file\n"
    code += "sys.exit(show_file(Path(sys.argv[1]), web=True, open_browser=False))"
    with subprocess.Popen([sys.executable, "-c", code, shown], stdout=subprocess.PIPE, text=True) as viewer:
        try:
            assert viewer.stdout is not None
            assert viewer.stdout.readline().startswith("open ")
            time.sleep(0.5)  # Rerun has begun to wait
            viewer.terminate()
            assert viewer.wait(5.0) == 130  # it took 10 s
        finally:
            viewer.kill()


def test_ports_differ():
    """A port that was free a moment ago is often the next one that is handed out."""
    for _ in range(50):
        assert len(set(rerun_viewer._free_ports(0, 0, 0))) == 3


def test_a_port_is_kept_to():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=f"port {port} cannot be used"):
            RerunViewer(web=True, port=port)
    with RerunViewer(web=True, port=port) as viewer:
        assert viewer.page_url.startswith(f"http://127.0.0.1:{port}/")


def test_it_ends_with_a_parent_that_is_killed():
    code = (
        "from neurosim_core.view.rerun_viewer import RerunViewer\n"
        "viewer = RerunViewer(web=True)\n"
        "print('begun', flush=True)\n"
        "input()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "begun\n"
        (pid,) = children_of(parent.pid)
        assert listening(pid)
        parent.kill()
    wait_for(lambda: gone(pid))


def test_a_viewer_that_fails_says_why(monkeypatch, tmp_path):
    """Stand-ins: one ends at once, one later; the second as a window that somebody closes, and as a crash."""
    viewer = tmp_path / "rerun"
    monkeypatch.setenv("RERUN_CLI_PATH", str(viewer))
    viewer.write_text("#!/bin/sh\necho no such display >&2\nexit 3\n")
    viewer.chmod(0o755)
    with pytest.raises(ViewerEnded, match=r"(?s)ended at once, with status 3:.*no such display"):
        RerunViewer(web=False)
    viewer.write_text(
        f"#!{sys.executable}\n"
        "import os, signal, socket, sys\n"
        "port = int(sys.argv[sys.argv.index('--port') + 1])\n"
        "signal.signal(signal.SIGUSR1, lambda *_: os._exit(0))\n"
        "signal.signal(signal.SIGUSR2, lambda *_: (os.write(2, b'graphics are broken'), os._exit(1)))\n"
        "server = socket.create_server(('127.0.0.1', port))\n"
        "while True: server.accept()\n"
    )
    before = children_of(os.getpid())
    with RerunViewer(web=False) as window:
        os.kill(*(children_of(os.getpid()) - before), signal.SIGUSR1)
        wait_for(lambda: window.ended)
        window.check()
    with RerunViewer(web=False) as window:
        os.kill(*(children_of(os.getpid()) - before), signal.SIGUSR2)
        wait_for(lambda: window.ended)
        with pytest.raises(ViewerEnded, match=r"(?s)status 1:.*graphics are broken"):
            window.check()
