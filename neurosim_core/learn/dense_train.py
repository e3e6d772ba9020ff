"""Training of dense predictions: the same from recordings, processes that fly meanwhile, and worlds."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neurosim_core.data import LiveSource, RaySource, Stream
from neurosim_core.data.batch import Batch
from neurosim_core.data.stream import find_recordings
from neurosim_core.learn.dense import DenseNet, Memory
from neurosim_core.learn.dense_flights import flight_settings, live_flights
from neurosim_core.learn.heads import HEADS, Head

_log = logging.getLogger(__name__)
_SILENT_S = 120.0
"""Live flights have ended if nothing comes for so long: the next scene takes a while [s]."""
_REMEMBERED = 0.75
"""Share of the sequences of a step that begin with the memory that the step before has left."""
_TOLD_S = 10.0
"""How often the log tells how far training has come [s]."""
_TEST_SEED = 1_000_000
"""Of the first flight that is only tested on."""


@dataclass(frozen=True, kw_only=True)
class DenseConfig:
    """Training of a network that predicts a value per pixel from events."""

    task: str = "depth"
    """Predicted quantity, one of `HEADS`."""
    window_s: float = 0.05
    """Length of a window of events [s]."""
    bins: int = 5
    """Channels of a voxel grid of events."""
    channels: int = 16
    """Channels of the network's finest level."""
    sequence: int = 4
    """Consecutive windows of backpropagation through time."""
    batch: int = 8
    """Sequences in a gradient step."""
    rate: float = 2e-3
    """Highest learning rate; it rises over the first tenth of the time and falls along a cosine."""
    minutes: float = 3.0
    """Training time [min]; waiting for the first windows is not counted."""
    steps: int | None = None
    """Number of gradient steps, however long they take; None: as many as fit in `minutes`."""
    capacity: int = 20_000
    """Capacity of the replay buffer [windows]; beyond it, the oldest are dropped."""
    reuse: float = 4.0
    """Worlds fly on when their windows have been used this often, on average."""
    renders: int | None = 2
    """Renders of the event camera per window, in worlds; None: as in other flights, ten in 50 ms. From two,
    depth is learned as well in the same time (docs/data.md)."""
    threshold_spread: float = 0.25
    """Relative half-width of the thresholds that each world draws around the nominal ones, in each flight."""
    size_px: int = 48
    """Width and height of the pictures of all flights that are flown here [px]."""
    test_flights: int = 8
    """Number of flights in scenes that are not trained in."""
    backbone: str | None = None
    """File of a network whose weights initialise the backbone; see `DenseNet.take_backbone`."""
    device: str = "cpu"
    """Device of the network."""
    fly_device: str | None = None
    """Device of the worlds; None: that of the network. On another device, worlds fly during learning."""
    seed: int = 0
    """Seed of the order, the weights and the flights."""

    @property
    def head(self) -> Head:
        """The predicted quantity."""
        return HEADS[self.task]

    def net(self) -> DenseNet:
        """Return an untrained network."""
        return DenseNet(self.head.start, self.bins, self.channels)


class Windows(NamedTuple):
    """Windows of some flights."""

    source: Sequence[str]
    """Name of the flight of each."""
    start_ns: Sequence[int]
    stamp_ns: Sequence[int]
    voxel: Tensor
    """Input of the network, shape [B, bins, H, W]."""
    target: Tensor
    """As the head says, shape [B, C, H, W]."""


def windows_of(batch: Batch, head: Head, bins: int) -> Windows:
    """Return the windows of a batch."""
    assert batch.events is not None
    value = batch.events.counts() if head.field == "events" else getattr(batch, head.field)
    target = head.target(torch.from_numpy(value))
    voxel = torch.from_numpy(batch.events.voxel(bins))
    return Windows(batch.source, batch.start_ns.tolist(), batch.stamp_ns.tolist(), voxel, target)


