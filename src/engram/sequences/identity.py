"""Who a drive is: the same drive read twice is the same session (SPEC §2.7)."""

from __future__ import annotations

import hashlib

import numpy as np

from engram.frontend import StereoPair
from engram.geometry import StereoCamera
from engram.graph.model import Session, session_id
from engram.sequences.sequence import SequenceInfo

# The robot of a drive whose source and caller name none.
UNNAMED_ROBOT = "robot"


def first_pair_hash(pair: StereoPair) -> str:
    """32 hexadecimal digits of a pair's pixels, part of a session's identity (SPEC §2.7)."""
    digest = hashlib.sha256(f"{pair.left.shape}{pair.right.shape}".encode())
    digest.update(np.ascontiguousarray(pair.left).data)
    digest.update(np.ascontiguousarray(pair.right).data)
    return digest.hexdigest()[:32]


def session_of(
    info: SequenceInfo, camera: StereoCamera, start_ns: int, first_pair_hash: str
) -> Session:
    """The session of a drive, equal whenever the same frames of it are read.

    Args:
        info: what is known of the drive.
        camera: its camera.
        start_ns: stamp of the first pair that is used.
        first_pair_hash: `first_pair_hash` of that pair; a frame log has it as a property.
    """
    robot = info.robot or UNNAMED_ROBOT
    return Session(
        id=session_id(robot, camera.id, start_ns, first_pair_hash),
        robot=robot,
        camera=camera.id,
        start_ns=start_ns,
        clock=info.clock,
        longitude_deg=info.longitude_deg,
        zone=info.zone,
    )
