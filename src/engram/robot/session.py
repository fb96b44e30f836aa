"""From a path to a drive and its session."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeAlias

from engram.errors import InputError, SequenceError
from engram.graph.model import Session
from engram.sequences import (
    Drive,
    FrameLog,
    StereoSequence,
    first_pair_hash,
    open_sequence,
    session_of,
)

DriveSequence: TypeAlias = StereoSequence | FrameLog


def open_drive(path: Path | str, **options: Any) -> Drive:
    """Opens a drive.

    Args:
        path: a folder of stereo images, a bag, or a frame log.
        **options: options of `open_sequence`.

    Raises:
        SequenceError: the drive cannot be used.
        CalibrationError: its calibration cannot be used.
        ConfigError: an option is out of range.
    """
    return open_sequence(path, **options)


def session_of_drive(sequence: DriveSequence) -> Session:
    """The session of a drive: the same drive read twice is the same session (method §2.7).

    Raises:
        InputError: it is no drive, but its path or a list of pairs.
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
