"""From a drive to its session."""

from __future__ import annotations

from typing import TypeAlias

from engram.errors import InputError, SequenceError
from engram.graph.model import Session
from engram.sequences import FrameLog, StereoSequence, first_pair_hash, session_of

DriveSequence: TypeAlias = StereoSequence | FrameLog


def session_of_drive(sequence: DriveSequence) -> Session:
    """The session of a drive: the same drive read twice is the same session (method §2.7).

    Raises:
        InputError: the argument is a path or a list, not an opened drive.
        SequenceError: the drive has no usable frame.
    """
    if not isinstance(sequence, StereoSequence | FrameLog):
        raise InputError(
            f"a value of {type(sequence).__name__} is not a drive: open a path with "
            "engram.open_drive(PATH); give pairs of your own to `step` of Map.robot(maps=True)"
        )
    info = sequence.info
    if isinstance(sequence, FrameLog):
        return session_of(
            info, sequence.camera, int(sequence.stamps_ns[0]), sequence.first_pair_hash
        )
    first = next(iter(sequence), None)
    if first is None:
        raise SequenceError(f"{info.name}: no frame can be used")
    return session_of(info, sequence.camera, first.stamp_ns, first_pair_hash(first))
