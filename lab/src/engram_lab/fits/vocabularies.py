"""Makes the vocabularies that ship with the package, from drives through simulated towns.

Run as ``python -m engram_lab.fits.vocabularies FOLDER``: renders what FOLDER does not hold yet
(2,442 frames, half an hour on a core), then trains and writes the package's own data. The towns
have seeds of their own: no campaign of an evaluation shares a street with them.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram import places
from engram.frontend import BRIEF, TEBLID, DescriptorKind, Frontend, FrontendConfig
from engram.places import TrainingConfig, encode_vocabulary, train_vocabulary
from engram_lab.town import SimulatedDrive, campaign_named

# Campaign, seed, sessions, metres between frames: places apart from each other, all conditions.
DRIVES = (
    ("village", 101, range(0, 24, 2), 7.0),
    ("keble", 102, (1, 6), 8.0),
    ("oxford", 103, (0, 5), 8.0),
)
TRAINED_ON = "simulated drives: village 101, keble 102, oxford 103; no real image"
# Two of them take 620 kB together.
CONFIG = TrainingConfig(words=5000, samples=80)


def render(folder: Path) -> list[Path]:
    """One file per session, with the descriptors of both kinds."""
    frontends = {kind: Frontend(FrontendConfig(descriptor=kind)) for kind in (BRIEF, TEBLID)}
    files = []
    for name, seed, sessions, spacing_m in DRIVES:
        campaign = dataclasses.replace(campaign_named(name, seed), spacing_m=spacing_m)
        for session in sessions:
            file = folder / f"{name}-{seed}-{session:03d}.npz"
            files.append(file)
            if file.exists():
                continue
            arrays: dict[str, Any] = {}
            pairs = list(SimulatedDrive(campaign, session))
            for kind, frontend in frontends.items():
                found = [frontend.extract(pair).landmarks.descriptors for pair in pairs]
                arrays[str(kind)] = np.concatenate(found)
                arrays[f"{kind}_n"] = np.array([len(frame) for frame in found])
            np.savez(file, **arrays)
            print(file.name, len(pairs), flush=True)
    return files


def frames_of(files: list[Path], kind: DescriptorKind) -> list[NDArray[np.uint8]]:
    """Descriptors of each frame."""
    frames: list[NDArray[np.uint8]] = []
    for file in files:
        arrays = np.load(file)
        frames += np.split(arrays[str(kind)], np.cumsum(arrays[f"{kind}_n"])[:-1])
    return frames


def main() -> None:
    files = render(Path(sys.argv[1]))
    data = Path(places.__file__).parent / "data"
    for kind in (BRIEF, TEBLID):
        vocabulary = train_vocabulary(frames_of(files, kind), kind, CONFIG, trained_on=TRAINED_ON)
        body = encode_vocabulary(vocabulary)
        (data / f"{kind}.safetensors").write_bytes(body)
        print(f"{kind}: {len(vocabulary)} words, {len(body)} bytes")


if __name__ == "__main__":
    main()
