"""Data loaders: workers that are forked are refused at once, and workers that are spawned work."""

from __future__ import annotations

import subprocess
import sys

import pytest

LOADER = """
import sys
import neurosim_core as ns
from torch.utils.data import DataLoader, IterableDataset

CONFIG = {
    "duration_s": 0.02,
    "device": "cpu",
    "scene": {"kind": "apartment", "rooms": 1},
    "render": {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1},
    "sensors": {"rgb": {"kind": "rgb", "lens": {"width": 64, "height": 48, "horizontal_fov_rad": 1.5}}},
}


def sums():
    return [int(p.data.sum()) for p in ns.run(CONFIG)]


class Flights(IterableDataset):
    def __init__(self, carried=None):
        self.carried = carried

    def __iter__(self):
        yield sums() if self.carried is None else [len(ns.step(*self.carried, None))]


if __name__ == "__main__":
    expected = sums()
    carried = None
    if sys.argv[2:]:
        model = ns.make_model(ns.load_config(CONFIG))
        carried = (model, ns.make_state(model))
    loader = DataLoader(Flights(carried), num_workers=1, batch_size=None, multiprocessing_context=sys.argv[1])
    assert [[int(v) for v in row] for row in loader] == [expected], expected
    print("as in the parent", len(expected))
"""


def load(tmp_path, *arguments: str) -> subprocess.CompletedProcess[str]:
    pytest.importorskip("torch")
    script = tmp_path / "loader.py"
    script.write_text(LOADER)
    return subprocess.run(
        [sys.executable, str(script), *arguments], capture_output=True, text=True, timeout=300
    )


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere workers are spawned")
@pytest.mark.parametrize("what", [["fork"], ["fork", "carried"]])
def test_a_forked_worker_of_a_parent_that_simulated_is_refused(what, tmp_path):
    done = load(tmp_path, *what)
    assert done.returncode == 1
    assert "RuntimeError: this process was forked from one that had started the simulator" in done.stderr
    assert "multiprocessing_context='spawn'" in done.stderr


def test_a_spawned_worker_sees_what_the_parent_saw(tmp_path):
    done = load(tmp_path, "spawn")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].startswith("as in the parent")
    assert "Warp" not in done.stdout + done.stderr  # it starts without its lines
