"""From a path to a drive and its session."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, TypeAlias

from engram.drive.there_and_back import ThereAndBack
from engram.errors import SequenceError
from engram.experience.model import Session
from engram.sequences import (
    FrameLog,
    ImageSequence,
    SimulatedSequence,
    first_pair_hash,
    open_sequence,
    session_of,
)

DriveSequence: TypeAlias = ImageSequence | FrameLog | ThereAndBack | SimulatedSequence


def open_drive(
    path: Path,
    *,
    there_and_back: int | None = None,
    **options: Any,
) -> DriveSequence:
    """Opens a drive.

    Args:
        path: a folder of stereo images, or a frame log.
        there_and_back: drive it there and back until so many frames have passed.
        **options: of `open_sequence`.

    Raises:
        SequenceError: the drive cannot be used.
        CalibrationError: its calibration cannot.
        ConfigError: an option is out of range.
    """
    sequence = open_sequence(path, **options)
    if there_and_back is None:
        return sequence
    if isinstance(sequence, FrameLog):
        raise SequenceError(f"{path}: there and back needs images, not a frame log")
    return ThereAndBack(sequence, there_and_back)


def session_of_drive(sequence: DriveSequence) -> Session:
    """The session of a drive: the same drive read twice is the same session (SPEC §2.7).

    A drive there and back is another one than the drive there.

    Raises:
        SequenceError: the drive has no usable frame.
    """
    info = sequence.info
    if isinstance(sequence, FrameLog):
        return session_of(
            info, sequence.camera, int(sequence.stamps_ns[0]), sequence.first_pair_hash
        )
    first = next(iter(sequence), None)
    if first is None:
        raise SequenceError(f"{info.name}: no frame can be used")
    if isinstance(sequence, ThereAndBack):
        info = dataclasses.replace(info, robot=f"{info.robot or info.name}, there and back")
    return session_of(info, sequence.camera, first.stamp_ns, first_pair_hash(first))
