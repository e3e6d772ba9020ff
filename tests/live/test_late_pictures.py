"""Pictures that a device writes where their readers find them, while the simulator goes on."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import warp as wp
from live_rig import RGB, LiveRig, count_free, drain, make_config, models_of
from processes import SOON_S

from cortex import Node, reliable
from cortex.messages import Image, Odometry
from neurosim_core import streams
from neurosim_core.config import SimulationConfig
from neurosim_core.live import craft, loans
from neurosim_core.live.loans import PictureLoan
from neurosim_core.packets import Image as ImagePacket
from neurosim_core.pinned import PinError
from neurosim_core.simulation import make_state, observe, step

SHAPE = (150, 160, 3)
LENS = {"width": 160, "height": 150, "horizontal_fov_rad": 1.5}


class Mapping:
    """Takes the place of a `PinnedMapping`."""

    made: ClassVar[list[Mapping]]
    refused: ClassVar[bool]

    def __init__(self, memory: Any, device: str) -> None:
        if self.refused:
            raise PinError("CUDA error 801")
        assert device == "cuda:0"
        self.memory: Any = memory
        self.made.append(self)

    def close(self) -> None:
        self.memory = None


@pytest.fixture
def mappings(monkeypatch: pytest.MonkeyPatch) -> type[Mapping]:
    """CUDA, as far as loans know."""
    Mapping.made, Mapping.refused = [], False
    monkeypatch.setattr(loans, "PinnedMapping", Mapping)
    monkeypatch.setattr(
        loans, "wp", SimpleNamespace(get_device=lambda name: SimpleNamespace(is_cuda=name != "cpu"))
    )
    return Mapping


def message_of(data: np.ndarray) -> Image:
    return Image(stamp_ns=7, data=data, encoding="rgb8", frame_id="camera", sequence=0)


def test_a_ring_is_pinned_once_until_it_is_replaced(mappings, runtime):
    """All slots of a ring are in one mapping; one for larger pictures is another."""
    with Node("camera") as node, Node("viewer") as viewer:
        publisher = node.publisher("/picture", Image)
        subscriber = viewer.subscriber("/picture", Image, policy=reliable())
        assert publisher.wait_for_subscribers(1, timeout_s=SOON_S)
        loan = PictureLoan(publisher, device="cuda:0")
        for size in (1, 1, 1, 1, 1, 1, 4, 4):
            room = loan.lend(np.zeros((150 * size, 160, 3), np.uint8))
            (ring,) = [mapping for mapping in mappings.made if mapping.memory is not None]
            view = np.frombuffer(ring.memory, np.uint8)
            assert np.shares_memory(view, room)
            del view
            room[:] = size
            loan.publish(message_of(room))
            assert (subscriber.recv(SOON_S).data == size).all()
        assert len(mappings.made) == 2
        del room
        loan.close()
        assert [mapping.memory for mapping in mappings.made] == [None, None]


def test_no_room_where_memory_cannot_be_pinned(mappings, runtime, caplog):
    """It is tried and said once, and leaves no slot behind."""
    mappings.refused = True
    with Node("camera") as node, Node("viewer") as viewer:
        publisher = node.publisher("/picture", Image)
        viewer.subscriber("/picture", Image, policy=reliable())
        assert publisher.wait_for_subscribers(1, timeout_s=SOON_S)
        loan = PictureLoan(publisher, device="cuda:0")
        free = count_free(publisher, SHAPE)
        for _ in range(3):
            assert loan.lend(np.zeros(SHAPE, np.uint8)) is None
        assert count_free(publisher, SHAPE) == free
        assert [record.levelname for record in caplog.records] == ["WARNING"]
        assert "801" in caplog.text
        loan.close()


def test_the_device_is_waited_for_before_a_picture_is_published(mappings, runtime):
    with Node("camera") as node, Node("viewer") as viewer:
        publisher = node.publisher("/picture", Image)
        subscriber = viewer.subscriber("/picture", Image, policy=reliable())
        assert publisher.wait_for_subscribers(1, timeout_s=SOON_S)
        loan = PictureLoan(publisher, device="cuda:0")
        room = loan.lend(np.zeros(SHAPE, np.uint8))
        room[:] = 1
        loan.settle = functools.partial(room.fill, 2)
        loan.publish(message_of(room))
        assert (subscriber.recv(SOON_S).data == 2).all()
        del room
        loan.settle = None
        loan.close()


@pytest.fixture
def late(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Callable[[], None]]]:
    """A device that copies pictures when it is waited for."""
    waiting: list[Callable[[], None]] = []
    due: dict[int, list[Callable[[], None]]] = {}

    def fetch_into(copy: streams.HostCopy, room: np.ndarray, row: int) -> None:
        room[:] = 77
        waiting.append(functools.partial(np.copyto, room, copy.rows(row, 1)[0]))

    def wait(milestone: streams.Milestone) -> None:
        for operation in due.pop(id(milestone), ()):
            if operation in waiting:
                operation()
                waiting.remove(operation)

    monkeypatch.setattr(streams.HostCopy, "fetch_into", fetch_into)
    monkeypatch.setattr(streams.Milestone, "set", lambda m: due.update({id(m): list(waiting)}))
    monkeypatch.setattr(streams.Milestone, "wait", wait)
    monkeypatch.setattr(craft, "sees_inline", lambda device: True)
    yield waiting
    assert not waiting
    due.clear()


def check_flight(config: SimulationConfig) -> None:
    """Fly over Cortex: every state and picture is that of its stamp, complete, as in one process."""
    with LiveRig(config) as rig:
        assert all(cast.lends for cast in rig.simulator.crafts[0].state.casts)
        pictures = rig.listen("/drone/rgb", Image)
        odometry = rig.listen("/drone/odometry", Odometry)
        tilt = np.array([1.02, 1.0, 1.0, 1.02])
        states = rig.fly(odometry, 12, lambda state: ("motor_speeds", rig.hover() * tilt))
        found = drain(pictures, least=13)
        model = models_of(config)["drone"]
        state = make_state(model, lane_count=1)
        packets, positions = [], [observe(state).position]
        for _ in range(12):
            packets += step(model, state, rig.hover() * tilt)
            positions.append(observe(state).position)
        assert [each.position.tobytes() for each in states] == [each.tobytes() for each in positions]
        expected = [packet for packet in packets if isinstance(packet, ImagePacket)]
        assert [picture.stamp_ns for picture in found] == [packet.stamp_ns for packet in expected]
        assert len({picture.data.tobytes() for picture in found}) == 13
        for picture, packet in zip(found, expected, strict=True):
            assert picture.data.tobytes() == packet.data.tobytes()


def lockstep_config(**overrides: Any) -> SimulationConfig:
    sensors = {"rgb": {**RGB, "rate_hz": 100.0, "lens": LENS}}
    return make_config(sensors=sensors, **{"live.mode": "lockstep", "control.rate_hz": 100.0, **overrides})


def test_a_flight_with_a_late_device_shows_the_same(runtime, late):
    check_flight(lockstep_config())


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")
def test_a_flight_on_a_cuda_device_shows_the_same(runtime):
    config = lockstep_config(device="cuda:0", renderer="warp", **{"render.lighting.mode": "unshadowed"})
    check_flight(config)
