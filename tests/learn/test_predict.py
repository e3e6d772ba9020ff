"""A network as a Cortex node: what it publishes of events is what it says of them in this process."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from processes import SOON_S

from cortex import Node, reliable
from cortex.messages import Events, Image, Simulation
from neurosim_core.config import load_config, to_yaml
from neurosim_core.data.batch import EventBatch
from neurosim_core.packets import EventArrays

torch = pytest.importorskip("torch", reason="needs the extra learn")

from neurosim_core.learn.dense_train import DenseConfig  # noqa: E402
from neurosim_core.learn.predict import predict  # noqa: E402

WINDOW_US = 50_000
LENS = {"width": 8, "height": 8, "horizontal_fov_rad": 1.5}


def save(folder, task):
    torch.manual_seed(0)
    net = DenseConfig(task=task, channels=4).net()
    torch.nn.init.normal_(net.out.weight, std=0.3)
    card = {"task": task, "window_s": 1e-6 * WINDOW_US, "bins": 5, "channels": 4}
    torch.save({"net": net.state_dict(), **card}, folder / f"{task}.pt")
    return net.eval(), folder / f"{task}.pt"


def draw_events(number, random):
    t = np.sort(random.integers(WINDOW_US * number + 1, WINDOW_US * (number + 1) + 1, 60))
    x, y = (random.integers(0, 8, len(t)).astype(np.uint16) for _ in range(2))
    return EventArrays(t, x, y, random.integers(0, 2, len(t)).astype(np.uint8))


def voxel_of(events, number):
    ends = (np.array([WINDOW_US * n]) for n in (number, number + 1))
    names = ("start_us", "stamp_us")
    offsets = np.array([0, len(events.t)])
    batch = EventBatch(raw=events, offsets=offsets, **dict(zip(names, ends, strict=True)), width=8, height=8)
    return torch.from_numpy(batch.voxel(5))


@pytest.mark.parametrize(("task", "encoding"), [("depth", "32FC1"), ("flow", "32FC2")])
def test_pictures_are_those_of_the_network_which_forgets_at_a_reset(tmp_path, runtime, task, encoding):
    net, file = save(tmp_path, task)
    random = np.random.default_rng(0)
    config = to_yaml(load_config({"sensors": {"events": {"kind": "event_camera", "lens": LENS}}}))
    options = {"duration_s": 0.2, "say": lambda line: None}
    run = threading.Thread(target=predict, args=(file,), kwargs=options, daemon=True)
    with Node("simulator") as node, torch.no_grad():
        seen = node.publisher("/drone/events", Events)
        pictures = node.subscriber(f"/drone/predicted/{task}", Image, policy=reliable(16))
        simulation = Simulation(
            config=config, version="0", vehicles=["drone"], mode="streaming", control_rate_hz=100.0
        )
        node.publisher("/simulation", Simulation, latch=True).publish(simulation)
        run.start()
        assert seen.wait_for_subscribers(timeout_s=SOON_S)
        assert pictures.wait_for_publisher(timeout_s=SOON_S)
        expected: list[tuple[int, np.ndarray]] = []
        for packets in (3, 5):  # the second flight is watched to 0.2 s; the next packet completes a window
            memory = None
            for number in range(packets):
                events = draw_events(number, random)
                stamp_ns, start_ns = (1000 * WINDOW_US * n for n in (number + 1, number))
                seen.publish(
                    Events(
                        stamp_ns=stamp_ns, start_ns=start_ns, sequence=number, **events._asdict(),
                        width=8, height=8,
                    )
                )  # fmt: skip
                predicted, memory = net(voxel_of(events, number), memory)
                picture = (predicted.exp() if task == "depth" else predicted)[0].movedim(0, -1)
                expected.append((stamp_ns, picture.numpy()))
        for stamp_ns, data in expected[:-1]:
            picture = pictures.recv(SOON_S)
            assert (picture.stamp_ns, picture.encoding) == (stamp_ns, encoding)
            np.testing.assert_allclose(picture.data, data, rtol=1e-5, atol=1e-6)
        run.join(SOON_S)
    assert not run.is_alive()


def test_only_pictures_can_be_predicted(tmp_path):
    _, file = save(tmp_path, "pretrain")
    with pytest.raises(ValueError, match="only depth and flow are pictures"):
        predict(file)