class ReplayBuffer:
    """Windows to be seen again, in sequences that follow on each other; filled from any source.

    `mirrored`: factor of each channel of a target in a mirrored picture. `device`: where they are kept; None:
    where they come from.
    """

    def __init__(
        self, *, length: int, capacity: int, mirrored: Sequence[float] = (1.0,), device: str | None = None
    ) -> None:
        self._length, self._most, self._device = length, max(1, capacity // length), device
        self._sign = torch.tensor(mirrored)[:, None, None]
        self._sequences: list[tuple[Tensor, Tensor]] = []
        self._begun: dict[str, list[tuple[int, Tensor, Tensor]]] = {}
        self._oldest = 0
        self._lock = threading.Lock()
        self.window_count = 0
        """Windows that have come."""

    def __len__(self) -> int:
        return len(self._sequences)

    def add(self, windows: Windows) -> None:
        """Take windows; those of a flight come in the order of time, those of several in any."""
        voxels = windows.voxel.to(self._device, torch.half)
        targets = windows.target.to(self._device, copy=True)
        for row, name in enumerate(windows.source):
            begun = self._begun.setdefault(name, [])
            if begun and begun[-1][0] != windows.start_ns[row]:
                begun.clear()  # a new flight, or a window is missing
            begun.append((windows.stamp_ns[row], voxels[row], targets[row]))
            self.window_count += 1
            if len(begun) == self._length:
                _, voxel, target = zip(*begun, strict=True)
                self._keep(torch.stack(voxel), torch.stack(target))
                begun.clear()

    def _keep(self, voxel: Tensor, target: Tensor) -> None:
        with self._lock:
            if len(self._sequences) < self._most:
                self._sequences.append((voxel, target))
                return
            self._sequences[self._oldest] = (voxel, target)
            self._oldest = (self._oldest + 1) % self._most

    def draw(self, count: int, random: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Return sequences, half of them mirrored: voxels (float16, [T, B, bins, H, W]), and targets."""
        with self._lock:
            picked = [self._sequences[k] for k in random.integers(len(self._sequences), size=count)]
        mirrored = (random.random(count) < 0.5).tolist()
        sign = self._sign.to(picked[0][1].device)
        voxel = [v.flip(-1) if m else v for (v, _), m in zip(picked, mirrored, strict=True)]
        target = [t.flip(-1) * sign if m else t for (_, t), m in zip(picked, mirrored, strict=True)]
        return torch.stack(voxel, 1), torch.stack(target, 1)

    def targets(self) -> Tensor:
        """Return the targets of all windows, shape [n, C, H, W]."""
        with self._lock:
            return torch.cat([target for _, target in self._sequences])


def held_out_windows(config: DenseConfig, data: Path | None) -> Iterator[Windows]:
    """Yield the windows of test flights in order: of a data set, or of flights in scenes of their own."""
    sources: list[Any] = [data]
    ends = None if data is None or config.head.field == "events" else config.head.field
    if data is None:
        seeds = range(_TEST_SEED, _TEST_SEED + config.test_flights)
        field = config.head.field
        more: dict[str, Any] = {"field": field, "duration_s": 3.0, "device": config.device}
        sources = [flight_settings(config.size_px, seed, **more) for seed in seeds]
    for number, source in enumerate(sources):
        for batch in Stream(source, batch=64, ends=ends, **_options(config)):
            found = windows_of(batch, config.head, config.bins)
            yield found._replace(source=[f"{number} {name}" for name in found.source])


def _options(config: DenseConfig) -> dict[str, Any]:
    return {"window_s": config.window_s, "fields": list(dict.fromkeys(["events", config.head.field]))}


def evaluate(
    predict: Callable[..., tuple[Tensor, Any]], tested: Iterable[Windows], head: Head, device: str = "cpu"
) -> Any:
    """Return the errors over flights, each from its first window to its last, with memory.

    `predict`: called with a voxel [1, bins, H, W] and the memory of the window before, or None.
    """
    sums: Tensor | None = None
    memory, flight = None, None
    due: list[tuple[Tensor, Tensor]] = []
    """Predictions that are not yet compared, with their inputs."""
    with torch.no_grad():
        for windows in tested:
            for name, voxel, target in zip(windows.source, windows.voxel, windows.target, strict=True):
                if name != flight:
                    memory, flight = None, name
                    due.clear()
                predicted, memory = predict(voxel[None].to(device), memory)
                due.append((predicted.cpu(), voxel[None]))
                if len(due) > head.ahead:
                    before, seen = due.pop(0)
                    measured = head.measure(before, target[None], seen)
                    sums = measured if sums is None else sums + measured
    if sums is None:
        raise ValueError("no window has anything to compare with")
    return head.errors(sums)


def train_dense(
    folder: Path,
    config: DenseConfig,
    *,
    data: Path | None = None,
    live: int = 0,
    ray: str | None = None,
    worlds: int = 0,
    test: Path | None = None,
) -> dict[str, Any]:
    """Train, test in scenes not seen, and leave all in a folder.

    Returns errors of the network, of the network with its events zeroed, and of the mean of each pixel.

    Args:
        folder: Gets `TASK.pt` and `TASK.json`.
        config: What, and how.
        data: Learn from a data set or recordings with events and what is to be predicted.
        live: Or from so many processes that fly meanwhile, and stream over Cortex.
        ray: Address of a cluster of Ray where those of `live` fly instead; see `data.ray_source.cluster`.
        worlds: Or from so many worlds, on the device of the network.
        test: A data set to test on; None: flights in scenes of their own.
    """
    if bool(data) + bool(live) + bool(worlds) != 1:
        raise ValueError("say what to learn from: --data DIR, --live N, or --worlds N")
    if config.fly_device is not None and not worlds:
        raise ValueError(f"fly_device {config.fly_device!r} needs worlds: say --worlds N")
    if test is not None:
        find_recordings(test)  # that it is not there is said now, not after training
    torch.manual_seed(config.seed)
    head, net = config.head, config.net()
    if config.backbone is not None:
        net.take_backbone(Path(config.backbone))
    if live or torch.device(config.device).type == "cuda":
        torch.set_num_threads(1)  # more wait for each other where others work, and only put batches together
    buffer = ReplayBuffer(
        length=config.sequence + head.ahead,
        capacity=config.capacity,
        mirrored=head.mirrored,
        device=config.device if worlds else None,
    )
    _log.info("waiting for the first windows")
    with _source(buffer, config, data, live, worlds, ray) as more:
        fit = _fit(net.to(config.device), buffer, config, more)
    folder.mkdir(parents=True, exist_ok=True)
    card = {"task": config.task, "window_s": config.window_s, "bins": net.bins, "channels": net.channels}
    weights = {name: value.cpu() for name, value in net.state_dict().items()}
    torch.save({"net": weights, **card}, folder / f"{config.task}.pt")
    constant = head.constant(buffer.targets()).cpu()[None]

    def predict_mean(voxel: Tensor, _memory: Any) -> tuple[Tensor, Any]:
        return torch.nn.functional.interpolate(constant, voxel.shape[-2:]), None

    _log.info("testing in scenes that were not trained in" if test is None else f"testing on {test}")
    tested = [*held_out_windows(config, test)]
    net.eval()
    errors = {
        "network": evaluate(net, tested, head, config.device),
        "events zeroed": evaluate(lambda v, m: net(torch.zeros_like(v), m), tested, head, config.device),
        "mean of each pixel": evaluate(predict_mean, tested, head),
    }
    told = {
        "config": asdict(config),
        "steps": fit.steps,
        "share of the time without data": fit.waited_share,
        "gpus": fit.gpus,
        "training windows": buffer.window_count,
        "test windows": sum(len(windows.source) for windows in tested),
        "errors": {name: error._asdict() for name, error in errors.items()},
    }
    (folder / f"{config.task}.json").write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
    return errors


def load_dense(file: Path) -> tuple[DenseNet, DenseConfig]:
    """Return a network that `train_dense` left, and what it predicts.

    Raises:
        ValueError: The file is none of these.
    """
    saved = torch.load(file, map_location="cpu", weights_only=True)
    if not isinstance(saved, dict) or saved.get("task") not in HEADS:
        raise ValueError(f"{file} is no network of `neurosim learn {' or '.join(HEADS)}`")
    weights = saved.pop("net")
    config = DenseConfig(**saved)
    net = config.net()
    net.load_state_dict(weights)
    return net.eval(), config


@contextlib.contextmanager
def _source(
    buffer: ReplayBuffer, config: DenseConfig, data: Path | None, live: int, worlds: int, ray: str | None
) -> Iterator[Callable[[int], None]]:
    """Fill a buffer for the first step; yield what to call before each step, with its number."""
    head, fly_device = config.head, config.fly_device or config.device
    needed, reuse = config.batch, math.inf  # sequences of the first step; how often windows may be seen
    with contextlib.ExitStack() as stack:
        if worlds:
            from neurosim_core.learn.dense_worlds import world_windows

            settings = flight_settings(config.size_px, config.seed, field=head.field, device=fly_device)
            windows: Iterator[Windows] = stack.enter_context(
                contextlib.closing(
                    world_windows(
                        settings, head, worlds=worlds, bins=config.bins, window_s=config.window_s,
                        renders=config.renders, threshold_spread=config.threshold_spread,
                    )
                )
            )  # fmt: skip
            needed, reuse = min(needed, worlds), config.reuse
        else:
            stream = _stream(stack, config, data, live, ray)
            windows = (windows_of(batch, head, config.bins) for batch in stream)
            if data is not None:
                needed = sys.maxsize

        def add() -> bool:
            window = next(windows, None)
            if window is not None:
                buffer.add(window)
            return window is not None

        comes = add
        if live or fly_device != config.device:
            comes = stack.enter_context(_in_background(add))
        while len(buffer) < needed and comes():
            pass

        def more(step: int) -> None:
            while buffer.window_count * reuse < step * config.batch * config.sequence and comes():
                pass

        yield more


def _stream(
    stack: contextlib.ExitStack, config: DenseConfig, data: Path | None, live: int, ray: str | None
) -> Stream:
    """Return windows of recordings in sequences, or of processes that fly; these end with the stack."""
    if data is not None:
        length = config.sequence + config.head.ahead
        return Stream(data, batch=64 * length, sequence=length, **_options(config))
    settings = flight_settings(config.size_px, 0, field=config.head.field)
    if ray is not None:
        source: Any = RaySource(settings, simulators=live, address=ray, first=config.seed)
    else:
        names = stack.enter_context(live_flights(live, settings, seed=config.seed))
        source = LiveSource(names, timeout_s=_SILENT_S)
    return Stream(source, batch=1, **_options(config))


@contextlib.contextmanager
def _in_background(step: Callable[[], bool]) -> Iterator[Callable[[], bool]]:
    """Do a step again and again in a thread, as long as it returns true and the block has not ended.

    Yield what waits a moment and says whether this goes on; it raises what the step raised.
    """
    stop = threading.Event()

    def work() -> None:
        while not stop.is_set() and step():
            pass

    with ThreadPoolExecutor(1) as executor:
        working = executor.submit(work)

        def goes_on() -> bool:
            if working.done():
                working.result()
                return False
            time.sleep(1e-3)
            return True

        try:
            yield goes_on
        finally:
            stop.set()  # the next step ends it


class _Fit(NamedTuple):
    """Time and steps of a training."""

    steps: int
    waited_share: float
    """Share of its time in which it flew, or waited for those who fly."""
    gpus: list[str]
    """Number, memory in use and power of each GPU at its end."""


def _gpus(device: str) -> list[str]:
    if torch.device(device).type != "cuda":
        return []
    query = ["nvidia-smi", "--query-gpu=index,memory.used,power.draw", "--format=csv,noheader"]
    return subprocess.run(query, capture_output=True, text=True, check=True).stdout.splitlines()


def _some_of(memory: Memory | None, random: np.random.Generator) -> Memory | None:
    """Return the memory that a step left, but for a quarter of its sequences.

    It is of other flights than those that follow: a network that has to begin with it learns to forget. One
    that always begins without does well for as many windows as a sequence has, and drifts in longer flights.
    """
    if memory is None:
        return None
    kept = torch.from_numpy(random.random(len(memory[0])) < _REMEMBERED).to(memory[0])
    return tuple(level.detach() * kept[:, None, None, None] for level in memory)


def _fit(net: DenseNet, buffer: ReplayBuffer, config: DenseConfig, more: Callable[[int], None]) -> _Fit:
    """Train for the time that there is."""
    if len(buffer) == 0:
        raise ValueError(
            f"there are no {config.sequence + config.head.ahead} consecutive windows to learn from"
        )
    head, random = config.head, np.random.default_rng(config.seed)
    optimizer = torch.optim.AdamW(net.parameters(), lr=config.rate, weight_decay=1e-4)
    begin_s, steps, waited_s = time.monotonic(), 0, 0.0
    told_s = begin_s
    memory: Memory | None = None

    def share_done() -> float:
        if config.steps is not None:
            return steps / config.steps
        return (time.monotonic() - begin_s) / (60.0 * config.minutes)

    while (share := share_done()) < 1.0:
        for group in optimizer.param_groups:
            group["lr"] = config.rate * min(1.0, 10.0 * share + 0.01) * 0.5 * (1.0 + np.cos(np.pi * share))
        asked_s = time.monotonic()
        more(steps)
        waited_s += time.monotonic() - asked_s
        voxel, target = (part.to(config.device).float() for part in buffer.draw(config.batch, random))
        memory, predicted = _some_of(memory, random), []
        for window in voxel[: config.sequence]:
            one, memory = net(window, memory)
            predicted.append(one)
        loss = head.loss(torch.stack(predicted), target[head.ahead :])
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        steps += 1
        if time.monotonic() - told_s > _TOLD_S:
            told_s = time.monotonic()
            told = (steps, 100.0 * share, loss.item(), buffer.window_count)
            _log.info("step %d, %.0f %%: loss %.4f, %d windows", *told)
    fit = _Fit(steps, waited_s / (time.monotonic() - begin_s), _gpus(config.device))
    _log.info(
        "%d steps, %.0f %% of the time without data %s", steps, 100.0 * fit.waited_share, fit.gpus or ""
    )
    return fit
