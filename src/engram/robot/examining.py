"""The doctor's part in a drive: a whole examination, and the look ahead before mapping."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import chain, islice

import numpy as np

from engram.doctor import Diagnosis, Facts
from engram.errors import UnfitDriveError
from engram.geometry import StereoCamera
from engram.monitor import QUIET, Monitor, deferred_interrupt, interruptible
from engram.odometry import MotionSource, OutsideMotion
from engram.robot.front import Arrived, Front, arriving, stamp_of
from engram.robot.session import DriveSequence
from engram.robot.settings import RobotOptions, Settings
from engram.sequences import (
    Drive,
    FrameLog,
    ImageSequence,
    LoggedFrame,
    SequenceInfo,
    stamps_of,
)
from engram.sequences.motion import MovedSequence

# A long drive is examined in so many stretches, as it may begin at rest or in the dark.
_STRETCHES = 4


def facts_of(sequence: DriveSequence, *, by_hour: bool = False) -> Facts:
    """Facts about a drive in addition to its frames."""
    info = sequence.info
    step = sequence.frames.step if isinstance(sequence, ImageSequence) else 1
    bits = sequence.bits() if isinstance(sequence, ImageSequence) else None
    return Facts(info.clock, info.zone, info.longitude_deg, by_hour, step, bits)


def examine_drive(
    sequence: Drive,
    settings: Settings | None = None,
    monitor: Monitor = QUIET,
    *,
    by_hour: bool = False,
    seen: Callable[[int, Arrived], None] = lambda *_: None,
) -> Diagnosis:
    """Examines up to `DoctorConfig.frames` frames of a drive, in stretches spread over it.

    Of a bag, which is a stream, the first ones.

    Open the drive with `skip_bad`: then bad pairs and stamps out of order are findings, not errors.

    Args:
        sequence: the drive.
        settings: the resolved configuration; None for the defaults.
        monitor: receives each frame, and may stop the examination.
        by_hour: whether missions by hour need the drive's clock.
        seen: called with the number and the images of each frame that is examined.

    Raises:
        SequenceError: an image cannot be used.
    """
    front = Front(settings or Settings())
    evidence = front.examination.evidence
    evidence.facts = facts_of(sequence, by_hour=by_hour)
    with interruptible(monitor) as watched:
        chosen = _chosen(sequence, front, evidence.config.frames)
        for number, (arrived, outside) in enumerate(chosen):
            front.take(arrived, outside)
            seen(number, arrived)
            watched.advance("examined")
            watched.check()
    evidence.bad += sequence.skipped_reasons
    evidence.read = stamps_of(sequence)
    return front.diagnosis


def _chosen(
    sequence: Drive, front: Front, most: int
) -> Iterator[tuple[Arrived, OutsideMotion | None]]:
    """The frames that are examined; the front starts again with each stretch of them."""
    source = sequence.motion()
    runs: Iterable[Iterable[Arrived]] = [islice(sequence, most)]
    if isinstance(sequence, ImageSequence):
        runs = (sequence.usable(stretch) for stretch in stretches(len(sequence), most))
    elif isinstance(sequence, FrameLog):
        runs = (map(sequence.read, stretch) for stretch in stretches(len(sequence), most))
    for run in runs:
        front.restart()
        last_ns: int | None = None
        for arrived in run:
            stamp_ns = stamp_of(arrived)
            if source is None or last_ns is None:
                yield arrived, None
            else:
                yield arrived, source.between(last_ns, stamp_ns)
            last_ns = stamp_ns


def stretches(length: int, most: int) -> list[range]:
    """Up to `most` frames of a drive: all of them, or runs of successive ones spread over it."""
    if length <= most:
        return [range(length)]
    each = max(most // _STRETCHES, 1)
    starts = np.linspace(0, length - each, min(_STRETCHES, most)).round().astype(int)
    return [range(int(start), int(start) + each) for start in starts]


class LookedAhead:
    """A drive whose first frames were taken ahead, so that the doctor saw them before the map.

    Images of those frames are not kept: they come as logged frames, the others as they are. It can
    be iterated over once.

    Args:
        front: takes the frames, and later those of the robot that drives on.
        sequence: the drive.
        monitor: may stop it.
    """

    def __init__(self, front: Front, sequence: DriveSequence, monitor: Monitor = QUIET) -> None:
        self.sequence = sequence
        self._begin()
        self._look(front, monitor)
        if front.fixed_share:  # what is fixed to the camera is left out from the first frame on
            front.look_again()
            self._rest.close()
            self._begin()
            self._look(front, monitor)

    def _begin(self) -> None:
        sequence = self.sequence
        self._rest = arriving(sequence)
        self._ahead: list[LoggedFrame] = []
        self._outside = sequence.motion() if isinstance(sequence, MovedSequence) else None
        # Stamp of the last frame that was taken ahead.
        self._until_ns: int | None = None

    def _look(self, front: Front, monitor: Monitor) -> None:
        """Takes frames ahead until the doctor has seen enough."""
        with deferred_interrupt() as raise_if_asked:
            while not front.examination.full:
                arrived = next(self._rest, None)
                if arrived is None:
                    break
                self._take(front, arrived)
                monitor.check()
                raise_if_asked()

    def _take(self, front: Front, arrived: Arrived) -> None:
        """Takes one frame ahead, with the motion from outside that led to it."""
        stamp_ns, outside = stamp_of(arrived), None
        if self._outside is not None and self._until_ns is not None:
            outside = self._outside.between(self._until_ns, stamp_ns)
        self._ahead.append(front.take_ahead(arrived, outside))
        self._until_ns = stamp_ns

    def motion(self) -> MotionSource | None:
        """The motion from outside that was not used ahead."""
        return None if self._outside is None else self

    def between(self, start_ns: int, end_ns: int) -> OutsideMotion | None:
        """See `MotionSource`; None where the frames were taken ahead."""
        if self._outside is None or (self._until_ns is not None and end_ns <= self._until_ns):
            return None
        return self._outside.between(start_ns, end_ns)

    @property
    def info(self) -> SequenceInfo:
        """Facts about the drive as a whole."""
        return self.sequence.info

    @property
    def camera(self) -> StereoCamera:
        """The one camera of the drive."""
        return self.sequence.camera

    def __len__(self) -> int:
        return len(self.sequence)

    def __iter__(self) -> Iterator[Arrived]:
        ahead, self._ahead = self._ahead, []
        return chain(ahead, self._rest)

    def close(self) -> None:
        """Ends the thread that reads ahead."""
        self._rest.close()


def refuse_unfit(diagnosis: Diagnosis, name: str, options: RobotOptions) -> None:
    """Refuses a drive with a fatal finding, unless it is forced.

    Raises:
        UnfitDriveError: what is wrong with it.
    """
    if diagnosis.fatal and not options.force:
        findings = "\n".join(one.text() for one in diagnosis.fatal)
        raise UnfitDriveError(
            f"{name}: not mapped, nothing was written; --force maps it anyway\n{findings}"
        )
