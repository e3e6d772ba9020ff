"""Paths that another process plans are those that are planned here."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from processes import children_of, gone
from small_room import room_scene

import neurosim_core as ns
from neurosim_core.path_process import PlanningProcess, may_need_planning
from neurosim_core.scene.reader import SceneReader
from neurosim_core.sim import Model, make_model, model
from neurosim_core.trajectory import CollisionFreeConfig, PathConfig
from neurosim_core.trajectory.planner import PlanningError


def settings_in(folder: Path, **path: Any) -> dict[str, Any]:
    return {
        "scene": room_scene(folder),
        "path": {"kind": "tour", "leg_length_m": 2.0, **path},
        "sensors": {"imu": {"kind": "imu"}},
        "duration_s": 0.5,
        "device": "cpu",
    }


def model_by_processes(settings: dict[str, Any], *, kill: bool = False) -> Model:
    before = children_of(os.getpid())
    with PlanningProcess() as planner:
        (pid,) = children_of(os.getpid()) - before
        with SceneReader(settings) as reader:
            reader.planner = planner
            if kill:
                os.kill(pid, signal.SIGKILL)
            return make_model(ns.load_config(settings), reader=reader)


def test_a_path_is_the_one_that_is_planned_here(tmp_path, monkeypatch):
    settings = settings_in(tmp_path)
    here = make_model(ns.load_config(settings))
    monkeypatch.setattr(model, "choose_seed", None)  # nothing is planned here
    there = model_by_processes(settings)
    np.testing.assert_array_equal(there.path.knots_ns, here.path.knots_ns)
    np.testing.assert_array_equal(there.path.coefficients, here.path.coefficients)
    np.testing.assert_array_equal(there.free_space.seed_m, here.free_space.seed_m)
    assert there.free_space.notes == here.free_space.notes
    assert there.free_space.device == "cpu"
    assert there.free_space.clearance(there.free_space.seed_m)[0] > 0.3


def test_no_process_is_started_where_nothing_is_planned():
    """Of all kinds of paths, those around obstacles need it, and it is known before they are imported."""
    kinds = get_args(get_args(PathConfig)[0])
    assert len(kinds) > 5
    for config in kinds:
        kind = config.model_fields["kind"].default
        assert may_need_planning({"path": {"kind": kind}}) == issubclass(config, CollisionFreeConfig)
    assert may_need_planning({})
    assert may_need_planning({"path": {"kind": "hover"}, "vehicles": {"a": {}}})


def test_a_process_that_ends_too_early_is_done_without(tmp_path):
    assert model_by_processes(settings_in(tmp_path), kill=True).path.end_ns >= 500_000_000


def test_why_there_is_no_path_is_said_here(tmp_path):
    with pytest.raises(PlanningError, match="nothing can be reached at clearance_m = 7"):
        model_by_processes(settings_in(tmp_path, clearance_m=7.0))
    with pytest.raises(PlanningError, match="thrust_to_weight_max = 50 is more than the vehicle has"):
        model_by_processes(settings_in(tmp_path, limits={"thrust_to_weight_max": 50.0}))


def test_other_paths_are_planned_here(tmp_path):
    settings = settings_in(tmp_path) | {"path": {"kind": "hover", "position_m": [0.5, 0.5, 1.0]}}
    before = children_of(os.getpid())
    with PlanningProcess() as planner:
        (pid,) = children_of(os.getpid()) - before
        with SceneReader(settings, planner=planner) as reader:
            path = make_model(ns.load_config(settings), reader=reader).path
            assert gone(pid)  # it does not stay as long as the flight
    np.testing.assert_array_equal(path.evaluate([0]).position, [[0.5, 0.5, 1.0]])
