"""Torch tensors in messages and out of them."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from cortex.codec import codec_of
from cortex.message_types import Array, message
from cortex.messages import MotorCommand
from cortex.tensors import to_numpy, to_torch

torch = pytest.importorskip("torch", reason="torch is not installed")


@message
class Picture:
    stamp_ns: int
    data: Array["any", "h", "w"]
    fixed: Array["float32", 3]


def picture(data, fixed=None):
    return Picture(1, data, torch.ones(3) if fixed is None else fixed)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.float64, torch.int64, torch.bool])
def test_tensors_are_encoded_as_arrays(dtype):
    tensor = torch.arange(12).reshape(3, 4).to(dtype)
    codec = codec_of(Picture)
    body = codec.encode(picture(tensor), 1000)
    assert body == codec.encode(picture(tensor.numpy(), np.ones(3, np.float32)), 1000)
    memory = np.zeros(1000, np.uint8)
    assert memory[: codec.prepare(picture(tensor), 0).write(memory)].tobytes() == body
    assert codec.size(picture(tensor)) == len(body)


def test_tensors_of_any_kind_on_the_cpu():
    speeds = torch.arange(8, dtype=torch.float64)
    codec = codec_of(MotorCommand)
    for tensor in (speeds, speeds.clone().requires_grad_(), torch.nn.Parameter(speeds), speeds[::2]):
        body = codec.encode(MotorCommand(0, tensor), 1000)
        np.testing.assert_array_equal(codec.decode(body).speed, tensor.detach().numpy())
    strided = torch.arange(12.0).reshape(3, 4).T
    decoded = codec_of(Picture).decode(codec_of(Picture).encode(picture(strided), 1000))
    np.testing.assert_array_equal(decoded.data, strided.numpy())


def test_tensors_elsewhere_or_without_a_numpy_dtype_are_refused():
    for value, said in (
        (picture(torch.zeros(2, 2, device="meta")), r"Picture\.data: the tensor is on meta.*\.cpu\(\)"),
        (picture(torch.zeros(2, 2, dtype=torch.bfloat16)), r"Picture\.data: .*BFloat16"),
        (MotorCommand(0, torch.zeros(4)), r"MotorCommand\.speed: dtype float32, expected float64"),
    ):
        with pytest.raises(TypeError, match=said):
            codec_of(type(value)).encode(value, 1000)


def test_messages_with_tensors_compare_and_copy():
    first = picture(torch.ones(2, 2))
    copied = first.copy()
    assert copied == first
    copied.data[0, 0] = 5.0
    assert copied != first
    assert first == picture(np.ones((2, 2), np.float32), np.ones(3, np.float32))
    assert "data=tensor torch.float32[2, 2]" in repr(first)


def test_a_decoded_array_becomes_a_tensor_without_a_warning():
    codec = codec_of(MotorCommand)
    decoded = codec.decode(codec.encode(MotorCommand(0, np.arange(4.0)), 1000))
    unaligned = np.ndarray(4, np.float64, bytes(3) + np.arange(4.0).tobytes(), 3)
    for array in (decoded.speed, unaligned):
        tensor = to_torch(array)
        assert tensor.tolist() == [0.0, 1.0, 2.0, 3.0]
        tensor[0] = 9.0
        assert array[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        to_torch(decoded.speed, copy=False)


def test_sharing_memory_both_ways():
    owned = np.arange(4.0)
    tensor = to_torch(owned, copy=False)
    tensor[0] = 9.0
    assert owned[0] == 9.0
    back = to_numpy(tensor)
    back[1] = 8.0
    assert owned[1] == 8.0
    assert to_torch(owned, device="cpu").device.type == "cpu"
    with pytest.raises(TypeError, match="expected a torch tensor, got list"):
        to_numpy([1.0])


def test_without_torch_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ModuleNotFoundError, match="pip install torch"):
        to_torch(np.zeros(3))
