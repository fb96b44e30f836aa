"""Trains the network of the feature kind `net` and writes the package's own weights.

    python -m engram_lab.fits.features OUT

Renders what the cache does not hold yet, trains on one core, and writes OUT/SEED.pt. A run that was
stopped goes on at its last checkpoint; OUT/SEED.csv tells how far it is. With --ship it then rounds
the weights to integers and puts them into the package. Nothing that it sees is judged by
`engram_lab.checks.eyes`: the towns are others, and so are hours, dates and the real frames.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import os
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import save
from torch import Tensor, nn
from torch.nn import functional

import engram.frontend.features
from engram.cli.screen import Bars
from engram.frontend.frame import Landmarks
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.monitor import Monitor, write_whole
from engram_lab.eyes import DARK, WET, Patches, Scene, clip, same_corners, training_scene

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


# Image pairs a step, corners and further corners (rivals only) of each.
_PAIRS, _CORNERS, _RIVALS = 5, 96, 48
# Share of pairs from rows that are rare: wet or dark visits.
_RARE = 0.35
# Places apart of two views; of real frames.
_STEPS, _REAL_STEPS = (0, 0, 0, 0, 0, 0, 0, 0, 0, 1), (1, 2, 3, 4, 5, 6, 8, 10)
_FEWEST, _FEWEST_RARE = 15, 8
# Share of patches that are turned, stretched and moved; of those with more noise; of blurred ones.
_WARPED, _NOISY, _BLURRED = 0.35, 0.25, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One image of a source, with its landmarks, pose and camera."""

    image: NDArray[np.uint8]
    landmarks: Landmarks
    world_from_cam: NDArray[np.float64]
    camera: StereoCamera


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Views (visit, place) of one street."""

    views: dict[tuple[int, int], View]
    steps: tuple[int, ...]
    rare: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """Number of visits and of places."""
        visit, place = max(self.views)
        return visit + 1, place + 1


def rendered(scene: Scene) -> Source:
    """A rendered town as a source."""
    views = {
        key: View(scene.left[key], marks, scene.world_from_cam[key], scene.camera)
        for key, marks in scene.landmarks.items()
    }
    every = tuple(range(len(scene.visits)))
    return Source(views, _STEPS, ((WET, every), (DARK, every), (WET, WET), (DARK, DARK)))


def real_drive(folder: Path, frames: int) -> Source:
    """The first frames of a KITTI raw drive: grey rig and the three channels of the colour rig."""
    frontend = Frontend(FrontendConfig(thumbnails=False))
    rigs = [clip(folder)[:frames]]
    rigs += [
        clip(folder, rig="colour", channel=channel)[:frames] for channel in ("red", "green", "blue")
    ]
    grey = [frontend.extract(pair) for pair in rigs[0]]
    poses = [SE3.identity()]
    for before, after in pairwise(grey):
        step = match_frames(before, after, MatcherConfig(), 7).reference_from_live
        if step is None:
            raise SystemExit(f"{folder}: two neighbouring frames do not match")
        poses.append(poses[-1] @ step)
    # Camera 2 stands left of camera 0 (calib_cam_to_cam.txt of the drive's day).
    grey_from_colour = SE3(np.eye(3), np.array([-0.0598, 0.0004, -0.0027]))
    views = {}
    for visit, pairs in enumerate(rigs):
        for place, pair in enumerate(pairs):
            pose = poses[place] @ grey_from_colour if visit else poses[place]
            marks = (frontend.extract(pair) if visit else grey[place]).landmarks
            views[visit, place] = View(pair.left, marks, pose.matrix(), pair.camera)
    return Source(views, _REAL_STEPS)


@dataclass(slots=True, eq=False)
class Batch:
    """Corners of one side of some image pairs.

    Attributes:
        patches: (N, 64, 64) uint8.
        pixels: (N, 3) float32: u, v, px, and the pair, so far apart that pairs never come near.
        same: (N,) bool: whether its row on the other side shows the same corner; the k-th of these
            belongs to the k-th there. Others are rivals only.
    """

    patches: NDArray[np.uint8]
    pixels: NDArray[np.float32]
    same: NDArray[np.bool_]


class Drawer:
    """Draws batches; everything follows from the state of its generator."""

    def __init__(
        self, towns: Sequence[Source], real: Sequence[Source], real_share: float,
        draws: np.random.Generator,
    ) -> None:  # fmt: skip
        self._towns, self._real = towns, real
        self._real_share = real_share if real else 0.0
        self.draws = draws

    def batch(self) -> tuple[Batch, Batch]:
        """Both sides of some image pairs, distorted."""
        sides: tuple[list[Batch], list[Batch]] = ([], [])
        for number in range(_PAIRS):
            views, rows = self._pair()
            for side, view, own in zip(sides, views, rows.T, strict=True):
                side.append(self._cut(view, own, number))
        left, right = (_joined(side) for side in sides)
        self._distort(left.patches, _WARPED)
        self._distort(right.patches, 0.3 * _WARPED)
        return left, right

    def _pair(self) -> tuple[tuple[View, View], NDArray[np.int64]]:
        real = self.draws.random() < self._real_share
        while True:
            sources = self._real if real else self._towns
            source = sources[int(self.draws.integers(len(sources)))]
            rare = bool(source.rare) and self.draws.random() < _RARE
            keys = self._keys(source, rare=rare)
            if keys is None:
                continue
            a, b = (source.views[key] for key in keys)
            b_from_a = np.linalg.inv(b.world_from_cam) @ a.world_from_cam
            rows = same_corners(a.landmarks, b.landmarks, b_from_a, b.camera)
            if len(rows) >= (_FEWEST_RARE if source.rare else _FEWEST):
                if len(rows) > _CORNERS:
                    rows = rows[self.draws.choice(len(rows), _CORNERS, replace=False)]
                return (a, b), rows

    def _keys(
        self, source: Source, *, rare: bool
    ) -> tuple[tuple[int, int], tuple[int, int]] | None:
        visits, places = source.shape
        v, w = (int(each) for each in self.draws.choice(visits, 2, replace=False))
        if rare:
            groups = source.rare[int(self.draws.integers(len(source.rare)))]
            v, w = (int(self.draws.choice(group)) for group in groups)
        place = int(self.draws.integers(places))
        other = place + int(self.draws.choice(source.steps)) * int(self.draws.choice((-1, 1)))
        if v == w or not 0 <= other < places:
            return None
        return (v, place), (w, other)

    def _cut(self, view: View, rows: NDArray[np.int64], number: int) -> Batch:
        marks = view.landmarks
        others = np.setdiff1d(np.arange(len(marks)), rows)
        others = self.draws.choice(others, min(_RIVALS, len(others)), replace=False)
        every = np.concatenate([rows, others])
        patches = Patches(view.image).around(marks.pixels[every], marks.octaves[every])
        pixels = np.column_stack([marks.pixels[every], np.full(len(every), 1e5 * number)])
        return Batch(patches, pixels.astype(np.float32), np.arange(len(every)) < len(rows))

    def _distort(self, patches: NDArray[np.uint8], warped: float) -> None:
        """In place: viewpoint, noise and blur."""
        draws, count = self.draws, len(patches)
        for row in np.flatnonzero(draws.random(count) < warped):
            scale, turn = np.exp(draws.uniform(-0.28, 0.28)), np.radians(draws.normal(0, 8))
            c, s = scale * np.cos(turn), scale * np.sin(turn)
            u, v = draws.normal(0, 0.7, 2)
            matrix = np.array([[c, -s, 32 * (1 - c + s) + u], [s, c, 32 * (1 - s - c) + v]])
            patches[row] = cv2.warpAffine(
                patches[row], matrix, (64, 64), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            )  # fmt: skip
        for row in np.flatnonzero(draws.random(count) < _BLURRED):
            patches[row] = cv2.GaussianBlur(patches[row], (0, 0), draws.uniform(0.6, 2.0))
        noisy = np.flatnonzero(draws.random(count) < _NOISY)
        sigma = draws.uniform(0.5, 4, (len(noisy), 1, 1)).astype(np.float32)
        noise = draws.standard_normal((len(noisy), 64, 64), dtype=np.float32) * sigma
        patches[noisy] = np.clip(patches[noisy] + noise + 0.5, 0, 255).astype(np.uint8)


def _joined(parts: Sequence[Batch]) -> Batch:
    return Batch(
        np.concatenate([part.patches for part in parts]),
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.same for part in parts]),
    )


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


TOWNS = tuple((seed, "wildcat") for seed in range(201, 205))
# The rest of the clip judges the two rigs against each other.
REAL_DRIVE, REAL_FRAMES = "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync", 27
_REAL_SHARE = 0.2
_LEARNING_RATE, _WARM_UP = 3e-3, 200
# Weight of a bit's agreement in the softmax over rivals; of the loss on unrounded outputs.
_SHARPNESS, _SOFT = 13.0, 0.5
# Rivals nearer than this may be the same corner.
_NEAR_PX = 8.0
_EVERY = 250


class Training:
    """A run: network, optimiser, generators and step, all of them in its checkpoint."""

    def __init__(self, drawer: Drawer, steps: int, seed: int) -> None:
        torch.manual_seed(seed)
        # Channels last and 16-bit products: twice as fast on one core.
        self.network = PatchNetwork().to(memory_format=torch.channels_last)
        self.drawer, self.steps, self.step = drawer, steps, 0
        self._optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=_LEARNING_RATE, weight_decay=1e-4
        )

    def advance(self) -> tuple[float, float]:
        """One step; the loss, and the share of corners whose nearest descriptor is right."""
        for group in self._optimiser.param_groups:
            group["lr"] = self._rate()
        a, b = self.drawer.batch()
        patches = torch.from_numpy(np.concatenate([a.patches, b.patches]))
        with torch.autocast("cpu", torch.bfloat16):
            outputs = self.network(patches).float()
        ours, theirs = outputs[: len(a.same)], outputs[len(a.same) :]
        loss = contrast(Sign.apply, ours, theirs, a, b) + _SOFT * contrast(
            torch.tanh, ours, theirs, a, b
        )
        self._optimiser.zero_grad()
        loss.backward()
        self._optimiser.step()
        self.step += 1
        return loss.item(), right_share(ours, theirs, a, b)

    def save(self, file: Path) -> None:
        """Writes a checkpoint, whole."""
        with write_whole(file) as draft:
            torch.save(
                {
                    "network": self.network.state_dict(),
                    "optimiser": self._optimiser.state_dict(),
                    "draws": self.drawer.draws.bit_generator.state,
                    "step": self.step,
                },
                draft,
            )

    def load(self, file: Path) -> None:
        """Continues from a checkpoint."""
        kept = torch.load(file, weights_only=True)
        self.network.load_state_dict(kept["network"])
        self._optimiser.load_state_dict(kept["optimiser"])
        self.drawer.draws.bit_generator.state = kept["draws"]
        self.step = kept["step"]

    def _rate(self) -> float:
        """Warm-up, then half a cosine."""
        warm = min(1.0, (self.step + 1) / _WARM_UP)
        fall = 0.5 * (1 + np.cos(np.pi * self.step / self.steps)) + 0.01
        return float(_LEARNING_RATE * warm * fall)


def contrast(code: Any, ours: Tensor, theirs: Tensor, a: Batch, b: Batch) -> Tensor:
    """InfoNCE in both directions: a corner's descriptor is to be the nearest among all rivals'."""
    agreement = code(ours) @ code(theirs).T * (_SHARPNESS / BITS)
    rows, columns = (torch.from_numpy(np.flatnonzero(side.same)) for side in (a, b))
    return _side(agreement, rows, columns, b) + _side(agreement.T, columns, rows, a)


def _side(agreement: Tensor, rows: Tensor, columns: Tensor, rivals: Batch) -> Tensor:
    pixels = torch.from_numpy(rivals.pixels)
    near = (pixels[columns][:, None] - pixels[None]).abs().amax(2) < _NEAR_PX
    near[torch.arange(len(rows)), columns] = False
    return functional.cross_entropy(agreement[rows].masked_fill(near, -1e4), columns)


def right_share(ours: Tensor, theirs: Tensor, a: Batch, b: Batch) -> float:
    """Share of corners of `a` whose nearest descriptor of `b` lies on their own corner."""
    with torch.no_grad():
        agreement = torch.sign(ours[torch.from_numpy(a.same)]) @ torch.sign(theirs).T
    nearest = agreement.argmax(1).numpy()
    away_px = np.abs(b.pixels[nearest] - b.pixels[b.same]).max(1)
    return float((away_px < _NEAR_PX).mean())


def sources(monitor: Monitor) -> tuple[list[Source], list[Source]]:
    """Rendered and real sources; the real ones only where ENGRAM_DATA names the images."""
    towns = [rendered(training_scene(seed, robot, monitor)) for seed, robot in TOWNS]
    data = os.environ.get("ENGRAM_DATA")
    return towns, [real_drive(Path(data) / REAL_DRIVE, REAL_FRAMES)] if data else []


def train(
    out: Path, seed: int, steps: int, given: tuple[list[Source], list[Source]], monitor: Monitor
) -> PatchNetwork:
    """Trains on rendered and real sources, or continues training, and returns the network."""
    out.mkdir(parents=True, exist_ok=True)
    drawer = Drawer(*given, _REAL_SHARE, np.random.default_rng(seed))
    training, file = Training(drawer, steps, seed), out / f"{seed}.pt"
    if file.exists():
        training.load(file)
    recent: list[tuple[float, float]] = []
    began, first = time.monotonic(), training.step
    with monitor.stage("training", steps - first) as part:
        while training.step < steps:
            recent.append(training.advance())
            part.advance()
            if training.step % _EVERY == 0 or training.step == steps:
                training.save(file)
                rate_s = (time.monotonic() - began) / (training.step - first)
                _note(out / f"{seed}.csv", training.step, recent, rate_s)
                recent = []
    training.network.eval()
    network: PatchNetwork = training.network
    return network


def _note(file: Path, step: int, recent: list[tuple[float, float]], rate_s: float) -> None:
    loss, right = np.mean(recent, axis=0)
    with file.open("a", newline="") as rows:
        csv.writer(rows).writerow([step, f"{loss:.3f}", f"{100 * right:.1f}", f"{rate_s:.3f}"])


def ship(network: PatchNetwork, towns: list[Source], about: dict[str, str]) -> str:
    """Writes the package's weights and the model that it names; returns that model."""
    folder = Path(engram.frontend.features.__file__).parent
    views = [town.views[visit, 5] for town in towns[:1] for visit in (0, 5, 8, 10, 14)]
    patches = np.concatenate(
        [Patches(one.image).around(one.landmarks.pixels, one.landmarks.octaves) for one in views]
    )
    body, model = weights_file(integer_weights(network, patches), about)
    (folder / "data" / "net.safetensors").write_bytes(body)
    code = folder / "features.py"
    text = re.sub(r'(?m)^MODEL = ".*"$', f'MODEL = "{model}"', code.read_text(encoding="utf-8"))
    code.write_text(text, encoding="utf-8")
    return model


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="folder for checkpoints and progress")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--steps", type=int, default=2500, help="five minutes of one core")
    parser.add_argument("--ship", action="store_true", help="replace the package's weights")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    towns, real = sources(Bars())
    network = train(asked.out, asked.seed, asked.steps, (towns, real), Bars())
    if asked.ship:
        seen = [f"{name} {seed}" for seed, name in TOWNS] + ([REAL_DRIVE] if real else [])
        about = {"seed": str(asked.seed), "steps": str(asked.steps), "trained_on": ", ".join(seen)}
        print(ship(network, towns, about))


if __name__ == "__main__":
    main()
