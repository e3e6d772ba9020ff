"""Torch tensors to and from the arrays of messages. Torch is imported on first use only."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex.structure import is_tensor


def to_torch(array: NDArray[Any], *, copy: bool = True, device: Any = None) -> Any:
    """Return a tensor with the items of an array.

    Args:
        array: Array of a message; may be read-only.
        copy: Whether the tensor owns its memory. Without a copy it shares memory with the array, which must
            be writable, because torch knows no read-only tensors: `message.copy()` gives such arrays.
        device: Where the tensor shall live, as `torch.Tensor.to` takes it. Another device than the CPU gets
            one transfer, and no copy before it.

    Raises:
        ModuleNotFoundError: Torch is not installed.
        ValueError: No copy was wanted of a read-only array.
        TypeError: Torch has no such dtype.
    """
    torch = _torch()
    if not copy and not array.flags.writeable:
        raise ValueError("the array is read-only, as all decoded arrays are; use copy=True or message.copy()")
    # A copy is always row-major and aligned, which torch demands and a view into a frame may not be.
    owned = np.array(array, order="C") if copy else array
    tensor = torch.from_numpy(owned)
    return tensor if device is None else tensor.to(device)


def to_numpy(tensor: Any) -> NDArray[Any]:
    """Return the memory of a CPU tensor as an array, without a copy.

    Raises:
        TypeError: The tensor is on another device, or NumPy has no such dtype.
    """
    if not is_tensor(tensor):
        raise TypeError(f"expected a torch tensor, got {type(tensor).__name__}")
    if tensor.device.type != "cpu":
        raise TypeError(f"the tensor is on {tensor.device}; messages take CPU memory, call .cpu() first")
    array: NDArray[Any] = tensor.detach().resolve_conj().resolve_neg().numpy()
    return array


def _torch() -> Any:
    try:
        return importlib.import_module("torch")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("tensors need torch: pip install torch", name="torch") from error
