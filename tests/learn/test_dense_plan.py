"""Paths that other processes plan."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest

import neurosim_core as ns
from neurosim_core.learn import dense_plan
from neurosim_core.learn.dense_plan import PathPlanner
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


def test_paths_are_those_of_this_process_in_the_order_of_flights(monkeypatch):
    """Two processes, each with one of two scenes: what they answer is put back in order."""
    monkeypatch.setattr(dense_plan, "core_count", lambda: 4)
    flights = [flight(scene, path) for scene, path in ((0, 1), (1, 2), (0, 3))]
    with PathPlanner() as planner:
        planner.begin(flights)
        found = planner.result()
        for path, config in zip(found, flights, strict=True):
            (expected,) = plan_paths(config).values()
            np.testing.assert_array_equal(path.knots_ns, expected.knots_ns)
            np.testing.assert_array_equal(path.coefficients, expected.coefficients)
        planner.begin([flight(0, 1, clearance_m=5.0)])
        with pytest.raises(ValueError, match="nothing can be reached at clearance_m = 5"):
            planner.result()


def test_a_process_that_died_is_an_error_and_none_stays(monkeypatch):
    begun = []
    popen = subprocess.Popen

    def begin(*arguments, **options):
        begun.append(popen(*arguments, **options))
        return begun[-1]

    monkeypatch.setattr(subprocess, "Popen", begin)
    with PathPlanner() as planner:
        planner.begin([flight(0, 1)])
        begun[0].kill()
        with pytest.raises(RuntimeError, match="has died"):
            planner.result()
    assert all(process.poll() is not None for process in begun)


def test_a_process_ends_with_its_input(monkeypatch):
    """As it does when the process that asks is killed."""
    monkeypatch.setattr(dense_plan, "core_count", lambda: 2)
    (process,) = PathPlanner()._processes
    assert process.communicate(timeout=60.0) == (b"", None)
    assert process.returncode == 0
