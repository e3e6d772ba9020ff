"""Fixtures that every test can use, and who runs beside whom."""

from __future__ import annotations

import compileall
import gc
import os
import signal
import sys
from pathlib import Path

import hypothesis
import pytest
import warp as wp
from alone import pytest_runtest_protocol

from neurosim_core.warp_start import start_warp

__all__ = ["pytest_runtest_protocol"]

wp.config.log_level = wp.LOG_WARNING
gc.set_threshold(10_000, 10, 10)  # collecting thousands of tests takes a third less time

# A busy machine makes any example late: how long one takes is no property of what is tested.
hypothesis.settings.register_profile("any machine", deadline=None)
hypothesis.settings.load_profile("any machine")

# Shells start background jobs with SIGINT ignored, `nohup` any with SIGHUP, and processes that a test starts
# would inherit that.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

LONGEST = [Path(__file__).parent / name for name in (
    "live/test_restart.py", "cortex/test_cpp.py", "test_readme.py", "live/test_browser.py", "test_cli.py",
    "live/test_loop.py", "vehicle/test_extreme_flights.py", "vehicle/test_adaptive.py",
    "live/test_my_controller.py",
)]  # fmt: skip
"""Files that come first: a long one at the end would be waited for by all processes but its own."""

SHARED = Path(__file__).resolve().parents[2] / "shared"


WAITING = ("bridge", "cortex", "live")
"""Folders whose tests mostly wait for other processes and for time to pass."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Let `-n auto` start two processes more than there are cores: some of them always wait."""
    return 2 + (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def pytest_configure(config: pytest.Config) -> None:
    """Keep the order of the files; pytest-xdist would begin with those of the most tests.

    Packages are compiled once, before the workers start.
    """
    if not hasattr(config, "workerinput") and not sys.dont_write_bytecode:
        for package in ("cortex", "cortex_ros2_bridge", "neurosim_core"):
            compileall.compile_dir(Path(__file__).parents[1] / package, quiet=2, workers=0)
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files; then alternate between files that wait and files that compute."""
    files = dict.fromkeys(item.path for item in items if item.path not in LONGEST)
    kinds: tuple[list[Path], list[Path]] = ([], [])
    for path in files:
        kinds[path.parent.name in WAITING].append(path)
    places = {path: place / len(kind) for kind in kinds for place, path in enumerate(kind)}
    places |= {path: place - len(LONGEST) for place, path in enumerate(LONGEST)}
    items.sort(key=lambda item: places[item.path])


def pytest_collection_finish() -> None:
    """Let the garbage collector pass over what stays: to look takes a tenth of a second."""
    gc.collect()
    gc.freeze()


def _devices() -> list[str]:
    start_warp()
    return ["cpu"] + (["cuda:0"] if wp.is_cuda_available() else [])


@pytest.fixture(params=_devices())
def device(request: pytest.FixtureRequest) -> str:
    """Every device of this machine: kernels must be right on each."""
    return str(request.param)


@pytest.fixture
def kernel_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of kernels for the test alone, which is empty."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    return tmp_path


@pytest.fixture(scope="session")
def house() -> Path:
    """The textured house that is kept beside the project."""
    path = SHARED / "scenes" / "aws_small_house.glb"
    if not path.exists():
        pytest.skip(f"the house scene is not at {path}")
    return path


@pytest.fixture(scope="session")
def small_assets() -> Path:
    """Small glTF files that are kept beside the project."""
    path = SHARED / "scenes" / "habitat_test_assets"
    if not path.exists():
        pytest.skip(f"the small glTF files are not at {path}")
    return path
