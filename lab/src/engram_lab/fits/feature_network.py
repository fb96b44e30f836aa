"""The patch network of the feature kind `net`, as it is trained: PyTorch, floating point.

A patch of 48×48 px around a corner, at its octave, is halved and normalised; three convolutions of
stride 2 and one linear layer follow; the signs of the outputs are the descriptor.
`engram_lab.fits.feature_weights` turns it into the integers that the core computes with.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

CHANNELS = (16, 32, 48)
BITS = 192
_MARGIN = 8  # of the 64 px patches that training cuts, the network sees the inner 48
_FLOOR = 2.0  # grey levels added to a patch's σ: below it there is only noise


class PatchNetwork(nn.Module):  # type: ignore[misc]
    """(N, 64, 64) grey patches → (N, BITS) outputs whose signs are the descriptor."""

    def __init__(self, channels: tuple[int, int, int] = CHANNELS, bits: int = BITS) -> None:
        super().__init__()
        sides = (5, 3, 3)
        inputs = (1, *channels[:2])
        self.convolutions = nn.ModuleList(
            nn.Conv2d(before, after, side, stride=2, padding=side // 2, bias=False)
            for before, after, side in zip(inputs, channels, sides, strict=True)
        )
        self.norms = nn.ModuleList(nn.BatchNorm2d(count) for count in channels)
        self.linear = nn.Linear(9 * channels[2], bits, bias=False)
        self.norm = nn.BatchNorm1d(bits)

    def forward(self, patches: Tensor) -> Tensor:
        """See the class."""
        layer = normalised(patches)
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            layer = functional.relu(norm(convolution(layer)))
        outputs: Tensor = self.norm(self.linear(layer.flatten(1)))
        return outputs


def normalised(patches: Tensor) -> Tensor:
    """(N, 64, 64) uint8 → (N, 1, 24, 24): halved, less their mean, over their σ."""
    inner = patches[:, None, _MARGIN:-_MARGIN, _MARGIN:-_MARGIN].float()
    small = functional.avg_pool2d(inner, 2)
    mean, sigma = small.mean((2, 3), keepdim=True), small.std((2, 3), keepdim=True)
    return (small - mean) / (sigma + _FLOOR)


class Sign(torch.autograd.Function):  # type: ignore[misc]
    """The sign of a number, with the gradient of its hyperbolic tangent."""

    @staticmethod
    def forward(ctx: Any, outputs: Tensor) -> Tensor:
        ctx.save_for_backward(outputs)
        return torch.where(outputs > 0, 1.0, -1.0)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (outputs,) = ctx.saved_tensors
        return gradients[0] * (1 - torch.tanh(outputs) ** 2)
