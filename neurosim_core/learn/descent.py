"""Steps that are replayed as CUDA graphs: small networks wait for launches otherwise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from neurosim_core.learn import ranks

_EAGER_STEPS = 3
"""Steps before one is captured: PyTorch sets things up in them."""


class GraphedFunction:
    """A function without arguments, which a CUDA device replays as one graph.

    `function`: works on tensors that are the same in each call and whose values change; it must not wait for
    the device. `on_cuda`: whether the tensors are on a CUDA device; elsewhere the function is called as it
    is.
    """

    def __init__(self, function: Callable[[], None], *, on_cuda: bool) -> None:
        self._function, self._on_cuda = function, on_cuda
        self._count = 0
        self._graph: Any = None

    def __call__(self) -> None:
        """Call the function."""
        self._count += 1
        if not self._on_cuda:
            self._function()
        elif self._count <= _EAGER_STEPS:
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                self._function()
            torch.cuda.current_stream().wait_stream(stream)
        else:
            if self._graph is None:
                self._graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(self._graph):
                    self._function()
            self._graph.replay()


class Descent:
    """Minimises a loss by Adam; with several processes (`ranks`), the mean of their losses.

    `loss`: returns the loss, as a `GraphedFunction` wants it. `gradient_max`: gradients with a larger norm
    are scaled down to it.

    Attributes:
        optimizer: Adam.
        rate_factor: What learning rates are multiplied with; kept with the state.
    """

    def __init__(
        self,
        module: nn.Module,
        loss: Callable[[], torch.Tensor],
        *,
        gradient_max: float,
        **settings: Any,
    ) -> None:
        self._module, self._loss, self._gradient_max = module, loss, gradient_max
        device = next(module.parameters()).device
        self._on_cuda = device.type == "cuda"
        self.rate_factor = 1.0
        self._rate = torch.zeros((), device=device) if self._on_cuda else 0.0
        self.optimizer = torch.optim.Adam(
            module.parameters(), lr=self._rate, capturable=self._on_cuda, fused=self._on_cuda, **settings
        )
        self._differentiate = GraphedFunction(self._backward, on_cuda=self._on_cuda)
        self._improve = GraphedFunction(self._step, on_cuda=self._on_cuda)
        size = sum(parameter.numel() for parameter in module.parameters()) if ranks.count() > 1 else 0
        self._gradient = torch.zeros(size, device=device)

    def step(self, rate: float) -> None:
        """Take a gradient step."""
        rate *= self.rate_factor
        for group in self.optimizer.param_groups:
            if self._on_cuda:
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate
        self._differentiate()
        if len(self._gradient):
            ranks.average(self._gradient)
        self._improve()

    def state_dict(self) -> dict[str, Any]:
        """Return what training goes on from."""
        return {
            "policy": self._module.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "rate_factor": self.rate_factor,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self._module.load_state_dict(state["policy"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.rate_factor = state.get("rate_factor", 1.0)  # 1: of a version without

    def _backward(self) -> None:
        loss = self._loss()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        if len(self._gradient):
            torch.cat([gradient.flatten() for gradient in self._gradients()], out=self._gradient)

    def _step(self) -> None:
        if len(self._gradient):
            gradients = self._gradients()
            parts = self._gradient.split([gradient.numel() for gradient in gradients])
            for gradient, part in zip(gradients, parts, strict=True):
                gradient.copy_(part.view_as(gradient))
        torch.nn.utils.clip_grad_norm_(self._module.parameters(), self._gradient_max)
        self.optimizer.step()

    def _gradients(self) -> list[torch.Tensor]:
        found = [parameter.grad for parameter in self._module.parameters()]
        return [gradient for gradient in found if gradient is not None]
