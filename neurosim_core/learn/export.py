"""A student as an ONNX file, which says itself what it was trained for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from neurosim_core.learn import need
from neurosim_core.learn.pilot import CARD
from neurosim_core.learn.policies import EventPolicy

_OPSET, _IR = 17, 8


def export_onnx(policy: EventPolicy, card: Mapping[str, Any], file: Path) -> None:
    """Write one step of a student for one vehicle.

    Inputs: `events` [1, C, H, W], `vector` [1, n], `memory` [1, m], zeros when an episode begins. Outputs:
    `action` [1, 4] in [-1, 1], `memory_out`. All float32. The graph is written node by node: exporters of
    PyTorch change from release to release. `card`: what whoever flies it needs to know; kept in the file.
    """
    onnx = need("onnx")
    shape, graph = policy.shape, _Graph(onnx)
    hidden, size = policy.hidden, policy.memory_size
    grown = graph.add("Add", [graph.add("Abs", ["events"]), graph.constant(np.float32(1.0))])
    seen = graph.add("Mul", [graph.add("Log", [grown]), graph.add("Sign", ["events"])])
    for layer in policy.eyes:
        seen = graph.layer(layer, seen)
    features = graph.add("Concat", [seen, "vector"], axis=1)
    for layer in policy.mix:
        features = graph.layer(layer, features)
    before, estimate = graph.columns("memory", 0, hidden), graph.columns("memory", hidden, size)
    inputs = graph.add("Concat", [features, estimate], axis=1)
    after = graph.gru(policy.memory, inputs, before)
    change = graph.add("Mul", [graph.layer(policy.change, after), graph.constant(np.float32(0.1))])
    estimate = graph.add("Add", [estimate, change])
    memory = graph.add("Concat", [after, estimate], output="memory_out", axis=1)
    action = graph.add("Concat", [memory, "vector"], axis=1)
    for layer in policy.head:
        action = graph.layer(layer, action)
    bounds = [graph.constant(np.float32(bound)) for bound in (-1.0, 1.0)]
    graph.add("Clip", [action, *bounds], output="action")

    def tensor(name: str, *size: int) -> Any:
        return onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, *size])

    model = onnx.helper.make_model(
        onnx.helper.make_graph(
            graph.nodes,
            "policy",
            [
                tensor("events", shape["channels"], shape["height"], shape["width"]),
                tensor("vector", shape["vector_size"]),
                tensor("memory", size),
            ],
            [tensor("action", shape["action_count"]), tensor("memory_out", size)],
            graph.constants,
        ),
        opset_imports=[onnx.helper.make_opsetid("", _OPSET)],
        ir_version=_IR,
    )
    onnx.helper.set_model_props(model, {CARD: json.dumps(dict(card))})
    onnx.checker.check_model(model)
    onnx.save(model, str(file))


class _Graph:
    """Nodes and constants of an ONNX graph."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, value: Any) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(self._onnx.numpy_helper.from_array(np.asarray(value), name))
        return name

    def add(self, kind: str, inputs: list[str], output: str | None = None, **attributes: Any) -> str:
        name = output or f"n{len(self.nodes)}"
        self.nodes.append(self._onnx.helper.make_node(kind, inputs, [name], **attributes))
        return name

    def columns(self, x: str, begin: int, end: int) -> str:
        bounds = [self.constant(np.array([n], np.int64)) for n in (begin, end, 1)]
        return self.add("Slice", [x, *bounds])

    def weights(self, values: Any) -> str:
        return self.constant(values.detach().cpu().numpy())

    def linear(self, weight: Any, bias: Any, x: str) -> str:
        return self.add("Gemm", [x, self.weights(weight), self.weights(bias)], transB=1)

    def layer(self, layer: nn.Module, x: str) -> str:
        if isinstance(layer, nn.Conv2d):
            values = [self.weights(each) for each in layer.parameters()]
            pads, strides = (int(layer.padding[0]),) * 4, layer.stride  # type: ignore[arg-type]
            return self.add("Conv", [x, *values], pads=pads, strides=strides)
        if isinstance(layer, nn.Linear):
            return self.linear(layer.weight, layer.bias, x)
        kinds: dict[type, str] = {nn.ELU: "Elu", nn.Flatten: "Flatten"}
        return self.add(kinds[type(layer)], [x])

    def gru(self, cell: nn.GRUCell, x: str, memory: str) -> str:
        """Return the memory after a step, by the equations of `torch.nn.GRUCell`."""
        parts = []
        size = self.constant(np.full(3, cell.hidden_size, np.int64))
        for weight, bias, value in (
            (cell.weight_ih, cell.bias_ih, x),
            (cell.weight_hh, cell.bias_hh, memory),
        ):
            names = [f"g{len(self.nodes)}_{part}" for part in range(3)]
            joined = self.linear(weight, bias, value)
            self.nodes.append(self._onnx.helper.make_node("Split", [joined, size], names, axis=1))
            parts.append(names)
        reset, update = (
            self.add("Sigmoid", [self.add("Add", [parts[0][gate], parts[1][gate]])]) for gate in range(2)
        )
        kept = self.add("Mul", [reset, parts[1][2]])
        new = self.add("Tanh", [self.add("Add", [parts[0][2], kept])])
        return self.add("Add", [new, self.add("Mul", [update, self.add("Sub", [memory, new])])])
