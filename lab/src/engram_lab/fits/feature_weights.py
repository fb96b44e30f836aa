"""Rounds a trained patch network to the integers that the core computes with.

Weights take 8 bits, each output channel by a scale of its own; what a layer gives to the next one
takes 8 bits, its range being that of nearly all values on training patches.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import save
from torch.nn import functional

from engram_lab.fits.feature_network import PatchNetwork, normalised

# Units of the network's input to one standard deviation of a patch (`patch_network.cpp`).
_INPUT_UNITS = 24.0
_INPUT_ZERO = 128
# Share of values that a layer's 8 bits reach.
_REACHED = 0.9995

Floats = NDArray[np.float64]
Arrays = dict[str, NDArray[np.generic]]


def integer_weights(network: PatchNetwork, patches: NDArray[np.uint8]) -> Arrays:
    """The arrays of `engram._core.PatchNetwork`, by the names of its arguments.

    Args:
        network: trained, in evaluation mode.
        patches: (N, 64, 64) uint8, on which the ranges of the layers are measured.
    """
    folded = [
        _folded(layer.weight, norm)
        for layer, norm in zip(network.convolutions, network.norms, strict=True)
    ]
    units = [_INPUT_UNITS, *(255 / largest for largest in _ranges(folded, patches))]
    arrays: Arrays = {}
    shifts = []
    for layer, (name, (weights, bias)) in enumerate(zip(_NAMES, folded, strict=True)):
        whole, scale = _rounded(weights)
        # (outputs, inputs, rows, columns) → (outputs, rows, columns, inputs)
        arrays[name] = np.ascontiguousarray(whole.transpose(0, 2, 3, 1))
        gain = units[layer + 1] / (units[layer] * scale)
        zero = _INPUT_ZERO * whole.sum((1, 2, 3), dtype=np.int64) if layer == 0 else 0
        scaling, drop, shift = _scaling(gain, bias * units[layer] * scale - zero)
        arrays[f"{name}_scaling"] = scaling
        shifts.append((drop, shift))
    weights, bias = _folded(network.linear.weight, network.norm)
    whole, scale = _rounded(weights)
    outputs, channels = len(whole), network.convolutions[-1].weight.shape[0]
    cells = whole.reshape(outputs, channels, 3, 3).transpose(0, 2, 3, 1)
    arrays["linear"] = np.ascontiguousarray(cells)
    arrays["thresholds"] = np.floor(-bias * units[-1] * scale).astype(np.int32)
    arrays["shifts"] = np.array(shifts, np.int32)
    return arrays


_NAMES = ("first", "second", "third")


def weights_file(arrays: Arrays, about: Mapping[str, str]) -> tuple[bytes, str]:
    """The file of weights, and the eight hexadecimal digits that name the model."""
    body = save(arrays, metadata=dict(about))
    return body, hashlib.sha256(body).hexdigest()[:8]


def _folded(weight: Any, norm: Any) -> tuple[Floats, Floats]:
    """Weights and bias of a layer together with the normalisation behind it."""
    values = {name: tensor.detach().double().numpy() for name, tensor in norm.state_dict().items()}
    gain = values["weight"] / np.sqrt(values["running_var"] + 1e-5)
    weights = weight.detach().double().numpy()
    return (
        weights * gain.reshape(-1, *[1] * (weights.ndim - 1)),
        values["bias"] - values["running_mean"] * gain,
    )


def _ranges(folded: list[tuple[Floats, Floats]], patches: NDArray[np.uint8]) -> list[float]:
    """The largest values that matter of each convolution's outputs."""
    ranges = []
    with torch.inference_mode():
        layer = normalised(torch.from_numpy(patches))
        for weights, bias in folded:
            kernel, offset = (torch.from_numpy(each).float() for each in (weights, bias))
            layer = functional.conv2d(layer, kernel, offset, 2, weights.shape[2] // 2).relu()
            ranges.append(float(np.quantile(layer.numpy().ravel()[::7], _REACHED)))
    return ranges


def _rounded(weights: Floats) -> tuple[NDArray[np.int8], Floats]:
    """Weights in −127 … 127 and the (outputs,) units to one."""
    scale = 127 / np.abs(weights.reshape(len(weights), -1)).max(1)
    return np.rint(weights * scale.reshape(-1, *[1] * (weights.ndim - 1))).astype(np.int8), scale


def _scaling(gain: Floats, bias: Floats) -> tuple[NDArray[np.int32], int, int]:
    """Rows of bias and factor, and the two shifts that go with them (`PatchScaling`)."""
    drop = max(0, int(np.ceil(np.log2((256 / gain).max()))) - 15)
    shift = int(np.floor(np.log2(32766 / (gain * 2.0**drop).max())))
    factor = np.rint(gain * 2.0 ** (drop + shift))
    return np.column_stack([np.rint(bias), factor]).astype(np.int32), drop, shift
