"""Dense prediction from events: a U-Net with memory that reads voxels.

References: Hidalgo-Carrio, Gehrig, Scaramuzza (2020), Learning Monocular Dense Depth from Events, for the
recurrent U-Net; Ballas, Yao, Pal, Courville (2016), for the convolutional GRU.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from neurosim_core.learn import need

_STEP = 8
"""Heights and widths are filled up to multiples of this: the network halves them three times."""

Memory = tuple[Tensor, ...]


class ConvGru(nn.Module):
    """A gated recurrent unit whose products are convolutions."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gates = nn.Conv2d(2 * channels, 2 * channels, 3, padding=1)
        self.candidate = nn.Conv2d(2 * channels, channels, 3, padding=1)

    def forward(self, x: Tensor, memory: Tensor) -> Tensor:
        """Return the memory after an input, both of shape [B, C, H, W]."""
        reset, update = torch.sigmoid(self.gates(torch.cat([x, memory], 1))).chunk(2, 1)
        candidate = torch.tanh(self.candidate(torch.cat([x, reset * memory], 1)))
        return torch.lerp(memory, candidate, update)


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1), nn.GroupNorm(4, outputs), nn.SiLU())


class DenseNet(nn.Module):
    """Predicts some numbers of each pixel from voxels of events, window after window.

    Args:
        start: What it predicts at first, one number for each output.
        bins: Channels of a voxel.
        channels: Of the finest level; coarser ones have 2, 4 and 4 times as many.
    """

    def __init__(self, start: tuple[float, ...], bins: int = 5, channels: int = 16) -> None:
        super().__init__()
        self.bins, self.channels = bins, channels
        c = channels
        sizes = (c, 2 * c, 4 * c, 4 * c)
        self.head = _block(bins, c)
        self.down = nn.ModuleList(_block(a, b, 2) for a, b in itertools.pairwise(sizes))
        self.memories = nn.ModuleList(ConvGru(size) for size in sizes[1:])
        self.up = nn.ModuleList(_block(a + b, b) for a, b in zip(sizes[:0:-1], sizes[-2::-1], strict=True))
        self.out = nn.Conv2d(c, len(start), 1)
        nn.init.zeros_(self.out.weight)
        self.out.bias = nn.Parameter(torch.tensor(start))

    def forward(self, voxel: Tensor, memory: Memory | None = None) -> tuple[Tensor, Memory]:
        """Return the prediction, shape [B, outputs, H, W], and the memory after the window.

        Args:
            voxel: Of a window, shape [B, bins, H, W].
            memory: After the window before; None: there is none.
        """
        height, width = voxel.shape[-2:]
        x = torch.sign(voxel) * torch.log1p(voxel.abs())  # pixels with many events do not drown the others
        x = functional.pad(x, (0, -width % _STEP, 0, -height % _STEP))
        levels = [self.head(x)]
        kept = []
        for index, (down, unit) in enumerate(zip(self.down, self.memories, strict=True)):
            x = down(levels[-1])
            kept.append(unit(x, torch.zeros_like(x) if memory is None else memory[index]))
            levels.append(kept[-1])
        x = levels.pop()
        for up in self.up:
            x = up(torch.cat([functional.interpolate(x, scale_factor=2.0), levels.pop()], 1))
        return self.out(x)[..., :height, :width], tuple(kept)

    def take_backbone(self, file: Path) -> None:
        """Take all weights but those of the last layer from another network of this shape, whatever its head.

        Args:
            file: What training left (`.pt`), any state_dict of PyTorch, or an ONNX file whose initialisers
                have the names of the weights, as `torch.onnx.export` leaves them.

        Raises:
            ValueError: It does not have all of them, in their shapes.
        """
        if file.suffix == ".onnx":
            onnx = need("onnx")
            graph = onnx.load(str(file)).graph
            found = {
                i.name: torch.from_numpy(onnx.numpy_helper.to_array(i).copy()) for i in graph.initializer
            }
        else:
            saved = torch.load(file, map_location="cpu", weights_only=True)
            found = saved.get("net", saved)
        own = {name: value for name, value in self.state_dict().items() if not name.startswith("out.")}
        missing = [
            name for name, value in own.items() if name not in found or found[name].shape != value.shape
        ]
        if missing:
            raise ValueError(
                f"{file} is no backbone of {self.bins} bins and {self.channels} channels: {len(missing)} of "
                f"{len(own)} weights are missing or of another shape, the first is {missing[0]}"
            )
        self.load_state_dict({name: found[name] for name in own}, strict=False)
