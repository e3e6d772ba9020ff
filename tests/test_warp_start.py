"""Starting Warp: what threads and processes share."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import warp as wp

from neurosim_core import warp_start
from neurosim_core.warp_start import has_kernels, start_warp


def test_an_empty_kernel_cache_is_known(kernel_cache):
    (kernel_cache / "wp_somebody.else_0123").mkdir()
    assert not has_kernels()

    @wp.kernel(module=wp.get_module("neurosim_core.first"), enable_backward=False)
    def store(out: wp.array[int]) -> None:
        out[0] = 1

    wp.launch(store, dim=1, outputs=[wp.zeros(1, dtype=int, device="cpu")], device="cpu")
    assert has_kernels()


def test_the_kernel_cache_is_found_before_anything_was_computed(tmp_path):
    """As in a script that begins with `fly`: Warp does not know its own cache until it has started."""
    program = "from neurosim_core.warp_start import has_kernels; print(has_kernels())"
    (tmp_path / wp.config.version / "wp_neurosim_core.first_0123").mkdir(parents=True)
    run = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"WARP_CACHE_PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout == "True\n"


def test_a_kernel_cache_that_cannot_be_made_is_told_in_a_line(tmp_path):
    (tmp_path / "file").touch()
    run = subprocess.run(
        [sys.executable, "-m", "neurosim_core", "convert", "in.csv", "out.raw"],
        env=os.environ | {"WARP_CACHE_PATH": str(tmp_path / "file" / "cache")},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
    )
    assert run.returncode == 1
    cache = tmp_path / "file" / "cache" / wp.config.version
    assert run.stderr.startswith(f"neurosim: cannot make {cache}, where compiled kernels are kept: Not a")
    assert run.stderr.endswith("set WARP_CACHE_PATH to a folder that can be written\n")


def test_that_no_device_is_to_be_seen_is_not_told():
    """As with a driver and CUDA_VISIBLE_DEVICES="": what else is written while Warp starts is kept."""
    lines = [
        "Warp CUDA error 100: no CUDA-capable device is detected (in function init_cuda_driver)",
        "something else",
    ]
    program = (
        "import os, warp as wp\n"
        "from neurosim_core.warp_start import start_warp\n"
        "init = wp.init\n"
        f"wp.init = lambda: (init(), os.write(2, {chr(10).join([*lines, '']).encode()!r}))\n"
        "start_warp()\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stderr == "something else\n"


def test_threads_compile_with_the_same_precompiled_headers(kernel_cache):
    """The second thread reads the file of the first: Warp on its own would write one for each."""
    start_warp()

    def compile_adder(amount: int) -> None:
        @wp.kernel(module="unique", enable_backward=False)
        def add(out: wp.array[int]) -> None:
            out[0] = out[0] + wp.static(amount)

        out = wp.zeros(1, dtype=int, device="cpu")
        wp.launch(add, dim=1, outputs=[out], device="cpu")
        assert out.numpy()[0] == amount

    def headers() -> set[tuple[str, int]]:
        files = Path(wp.config.kernel_cache_dir, "headers").rglob("*.pch")
        return {(str(file), file.stat().st_mtime_ns) for file in files}

    compile_adder(3)
    first = headers()
    thread = threading.Thread(target=compile_adder, args=(5,))
    thread.start()
    thread.join()
    assert first
    assert headers() == first


def test_who_needs_the_same_kernels_waits_for_who_compiles_them(kernel_cache):
    folder = kernel_cache / "wp_module_0123"

    def compile_module(module, device, folder):
        if folder.exists():
            return False
        time.sleep(0.05)  # long enough for all others to begin
        folder.mkdir()
        return True

    compile_or_wait = warp_start._compile_once(compile_module)
    with ThreadPoolExecutor(4) as pool:
        compiled = list(pool.map(lambda _: compile_or_wait(None, "cpu", folder), range(4)))
    assert sorted(compiled) == [False, False, False, True]
    shutil.rmtree(kernel_cache / "locks")
    assert not compile_or_wait(None, "cpu", folder)
    # what is compiled may lie in a cache that is not to be written
    assert not (kernel_cache / "locks").exists()


def test_a_process_that_stands_still_holds_up_nobody_for_ever(kernel_cache, monkeypatch):
    """It has the lock of what it compiles."""
    monkeypatch.setattr(warp_start, "_COMPILE_S", 0.05)
    (kernel_cache / "locks").mkdir()
    compile_or_wait = warp_start._compile_once(lambda module, device, folder: True)
    with open(kernel_cache / "locks" / "wp_module_0123", "a") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert compile_or_wait(None, "cpu", kernel_cache / "wp_module_0123")


def test_windows_has_no_locks_of_files_and_computes_without_them(tmp_path):
    program = f"""
import sys
import warp as wp
wp.init()
wp.config.kernel_cache_dir = {str(tmp_path)!r}
sys.platform, sys.modules["fcntl"] = "win32", None
from neurosim_core.warp_start import start_warp
start_warp()

@wp.kernel(enable_backward=False, module=wp.get_module("neurosim_core.first"))
def store(out: wp.array[int]) -> None:
    out[0] = 7

out = wp.zeros(1, dtype=int, device="cpu")
wp.launch(store, dim=1, outputs=[out], device="cpu")
assert out.numpy()[0] == 7
"""
    (tmp_path / "store.py").write_text(program)
    subprocess.run([sys.executable, tmp_path / "store.py"], check=True, cwd=Path(__file__).parents[1])
