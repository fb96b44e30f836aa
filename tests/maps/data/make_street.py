"""Writes `street-7.engram`, `street-3.framelog` and `frozen.json`: what later versions must read.

    python -m tests.maps.data.make_street tests/maps/data

It was run for 0.2.0. To run it again would make the promise a new one.

The drive is a rendered street: its even pairs are mapped, its odd ones recorded and localised.
"""

from __future__ import annotations

import hashlib
import json
import socket
import sys
import tempfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from tests.builders import write_street

from engram.config import from_dict
from engram.frontend.frame import Frame, Landmarks
from engram.localiser.localisation import Localisation
from engram.maps.map import Map, open_map
from engram.maps.place_blocks import BODY, NUMBERS, UNREADABLE
from engram.places.vocabulary import TrainingConfig
from engram.robot.mapping import extract_log, map_drive
from engram.robot.settings import Settings
from engram.robot.vocabularies import train_map_vocabulary
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.opening import open_drive
from engram.sequences.sequence import LoggedFrame

# The map with a row of every kind is of `make_map`.
ALL_KINDS = "format-7.engram"
MAP, LOG, FROZEN = "street-7.engram", "street-3.framelog", "frozen.json"
# Few landmarks, for small files.
SETTINGS = from_dict({"frontend": {"landmarks": 200}, "mapper": {"landmarks": 0}}, Settings)
# A block of places, which maps get from 8,192 nodes on.
VOCABULARY, RECOGNISER = bytes(16), "signature"
BLOCK = {NUMBERS: b"", UNREADABLE: np.array([3, 8191], "<i4").tobytes(), BODY: bytes(range(9))}


def write_both(folder: Path) -> None:
    """The map and the log."""
    with tempfile.TemporaryDirectory() as scratch:
        street = write_street(Path(scratch) / "street", frames=6)
        map_drive(folder / MAP, open_drive(street, frames="0::2", robot="r1"), SETTINGS)
        train_map_vocabulary(folder / MAP, [], TrainingConfig(words=20, samples=2), author="tests")
        with Map.open(folder / MAP, writes=True) as store:
            store.put_place_block(VOCABULARY, RECOGNISER, 0, BLOCK)
        (folder / f"{MAP}-lock").unlink()
        extract_log(open_drive(street, frames="1::2", robot="r2"), folder / LOG, SETTINGS)


def frozen(folder: Path) -> dict[str, Any]:
    """What must stay: digests of every record and frame, and where the log is in the map."""
    return {
        "maps": {name: digests_of_map(folder / name) for name in (ALL_KINDS, MAP)},
        "frames": [digest_of(one) for one in FrameLog(folder / LOG)],
        "localised": [shown(one) for one in localised(folder)],
    }


def digests_of_map(path: Path) -> dict[str, str]:
    """Of the content, of each table's rows, of all nodes' frames and places."""
    with open_map(path) as stored:
        frames, places = hashlib.sha256(), hashlib.sha256()
        nodes = sorted(one.id for one in stored.load().nodes)
        for node in nodes:
            _add_landmarks(frames, stored.frames.frame(node))
            frames.update(np.ascontiguousarray(stored.frames.thumbnail(node)).tobytes())
        for node, place in sorted(stored.read_placements().items()):
            places.update(node.bytes + place.matrix().tobytes())
        return {
            "content": stored.content_hash(),
            **stored.record_hashes(),
            "frames": frames.hexdigest(),
            "placements": places.hexdigest(),
        }


def localised(folder: Path) -> list[Localisation]:
    """The log in the map."""
    log = FrameLog(folder / LOG)
    with open_map(folder / MAP) as street, street.robot(log.camera, SETTINGS) as robot:
        return [robot.step(one) for one in log]


def shown(found: Localisation) -> dict[str, Any]:
    """A result as it is kept: the pose as its logarithm, translation first."""
    pose = found.node_from_live
    tangent = None if pose is None else pose.log().round(6).tolist()
    return {"status": found.status.value, "node": str(found.node), "node_from_live": tangent}


def digest_of(logged: LoggedFrame) -> str:
    """SHA-256 of a frame's landmarks and of its motion."""
    found, motion = hashlib.sha256(), logged.odometry
    _add_landmarks(found, logged.frame)
    found.update(str((logged.frame.stamp_ns, motion.status.value, motion.inliers)).encode())
    if motion.prev_from_curr is not None and motion.covariance is not None:
        found.update(motion.prev_from_curr.matrix().tobytes() + motion.covariance.tobytes())
    return found.hexdigest()


def _add_landmarks(digest: hashlib._Hash, frame: Frame) -> None:
    for one in fields(Landmarks):
        digest.update(getattr(frame.landmarks, one.name).tobytes())


if __name__ == "__main__":
    socket.gethostname = lambda: "example"
    out = Path(sys.argv[1])
    write_both(out)
    (out / FROZEN).write_text(json.dumps(frozen(out), indent=1) + "\n")
