"""The runtime directory and the files of nodes."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from processes import SOON_S

from cortex.host import FileLock, NodeFiles, domain_id, host_id, node_lives, runtime_dir, sweep

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def short_path():
    """A directory whose path leaves room for sockets, which `tmp_path` may not."""
    folder = Path(tempfile.mkdtemp(prefix="ctx-", dir="/tmp"))
    yield folder
    shutil.rmtree(folder)


@pytest.fixture(autouse=True)
def base(short_path, monkeypatch):
    monkeypatch.setenv("CORTEX_RUNTIME_DIR", str(short_path / "run"))
    return short_path / "run"


@pytest.mark.parametrize(("text", "expected"), [(None, 0), ("0", 0), ("232", 232), ("007", 7)])
def test_domain_comes_from_the_environment(monkeypatch, text, expected):
    monkeypatch.delenv("CORTEX_DOMAIN", raising=False)
    monkeypatch.setenv("CORTEX_DOMAIN", text) if text is not None else None
    assert (domain_id(), domain_id(5)) == (expected, 5)


@pytest.mark.parametrize("text", ["", "-1", "233", "1.0", "x", "²"])
def test_a_wrong_domain_is_refused_by_name(monkeypatch, text):
    monkeypatch.setenv("CORTEX_DOMAIN", text)
    with pytest.raises(ValueError, match="CORTEX_DOMAIN must be an integer from 0 to 232"):
        domain_id()


def test_runtime_directory_is_private(base):
    old = os.umask(0)
    try:
        directory = runtime_dir(3)
    finally:
        os.umask(old)
    assert directory == base / "3"
    assert (base.stat().st_mode & 0o777, directory.stat().st_mode & 0o777) == (0o700, 0o700)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda base: (base / "0").chmod(0o750), "0750"),
        (
            lambda base: ((base / "0").rename(base / "other"), (base / "0").symlink_to(base / "other")),
            "a link",
        ),
        pytest.param(
            lambda base: os.chown(base, 12345, -1),
            "belongs to user 12345",
            marks=pytest.mark.skipif(os.getuid() != 0, reason="only root can give a directory away"),
        ),
    ],
)
def test_a_directory_that_is_not_ours_alone_is_refused(base, spoil, said):
    runtime_dir(0)
    spoil(base)
    with pytest.raises(PermissionError, match=said):
        runtime_dir(0)


def test_a_path_too_long_for_a_socket_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("CORTEX_RUNTIME_DIR", str(tmp_path / ("x" * 100)))
    with pytest.raises(ValueError, match="set CORTEX_RUNTIME_DIR to a shorter one"):
        runtime_dir(0)
    assert not (tmp_path / ("x" * 100)).exists()


def test_host_id_differs_where_sockets_cannot_be_shared(base, monkeypatch, short_path):
    runtime_dir(0)
    here = host_id()
    monkeypatch.setenv("CORTEX_RUNTIME_DIR", str(short_path / "other"))
    assert host_id() != here


def test_a_lock_has_one_holder_at_a_time(tmp_path):
    first = FileLock.acquire(tmp_path / "lock")
    assert first is not None
    assert FileLock.acquire(tmp_path / "lock") is None
    first.close()
    second = FileLock.acquire(tmp_path / "lock")
    assert second is not None
    second.close(remove=True)
    second.close()
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def fork():
    """Starts children that call a function and sit until they are killed."""
    context, children = multiprocessing.get_context("fork"), []

    def start(action, *arguments):
        ready = context.Event()
        children.append(context.Process(target=lambda: (action(*arguments), ready.set(), signal.pause())))
        children[-1].start()
        assert ready.wait(SOON_S)
        return children[-1]

    yield start
    for child in children:
        child.kill()
        child.join()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # threads of other libraries
def test_a_forked_child_neither_keeps_nor_removes_what_is_its_parents(fork):
    """It may outlive us, and must not make us look alive."""
    files = NodeFiles(0, 8)
    files.path("lossy").touch()
    fork(files.close)
    fork(lambda: None)
    assert files.path("lossy").exists()
    assert sweep(files.directory) == []  # and it lives still
    files.close()
    NodeFiles(0, 8).close()


def test_a_node_has_its_number_alone_lives_and_leaves_nothing_behind():
    (runtime_dir(0) / f"{9:016x}.lossy").touch()
    files = NodeFiles(0, 0xABC)  # sweeps what it finds
    files.path("lossy").touch()
    assert files.endpoint("lossy") == f"ipc://{files.directory}/0000000000000abc.lossy"
    for role in ("", "Lossy", "a.b", "../x", "lock", "x" * 13):
        with pytest.raises(ValueError, match="role must be"):
            files.path(role)
    with pytest.raises(FileExistsError, match="0000000000000abc"):
        NodeFiles(0, 0xABC)
    assert node_lives(files.directory, 0xABC)
    assert not node_lives(files.directory, 7)
    files.close()
    files.close()
    assert not node_lives(files.directory, 0xABC)
    (files.directory / f"{6:016x}.lock").touch()  # what a killed one leaves
    assert not node_lives(files.directory, 6)
    assert list(files.directory.iterdir()) == []


def hold(number: int) -> None:
    """Be a node."""
    files = NodeFiles(0, number)
    for role in ("lossy", "strict", "control"):
        files.path(role).touch()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # threads of other libraries
def test_sweep_removes_the_files_of_killed_nodes_only(fork):
    living = NodeFiles(0, 1)
    living.path("lossy").touch()
    killed, stopped = fork(hold, 2), fork(hold, 3)
    (living.directory / "notes.txt").touch()
    (living.directory / f"{4:016x}.lossy").touch()  # the lock of its node was lost
    os.kill(stopped.pid, signal.SIGSTOP)
    killed.kill()
    killed.join()
    assert sorted(sweep(living.directory)) == [2, 4]
    roles = {1: ("lock", "lossy"), 3: ("lock", "lossy", "strict", "control")}
    left = {f"{number:016x}.{role}" for number in roles for role in roles[number]}
    assert {path.name for path in living.directory.iterdir()} == {"notes.txt", *left}
    living.close()


OTHER_SYSTEM = """
import builtins, io, os, pathlib, sys

def refuse(path):
    if str(path).startswith("/proc"):
        raise FileNotFoundError(2, "No such file or directory", str(path))

def without_proc(function):
    return lambda path, *arguments, **options: (refuse(path), function(path, *arguments, **options))[1]

builtins.open = io.open = without_proc(open)
pathlib.Path.read_text = without_proc(pathlib.Path.read_text)
os.readlink = without_proc(os.readlink)
for name in ("memfd_create", "eventfd", "pidfd_open"):
    if hasattr(os, name):
        delattr(os, name)
sys.platform = "darwin"
"""


def test_a_system_without_proc_and_memfd(base, tmp_path):
    """As macOS is, in every process: all goes through sockets, in Python, and `cortex doctor` says so."""
    (tmp_path / "sitecustomize.py").write_text(OTHER_SYSTEM)
    environment = {
        **os.environ,
        "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}",
        "CORTEX_PURE_PYTHON": "1",
        "XDG_CONFIG_HOME": str(tmp_path),
    }
    command = [sys.executable, "-m", "cortex", "doctor"]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=SOON_S, check=False
    )
    assert (done.stdout.count("WRONG"), done.stderr) == (1, "")  # the C module, which this Linux would have
    assert "darwin has no memfd" in done.stdout
    assert done.stdout.splitlines()[-1] == "ok     two processes: they talk by ipc"
