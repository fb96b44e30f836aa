"""Makes the vocabularies that ship with the package, from drives through simulated towns.

    python -m engram_lab.fits.vocabularies FOLDER
    python -m engram_lab.fits.vocabularies FOLDER --kinds net

Trains and writes the packages' own data. `brief` and `teblid` learn from drives: what FOLDER does
not hold yet is rendered (2,442 frames, half an hour on a core). `net` learns from the places that
its network was trained on, seen under every light (2,052 frames); so do its signatures. The towns
have seeds of their own: no evaluation shares a street with them.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

import engram.places
import engram_lab
from engram import _core
from engram.frontend.features import NET, NETWORK_BITS, feature_kind, plain_name
from engram.frontend.frame import BRIEF, DescriptorKind
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.places.recognisers import SHARE, members_of
from engram.places.vocabulary import TrainingConfig, encode_vocabulary, train_vocabulary
from engram_lab.eyes import training_scene
from engram_lab.teblid import TEBLID
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.session import SimulatedDrive

# Campaign, seed, sessions, metres between frames: places apart from each other, all conditions.
DRIVES = (
    ("village", 101, range(0, 24, 2), 7.0),
    ("keble", 102, (1, 6), 8.0),
    ("oxford", 103, (0, 5), 8.0),
)
TRAINED_ON = "simulated drives: village 101, keble 102, oxford 103; no real image"
TOWNS = (201, 202, 203, 204)
TRAINED_ON_PLACES = "places of simulated towns 201 to 204, 19 visits each; no real image"
# Two of them take 620 kB together.
CONFIG = TrainingConfig(words=5000, samples=80)
# Of signatures; and descriptors that they are found from. Chosen on towns 207 and 208.
_CENTRES, _DRAWN = 8, 60_000


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


def frames_of_places(kind: DescriptorKind) -> list[NDArray[np.uint8]]:
    """Descriptors of each place on each visit."""
    describe = feature_kind(kind).describe
    return [
        describe(np.ascontiguousarray(scene.left[key]), marks.pixels, marks.octaves)
        for scene in map(training_scene, TOWNS)
        for key, marks in scene.landmarks.items()
    ]


def signatures(frames: list[NDArray[np.uint8]], kind: DescriptorKind) -> bytes:
    """Centres of descriptors of the network, and how often their bits are set near each."""
    rows = np.concatenate(frames)[:, : NETWORK_BITS // 8]
    drawn = np.random.default_rng(0).choice(len(rows), _DRAWN, replace=False)
    rows = np.ascontiguousarray(rows[np.sort(drawn)])
    centres, nearest = _core.k_majority(rows, _CENTRES, CONFIG.iterations, CONFIG.seed)
    members = members_of(nearest, _CENTRES)
    # Sums of up to 60,000 ones: whole in single precision.
    found = members.astype(np.float32) @ np.unpackbits(rows, axis=1).astype(np.float32)
    shares = np.rint(SHARE * found.astype(np.float64) / members.sum(1)[:, None])
    return save(
        {
            "centres": centres.view(np.uint8),
            "shares": shares.astype(np.uint16),
            "model": np.frombuffer(kind.encode(), np.uint8),
        }
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="keeps the descriptors of the drives")
    parser.add_argument("--kinds", default="brief,teblid", help="joined by commas")
    asked = parser.parse_args()
    for name in asked.kinds.split(","):
        kind = feature_kind(name).name
        drives = kind in {BRIEF, TEBLID}
        frames = frames_of(render(asked.folder), kind) if drives else frames_of_places(kind)
        about = TRAINED_ON if drives else TRAINED_ON_PLACES
        vocabulary = train_vocabulary(frames, kind, CONFIG, trained_on=about)
        body = encode_vocabulary(vocabulary)
        package = engram_lab if kind == TEBLID else engram.places
        data = Path(*package.__path__) / "data"
        (data / f"{plain_name(kind)}.safetensors").write_bytes(body)
        print(f"{kind}: {len(vocabulary)} words, {len(body)} bytes")
        if kind == NET:
            file = data / f"{plain_name(kind)}.signature.safetensors"
            file.write_bytes(signatures(frames, kind))


if __name__ == "__main__":
    main()
