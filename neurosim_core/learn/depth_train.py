"""Training of depth from events: the same from recordings and from processes that fly meanwhile."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim_core.data import LiveSource, Stream
from neurosim_core.data.batch import Batch
from neurosim_core.learn.depth import DEPTH_MAX_M, DepthErrors, DepthNet, ErrorSums, depth_loss
from neurosim_core.learn.depth_live import flight_settings, live_flights

_log = logging.getLogger(__name__)
_SILENT_S = 120.0
"""Live flights have ended if nothing comes for so long: the next scene takes a while [s]."""
_TEST_SEED = 1_000_000
"""Of the first flight that is only tested on."""


@dataclass(frozen=True, kw_only=True)
class DepthConfig:
    """How depth is learned."""

    window_s: float = 0.05
    """Length of a window of events [s]; the depth of its end is the target."""
    bins: int = 5
    """Channels of a voxel."""
    channels: int = 16
    """Of the network's finest level."""
    sequence: int = 4
    """Consecutive windows through which gradients go back."""
    batch: int = 8
    """Sequences of a step."""
    rate: float = 2e-3
    """Highest learning rate; it rises over the first tenth of the time and falls along a cosine."""
    minutes: float = 3.0
    """How long to train [min]; waiting for the first windows is not counted."""
    steps: int | None = None
    """How many steps to train, however long they take; None: as `minutes` says."""
    room: int = 20_000
    """Windows that are kept to be seen again; of more, the oldest go."""
    size_px: int = 48
    """Of the pictures of live and of test flights, where they are flown here [px]."""
    test_flights: int = 8
    """Flights in scenes that are not trained in."""
    device: str = "cpu"
    """Of the network."""
    seed: int = 0
    """Of the order, the weights and the live flights."""


