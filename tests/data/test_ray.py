"""Two simulators on a cluster of Ray that is started here: the same bytes as in this process."""

from __future__ import annotations

import importlib
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_room import room_scene

from neurosim_core import data
from neurosim_core.config import load_config
from neurosim_core.data.make import DatasetPlan, make_flights, prepare
from neurosim_core.data.ray_source import RaySource, cluster, make_flights_on_ray
from neurosim_core.data.sources import numbered

ray = pytest.importorskip("ray", reason="needs the extra distributed: Ray is not installed")

LENS = {"width": 24, "height": 16, "horizontal_fov_rad": 1.5}


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return load_config({
        "duration_s": 0.3,
        "device": "cpu",
        "renderer": "synthetic",
        "scene": room_scene(tmp_path_factory.mktemp("room")),
        "path": {"kind": "tour", "seed": 1},
        "sensors": {
            "events": {"kind": "event_camera", "lens": LENS},
            "depth": {"kind": "depth", "rate_hz": 20.0, "lens": LENS},
        },
    })  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _cluster():
    logging.getLogger("ray").setLevel(logging.ERROR)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_worker_niceness", "0")  # else everything else on the machine comes before it
        with cluster("local"):
            yield


def test_two_simulators_give_the_windows_of_this_process(config):
    source = RaySource(config, simulators=2, flights=2)
    found: dict[str, list[data.Batch]] = {}
    for batch in data.Stream(source, batch=1):
        found.setdefault(batch.source[0], []).append(batch)
    with pytest.raises(ValueError, match="a flight has no sensor for flow"):
        next(iter(data.Stream(source, fields=["events", "flow"])))
    assert sorted(found) == ["flight 0", "flight 1", "flight 10000", "flight 10001"]
    for number in (1, 10000):
        expected = [*data.Stream(numbered(config, number), batch=1)]
        assert len(expected) == len(found[f"flight {number}"]) == 6
        for one, other in zip(expected, found[f"flight {number}"], strict=True):
            assert (one.stamp_ns, one.start_ns) == (other.stamp_ns, other.start_ns)
            assert all(np.array_equal(a, b) for a, b in zip(one.events.raw, other.events.raw, strict=True))
            assert np.array_equal(one.depth, other.depth)


def test_a_data_set_has_the_same_bytes(config, tmp_path):
    plans = [DatasetPlan(config=config, folder=tmp_path / name, flight_count=3) for name in ("here", "there")]
    for plan in plans:
        prepare(plan)
    here, there = plans
    assert [*make_flights(here, workers=0, stopped=lambda: False)] == [0, 1, 2]
    scene = {"kind": "mesh", "file": str(tmp_path / "nothing.glb")}
    lost = replace(there, config=config.model_copy(update={"scene": load_config({"scene": scene}).scene}))
    with pytest.raises((OSError, ValueError), match=r"nothing\.glb"):  # what a task raises is raised here
        next(make_flights_on_ray(lost, address="local", workers=1, stopped=lambda: False))
    stop = iter([False, True])
    assert len([*make_flights_on_ray(there, address="local", workers=2, stopped=lambda: next(stop))]) == 2
    assert len([*make_flights_on_ray(there, address="local", workers=2, stopped=lambda: False)]) == 1
    for number in range(3):
        for suffix in (".h5", ".json"):
            files = [plan.path(number).with_suffix(suffix) for plan in plans]
            assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of Ray, in Ray
def test_the_example_trains_on_two_workers(monkeypatch):
    pytest.importorskip("torch", reason="needs the extra learn")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    example = importlib.import_module("ray_train")
    ray.cloudpickle.register_pickle_by_value(example)  # as that of a script: workers do not find the module
    told = example.main()
    assert told["workers"] == 2
    assert 0.0 < told["loss"] < 1.0
