"""A student as an ONNX file, which says itself what it was trained for."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from neurosim_core.learn import need
from neurosim_core.learn.pilot import CARD
from neurosim_core.learn.policies import EventPolicy

_GRAPH = """
<ir_version: 8, opset_import: ["" : 17]>
policy (float[1, {channels}, {height}, {width}] events, float[1, {vector_size}] vector,
        float[1, {memory_size}] memory)
    => (float[1, {action_count}] action, float[1, {memory_size}] memory_out)
{{
    one = Constant <value_float = 1.0> ()
    tenth = Constant <value_float = 0.1> ()
    lowest = Constant <value_float = -1.0> ()
    parts = Constant <value_ints = [{hidden}, {hint_count}]> ()
    time = Constant <value_ints = [0]> ()
    magnitude = Abs (events)
    grown = Add (magnitude, one)
    logarithm = Log (grown)
    sign = Sign (events)
    surfaces = Mul (logarithm, sign)
    {eyes}
    features = Concat <axis = 1> (seen, vector)
    {mix}
    before, estimate = Split <axis = 1> (memory, parts)
    input = Concat <axis = 1> (mixed, estimate)
    memory_bias = Concat <axis = 1> (memory_bias_ih, memory_bias_hh)
    input_of_time = Unsqueeze (input, time)
    before_of_time = Unsqueeze (before, time)
    every, after_of_time = GRU <hidden_size = {hidden}, linear_before_reset = 1>
        (input_of_time, memory_weight_ih, memory_weight_hh, memory_bias, , before_of_time)
    after = Squeeze (after_of_time, time)
    change = Gemm <transB = 1> (after, change_weight, change_bias)
    step = Mul (change, tenth)
    moved = Add (estimate, step)
    memory_out = Concat <axis = 1> (after, moved)
    remembered = Concat <axis = 1> (memory_out, vector)
    {head}
    action = Clip (mean, lowest, one)
}}
"""
"""The graph in ONNX's own language: exporters of PyTorch change from release to release."""

_OPERATORS: dict[type, str] = {nn.ELU: "Elu", nn.Flatten: "Flatten"}


def export_onnx(policy: EventPolicy, card: Mapping[str, Any], file: Path) -> None:
    """Write one step of a student for one vehicle.

    Inputs: `events` [1, C, H, W], `vector` [1, n], `memory` [1, m], zeros when an episode begins. Outputs:
    `action` [1, 4] in [-1, 1], `memory_out`. All float32. `card`: what whoever flies it needs to know; kept
    in the file.
    """
    onnx = need("onnx")
    layers = {
        "eyes": _lines(policy.eyes, "eyes", "surfaces", "seen"),
        "mix": _lines(policy.mix, "mix", "features", "mixed"),
        "head": _lines(policy.head, "head", "remembered", "mean"),
    }
    text = {name: "\n    ".join(lines) for name, lines in layers.items()}
    model = onnx.parser.parse_model(_GRAPH.format(**policy.shape, memory_size=policy.memory_size, **text))
    for name, value in _weights(policy):
        model.graph.initializer.append(onnx.numpy_helper.from_array(value.detach().cpu().numpy(), name))
    onnx.helper.set_model_props(model, {CARD: json.dumps(dict(card))})
    onnx.checker.check_model(model)
    onnx.save(model, str(file))


def _lines(layers: nn.Sequential, name: str, x: str, output: str) -> Iterator[str]:
    """Yield the nodes of layers, whose weights are `NAME_INDEX_weight` and `NAME_INDEX_bias`."""
    for index, layer in enumerate(layers):
        y = output if index == len(layers) - 1 else f"{name}_{index}"
        inputs = f"({x}, {name}_{index}_weight, {name}_{index}_bias)"
        if isinstance(layer, nn.Conv2d):
            pads = [*layer.padding, *layer.padding]
            yield f"{y} = Conv <pads = {pads}, strides = {[*layer.stride]}> {inputs}"
        elif isinstance(layer, nn.Linear):
            yield f"{y} = Gemm <transB = 1> {inputs}"
        else:
            yield f"{y} = {_OPERATORS[type(layer)]} ({x})"
        x = y


def _weights(policy: EventPolicy) -> Iterator[tuple[str, torch.Tensor]]:
    """Yield the initialisers of the graph; a GRU of ONNX has its update gate before its reset gate."""
    for name, value in policy.state_dict().items():
        if name.startswith("memory."):
            reset, update, new = value.chunk(3)
            value = torch.cat([update, reset, new])[None]
        yield name.replace(".", "_"), value
