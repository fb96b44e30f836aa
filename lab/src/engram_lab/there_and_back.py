"""A short sequence driven there and back again, for as long as one likes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from engram.errors import ConfigError, SequenceError
from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.sequences.sequence import SequenceInfo, StereoSequence


class ThereAndBack:
    """Frames 0, 1 … n−1, n−2 … 0, 1 … of a sequence, stamped at an even rate.

    The camera keeps looking the same way, so driving back is driving in reverse. Every image is
    decoded once and kept.
    """

    def __init__(self, sequence: StereoSequence, count: int, rate_hz: float = 20.0) -> None:
        if count < 1:
            raise ConfigError(f"there and back for {count} frames: must be 1 or more")
        self._pairs = list(sequence)
        if len(self._pairs) < 2:
            raise SequenceError(
                f"{sequence.info.name}: {len(self._pairs)} pairs; there and back needs two or more"
            )
        self._sequence = sequence
        self._count = count
        self._period_ns = round(1e9 / rate_hz)

    @property
    def info(self) -> SequenceInfo:
        """That of the sequence, of a robot of its own: another drive than the one there."""
        info = self._sequence.info
        robot = f"{info.robot or info.name}, there and back"
        return dataclasses.replace(info, robot=robot)

    @property
    def camera(self) -> StereoCamera:
        """That of the sequence."""
        return self._sequence.camera

    @property
    def skipped(self) -> int:
        """That of the sequence."""
        return self._sequence.skipped

    def __len__(self) -> int:
        return self._count

    def source_index(self, index: int) -> int:
        """Which pair of the sequence frame `index` is."""
        last = len(self._pairs) - 1
        phase = index % (2 * last)
        return phase if phase <= last else 2 * last - phase

    def __iter__(self) -> Iterator[StereoPair]:
        first_ns = self._pairs[0].stamp_ns
        for index in range(self._count):
            yield dataclasses.replace(
                self._pairs[self.source_index(index)],
                stamp_ns=first_ns + index * self._period_ns,
            )
