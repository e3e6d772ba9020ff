"""Processes that fly or plan flights to learn from."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest
from core_counts import cores

import neurosim_core as ns
from neurosim_core.learn.dense_flights import PathPlanner
from neurosim_core.sim import plan_paths


def flight(scene_seed, path_seed, **path):
    return ns.load_config(
        {
            "device": "cpu",
            "duration_s": 0.5,
            "scene": {"kind": "apartment", "rooms": 1, "seed": scene_seed},
            "path": {"kind": "tour", "seed": path_seed, **path},
            "sensors": {},
        }
    )


def test_paths_are_those_of_this_process_in_the_order_of_flights():
    """Two processes, each with one of two scenes: what they answer is put back in order."""
    flights = [flight(scene, path) for scene, path in ((0, 1), (1, 2), (0, 3))]
    with cores(4), PathPlanner() as planner:
        planner.begin(flights)
        found = planner.result()
        for path, config in zip(found, flights, strict=True):
            (expected,) = plan_paths(config).values()
            np.testing.assert_array_equal(path.knots_ns, expected.knots_ns)
            np.testing.assert_array_equal(path.coefficients, expected.coefficients)
        planner.begin([flight(0, 1, clearance_m=5.0)])
        with pytest.raises(ValueError, match="nothing can be reached at clearance_m = 5"):
            planner.result()


def test_a_process_that_died_is_an_error():
    with cores(2), PathPlanner() as planner:
        planner.begin([flight(0, 1)])
        for process in multiprocessing.active_children():
            process.kill()
        with pytest.raises(BrokenProcessPool):
            planner.result()


LIVES = """
import multiprocessing, threading
from neurosim_core.config import load_config
from neurosim_core.learn.dense_flights import PathPlanner, flight_settings, live_flights
if __name__ == "__main__":
    planner = PathPlanner()
    planner.begin([load_config(flight_settings(8, 0))])
    planner.result()
    with live_flights(1, flight_settings(8, 0)):
        print(len(multiprocessing.active_children()), "processes", flush=True)
        threading.Event().wait()
"""


def test_processes_end_with_the_one_that_was_killed(tmp_path):
    (tmp_path / "lives.py").write_text(LIVES)
    killed = subprocess.Popen([sys.executable, tmp_path / "lives.py"], stdout=subprocess.PIPE, text=True)
    assert killed.stdout.readline() == "2 processes\n"
    killed.kill()
    killed.communicate(timeout=60.0)  # its output ends with the last process that has it