def voxels_and_depth(batch: Batch, bins: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return what the network sees, and what it should say, shapes [B, bins, H, W] and [B, H, W]."""
    assert batch.events is not None
    assert batch.depth is not None
    return batch.events.voxel(bins), batch.depth


class WindowPool:
    """Windows to be seen again, in sequences that follow on each other; filled from any stream.

    Args:
        length: Windows of a sequence.
        room: Most windows.
        bins: Channels of a voxel.
    """

    def __init__(self, *, length: int, room: int, bins: int) -> None:
        self._length, self._most, self._bins = length, max(1, room // length), bins
        self._sequences: list[tuple[NDArray[Any], NDArray[Any]]] = []
        self._begun: dict[str, list[tuple[int, NDArray[Any], NDArray[Any]]]] = {}
        self._oldest = 0
        self._lock = threading.Lock()
        self.window_count = 0
        """Windows that have come."""

    def __len__(self) -> int:
        return len(self._sequences)

    def add(self, batch: Batch) -> None:
        """Take windows; those of a flight come in the order of time, those of several in any."""
        voxel, depth = voxels_and_depth(batch, self._bins)
        for row, name in enumerate(batch.source):
            begun = self._begun.setdefault(name, [])
            if begun and begun[-1][0] != batch.start_ns[row]:
                begun.clear()  # a new flight, or a window is missing
            begun.append((int(batch.stamp_ns[row]), voxel[row].astype(np.float16), depth[row]))
            self.window_count += 1
            if len(begun) == self._length:
                _, voxels, depths = zip(*begun, strict=True)
                self._keep(np.stack(voxels), np.stack(depths))
                begun.clear()

    def _keep(self, voxel: NDArray[Any], depth: NDArray[Any]) -> None:
        with self._lock:
            if len(self._sequences) < self._most:
                self._sequences.append((voxel, depth))
                return
            self._sequences[self._oldest] = (voxel, depth)
            self._oldest = (self._oldest + 1) % self._most

    def draw(self, count: int, random: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Return sequences, half of them mirrored, shapes [T, B, bins, H, W] and [T, B, H, W]."""
        with self._lock:
            picked = [self._sequences[k] for k in random.integers(len(self._sequences), size=count)]
        mirrored = random.random(count) < 0.5
        voxel, depth = (
            np.stack([s[k][..., ::-1] if m else s[k] for s, m in zip(picked, mirrored, strict=True)], 1)
            for k in (0, 1)
        )
        return torch.from_numpy(voxel).float(), torch.from_numpy(depth)

    def mean_log_depth(self) -> Tensor:
        """Return the mean of log depth of each pixel: what can be said without looking, shape [H, W]."""
        with self._lock:
            depth = np.concatenate([depth for _, depth in self._sequences])
        known = np.isfinite(depth) & (depth > 0.0) & (depth < DEPTH_MAX_M)
        logs = np.log(np.where(known, depth, 1.0)).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        return torch.from_numpy(logs.astype(np.float32))


Window = tuple[str, Tensor, Tensor]
"""Name of a flight, voxel [bins, H, W] and depth [H, W]."""


def held_out_windows(config: DepthConfig, data: Path | None) -> Iterator[Window]:
    """Yield the windows of test flights in order: of a data set, or of flights in scenes of their own."""
    options: dict[str, Any] = {"window_s": config.window_s, "batch": 64, "fields": ["events", "depth"]}
    sources: list[Any] = [data]
    if data is None:
        seeds = range(_TEST_SEED, _TEST_SEED + config.test_flights)
        sources = [flight_settings(config.size_px, seed, duration_s=3.0) for seed in seeds]
    for number, source in enumerate(sources):
        for batch in Stream(source, **options):
            voxels, depths = (torch.from_numpy(array) for array in voxels_and_depth(batch, config.bins))
            for name, voxel, depth in zip(batch.source, voxels, depths, strict=True):
                yield f"{number} {name}", voxel, depth


def evaluate(
    net: DepthNet, windows: Sequence[Window], *, blind: bool = False, device: str = "cpu"
) -> DepthErrors:
    """Return the errors over flights, each from its first window to its last, with memory.

    Args:
        net: What predicts.
        windows: In order.
        blind: Zero the events.
        device: Where the network is.
    """
    sums, memory, flight = ErrorSums(), None, None
    net.eval()
    with torch.no_grad():
        for name, voxel, depth in windows:
            if name != flight:
                memory, flight = None, name
            seen = voxel[None].to(device)
            log_depth, memory = net(torch.zeros_like(seen) if blind else seen, memory)
            sums.add(log_depth.cpu(), depth[None])
    net.train()
    return sums.result()


def _fill(pool: WindowPool, stream: Stream, stop: threading.Event) -> None:
    """Read a stream to its end, or until it is to stop."""
    for batch in stream:
        pool.add(batch)
        if stop.is_set():
            return


def train_depth(
    folder: Path, config: DepthConfig, *, data: Path | None = None, live: int = 0, test: Path | None = None
) -> dict[str, DepthErrors]:
    """Train from a data set or from live processes, test in scenes not seen, and leave all in a folder.

    Args:
        folder: Gets `depth.pt` and `depth.json`.
        config: How.
        data: A data set or recordings with events and depth.
        live: So many processes that fly meanwhile, and stream over Cortex.
        test: A data set to test on; None: flights in scenes of their own.

    Returns:
        Errors of the network, of the network with its events zeroed, and of the mean depth of each pixel.

    Raises:
        ValueError: Not exactly one of `data` and `live` is given, or there is too little data.
    """
    if (data is None) == (live == 0):
        raise ValueError("say what to learn from: --data DIR, or --live N")
    torch.manual_seed(config.seed)
    if live:
        torch.set_num_threads(1)  # threads that wait for each other beside processes that fly are slower
    pool = WindowPool(length=config.sequence, room=config.room, bins=config.bins)
    options: dict[str, Any] = {"window_s": config.window_s, "fields": ["events", "depth"]}
    stop = threading.Event()
    if data is not None:
        _fill(pool, Stream(data, batch=64 * config.sequence, sequence=config.sequence, **options), stop)
        net, steps = _fit(pool, config)
    else:
        with live_flights(live, flight_settings(config.size_px, 0), seed=config.seed) as names:
            stream = Stream(LiveSource(names, timeout_s=_SILENT_S), batch=1, **options)
            filler = threading.Thread(target=_fill, args=(pool, stream, stop), daemon=True)
            filler.start()
            try:
                while len(pool) < config.batch and filler.is_alive():
                    time.sleep(0.05)
                net, steps = _fit(pool, config)
            finally:
                stop.set()
                filler.join(_SILENT_S)  # the next window ends it, as long as somebody flies
    tested = list(held_out_windows(config, test))
    constant = ErrorSums()
    for _, _, depth in tested:
        constant.add(pool.mean_log_depth(), depth)
    errors = {
        "network": evaluate(net, tested, device=config.device),
        "events zeroed": evaluate(net, tested, blind=True, device=config.device),
        "mean depth": constant.result(),
    }
    folder.mkdir(parents=True, exist_ok=True)
    shape = {"bins": net.bins, "channels": net.channels}
    torch.save({"net": {k: v.cpu() for k, v in net.state_dict().items()}, **shape}, folder / "depth.pt")
    told = {
        "config": asdict(config),
        "steps": steps,
        "training windows": pool.window_count,
        "test windows": len(tested),
        "errors": {name: error._asdict() for name, error in errors.items()},
    }
    (folder / "depth.json").write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
    return errors


def load_depth(file: Path) -> DepthNet:
    """Return a network that `train_depth` left."""
    saved = torch.load(file, map_location="cpu", weights_only=True)
    net = DepthNet(saved["bins"], saved["channels"])
    net.load_state_dict(saved["net"])
    return net.eval()


def _fit(pool: WindowPool, config: DepthConfig) -> tuple[DepthNet, int]:
    """Train for the time that there is; return the network and how many steps that were."""
    if len(pool) == 0:
        raise ValueError(f"there are no {config.sequence} consecutive windows to learn from")
    random = np.random.default_rng(config.seed)
    net = DepthNet(config.bins, config.channels).to(config.device)
    optimizer = torch.optim.AdamW(net.parameters(), lr=config.rate, weight_decay=1e-4)
    begin_s, steps = time.monotonic(), 0

    def share_done() -> float:
        if config.steps is not None:
            return steps / config.steps
        return (time.monotonic() - begin_s) / (60.0 * config.minutes)

    while (share := share_done()) < 1.0:
        for group in optimizer.param_groups:
            group["lr"] = config.rate * min(1.0, 10.0 * share + 0.01) * 0.5 * (1.0 + np.cos(np.pi * share))
        voxel, depth = (part.to(config.device) for part in pool.draw(config.batch, random))
        memory, predicted = None, []
        for window in voxel:
            log_depth, memory = net(window, memory)
            predicted.append(log_depth)
        loss = depth_loss(torch.stack(predicted), depth)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        steps += 1
        if steps % 100 == 0:
            _log.info(
                "step %d, %.0f %%: loss %.4f, %d windows",
                steps,
                100.0 * share,
                loss.item(),
                pool.window_count,
            )
    return net, steps
