"""Trains the network of the feature kind `net` and writes the package's own weights.

    python -m engram_lab.fits.train_features OUT

Renders what the cache does not hold yet, trains on one core, and writes OUT/SEED.pt. A run that was
stopped goes on at its last checkpoint; OUT/SEED.csv tells how far it is. With --ship it then rounds
the weights to integers and puts them into the package. Nothing that it sees is judged by
`engram_lab.checks.eyes`: the towns are others, and so are hours, dates and the real frames.
"""

from __future__ import annotations

import argparse
import csv
import os
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

import engram.frontend.features
from engram.cli.screen import Bars
from engram.monitor import Monitor, write_whole
from engram_lab.eyes import Patches, training_scene
from engram_lab.fits.feature_network import BITS, PatchNetwork, Sign
from engram_lab.fits.feature_pairs import Batch, Drawer, Source, real_drive, rendered
from engram_lab.fits.feature_weights import integer_weights, weights_file

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
