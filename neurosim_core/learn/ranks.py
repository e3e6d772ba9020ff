"""Several processes that train one policy, each with worlds of its own, such as one for each GPU of a host.

    torchrun --standalone --nproc-per-node 2 -m neurosim_core learn hover

`torchrun` says who is who in the environment; without it there is one process, of rank 0.
"""

from __future__ import annotations

import os

import torch
from torch import distributed

from neurosim_core.warp_start import find_device


def rank() -> int:
    """Return the number of this process among them, from 0; only the first writes files."""
    return int(os.environ.get("RANK", "0"))


def count() -> int:
    """Return how many there are."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def join(device: str) -> str:
    """Meet the others, and return the device of this process: on CUDA, that of its number on its host."""
    if count() == 1:
        return device
    device = find_device(device)
    if device.startswith("cuda"):
        device = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(torch.device(device))
    if not distributed.is_initialized():
        distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
    return device


def average(values: torch.Tensor) -> None:
    """Replace values by their means over all processes; waits for the others."""
    distributed.all_reduce(values)
    values /= count()
