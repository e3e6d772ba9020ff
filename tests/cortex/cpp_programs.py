"""The test programs and examples of the C++ client, built once for the same sources, and what starts them."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cpp_client import Peer
from cpp_messages import Picture, Rich, Scan
from wire_vectors import load_vectors

from cortex.cppgen import generate
from cortex.registry import ensure_registry
from cortex.schema import Schema

CPP = Path(__file__).parents[2] / "cortex" / "cpp"
PATIENCE_S = 900.0
"""After this a program that takes seconds hangs, also on a machine that does a lot besides."""

_KEPT = 4
"""Builds that are kept, the newest."""


def _missing() -> str:
    for tool in ("cmake", "g++"):
        if shutil.which(tool) is None:
            return f"no {tool}"
    for header in ("zmq.h", "zmq.hpp"):
        if not any((Path(root) / header).exists() for root in ("/usr/include", "/usr/local/include")):
            return f"no {header}: apt install libzmq3-dev cppzmq-dev"
    return ""


needs_compiler = pytest.mark.skipif(
    bool(_missing()), reason=f"the C++ client cannot be built here: {_missing()}"
)


def short(schema: Schema) -> str:
    """The name of a type without its namespaces."""
    return schema.name.rpartition("/")[2]


def _headers() -> dict[str, str]:
    """The headers of the test programs."""
    schemas = [Schema.from_json(vector["schema"]) for vector in load_vectors().values()]
    table = " ".join(f"X({short(schema)})" for schema in schemas)
    return {
        "vectors.hpp": f"{generate(schemas)}\n#define CORTEX_TYPES(X) {table}\n",
        "peer_messages.hpp": generate([Rich, Picture, Scan]),
    }


def _build(build: Path) -> None:
    """Build everything with all warnings as errors."""
    shutil.rmtree(build, ignore_errors=True)
    headers = build / "headers"
    headers.mkdir(parents=True)
    for name, text in _headers().items():
        (headers / name).write_text(text)
    for command in (
        [
            *("cmake", "-S", CPP, "-B", build, "-DCORTEX_EXAMPLES=ON"),
            *(f"-DCORTEX_TEST_HEADERS={headers}", f"-DPython3_EXECUTABLE={sys.executable}"),
        ],
        ["cmake", "--build", build, "-j2"],
        ["cmake", "--install", build, "--prefix", build / "installed"],
    ):
        done = subprocess.run(command, capture_output=True, text=True, timeout=2.0 * PATIENCE_S, check=False)
        assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    (build / "built").touch()


def _fingerprint() -> str:
    """What a build comes of: the compiler, the C++ sources, and what writes headers."""
    version = subprocess.run(["g++", "--version"], capture_output=True, check=True).stdout
    digest = hashlib.sha256(version + "".join(_headers().values()).encode())
    package = CPP.parent
    sources = [*CPP.rglob("*"), package / "cppgen.py", *(package / "messages").glob("*.py"), Path(__file__)]
    for path in sorted(path for path in sources if path.is_file()):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


@pytest.fixture(scope="session")
def programs():
    """The directory of the programs: as Warp's kernels, they are kept for later sessions."""
    folder = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "neurosim" / "cpp_tests"
    folder.mkdir(parents=True, exist_ok=True)
    build = folder / _fingerprint()
    with open(folder / "lock", "w", encoding="ascii") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (build / "built").exists():
            _build(build)
        others = sorted(folder.glob("*/built"), key=lambda path: path.stat().st_mtime)
        for old in others[:-_KEPT]:
            shutil.rmtree(old.parent, ignore_errors=True)
    return build


@pytest.fixture
def start(programs, runtime):
    """Starts `peer` in a role, with a registry for it to find, and ends it."""
    ensure_registry(0)
    with contextlib.ExitStack() as stack:

        def run(*arguments: object) -> Peer:
            peer = Peer([programs / "peer", *arguments])
            stack.callback(peer.end)
            return peer

        yield run
