"""The kind of features `net`: descriptors by a small network, with some of BRIEF's bits.

A patch of 48×48 px around each corner goes through three convolutions and a linear layer in 8-bit
integers, whose signs are 192 bits. Light, season and weather change them far less than BRIEF; rain
and small rooms favour BRIEF, of which 64 bits are added.
"""

from __future__ import annotations

import hashlib
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load

from engram import _core
from engram.errors import IncompatibleError

if TYPE_CHECKING:
    from collections.abc import Mapping

# The first eight hexadecimal digits of the SHA-256 of its weights. Part of the kind's name in maps
# and frame logs, so that descriptors of two models never meet.
MODEL = "595cbcd3"
NETWORK_BITS, BRIEF_BITS = 192, 64

_FILE = "net.safetensors"
_ARRAYS = (
    "first",
    "second",
    "third",
    "linear",
    "first_scaling",
    "second_scaling",
    "third_scaling",
    "thresholds",
    "shifts",
)


def weights() -> Mapping[str, NDArray[Any]]:
    """The arrays of `engram._core.PatchNetwork`, by the names of its arguments.

    Four (out, side, side, in) int8 layers of weights; the rest int32, (n,) factors and limits.

    Raises:
        IncompatibleError: the installed file is not the model that this version names.
    """
    body = (resources.files("engram.frontend") / "data" / _FILE).read_bytes()
    found = hashlib.sha256(body).hexdigest()[: len(MODEL)]
    if found != MODEL:
        raise IncompatibleError(
            f"the installed weights {_FILE} are model {found}, must be {MODEL}; "
            "install Engram again"
        )
    arrays: Mapping[str, NDArray[Any]] = load(body)
    return arrays


@cache
def network() -> _core.PatchNetwork:
    """The network, read once."""
    arrays = weights()
    return _core.PatchNetwork(**{name: arrays[name] for name in _ARRAYS})


def beside_brief(
    image: NDArray[np.uint8],
    pixels: NDArray[np.float32],
    octaves: NDArray[np.uint8],
    brief: NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """The network's bits and the first of BRIEF's: descriptors (N, 32) uint8.

    Args:
        image: (h, w) uint8 grey.
        pixels: (N, 2) float32 u, v, px.
        octaves: (N,) uint8.
        brief: (N, 32) uint8, BRIEF-256 of the same points.
    """
    found = network().describe(image, pixels, octaves)
    return np.concatenate([found, brief[:, : BRIEF_BITS // 8]], axis=1)
