"""A foreign controller on DDS flies a figure eight through the bridge as well as one without any of it."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from processes import ROOT
from runtime_directory import own_directory

from cortex import Node
from neurosim_core.bench.bridge_flight import MODES, measure_flights


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A runtime directory, with a registry that is not in the test's DDS domain."""
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    with own_directory(monkeypatch), Node("first") as node:
        assert node.wait_for_registry()
        yield


def test_a_figure_eight_through_dds(registry: None, dds_domain: int) -> None:
    """AttitudeTarget, a reset by topic, then Actuators: each is as close to the path as in one process.

    Lockstep makes delays harmless, so only the float32 of a thrust may differ. What delays cost,
    `python -m neurosim_core.bench.bridge_flight` measures, streaming.
    """
    flights = measure_flights("lockstep", domain=dds_domain)
    assert [flight.mode for flight in flights] == list(MODES)
    for flight in flights:
        assert flight.count == 401
        assert flight.in_process_rms_m < 0.15
        assert flight.ratio == pytest.approx(1.0, abs=0.1)
