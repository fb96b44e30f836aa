"""The flight recorder: a robot's last seconds, written when it is lost or on request."""

from __future__ import annotations

import platform
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from queue import Full, Queue
from threading import Thread
from typing import Annotated, Any

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram import __version__
from engram.config import check_bounds, config_hash, plain, to_dict
from engram.errors import EngramError, InputError
from engram.frontend.frame import Frame, StereoPair
from engram.graph.model import Clock
from engram.localiser.attempts import Outcome
from engram.localiser.localisation import Localisation, LocalisationStatus
from engram.robot.front import Arrived
from engram.sequences.framelog.file import FrameLogHeader
from engram.sequences.framelog.log_writer import FlightWriter
from engram.sequences.sequence import LoggedFrame, SequenceInfo, first_pair_hash

# Frames that wait for the recorder's thread, 25 MB of images; beyond them it leaves frames out.
_WAITING = 64
_ATTEMPTS = 20
_LOST = {LocalisationStatus.LOST, LocalisationStatus.NO_ODOMETRY}


@dataclass(frozen=True, slots=True)
class RecorderConfig:
    """Settings of `Recorder`."""

    seconds: Annotated[float, Meta(gt=0, description="length of a record, s")] = 30.0
    most_bytes: Annotated[
        int, Meta(ge=1_000_000, description="most memory for images and landmarks, bytes")
    ] = 64_000_000
    jpeg_quality: Annotated[int, Meta(ge=1, le=100, description="JPEG quality of the images")] = 85
    most_records: Annotated[
        int, Meta(ge=1, description="most records that one robot writes by itself")
    ] = 20

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True, eq=False)
class _Entry:
    """One frame as it is kept."""

    logged: LoggedFrame
    pair_hash: str
    images: tuple[bytes, bytes] | None
    decision: dict[str, Any]

    @property
    def bytes(self) -> int:
        landmarks = self.logged.frame.landmarks
        images = 0 if self.images is None else len(self.images[0]) + len(self.images[1])
        return images + len(landmarks) * 70

    def made_as(self, first: Frame) -> bool:
        """Whether camera and front-end are those of another frame: one record holds one of each."""
        frame = self.logged.frame
        return (frame.camera, frame.frontend) == (first.camera, first.frontend)


@dataclass(slots=True)
class _Request:
    """Asks the recorder's thread for a file."""

    path: Path
    reason: str
    about: Mapping[str, Any]


@dataclass(slots=True, eq=False)
class Recorder:
    """Keeps a robot's last seconds in memory; writes them as one file.

    Images are compressed, and files written, on a thread of the recorder's own. If that thread
    falls behind, frames are left out.

    Attributes:
        folder: where records go, NAME.flight; made if missing.
        about: what is stored with each record, such as the map and its revision.
        images: whether images are kept; without them a record shows no people.
        written: the records, in the order of time.
        failure: why a record could not be written; "" if none failed.
    """

    folder: Path
    info: SequenceInfo = field(default_factory=lambda: SequenceInfo("live", "live", Clock.UNKNOWN))
    about: Mapping[str, Any] = field(default_factory=dict)
    images: bool = True
    config: RecorderConfig = field(default_factory=RecorderConfig)
    written: list[Path] = field(default_factory=list)
    failure: str = ""
    _queue: Queue[Any] = field(default_factory=lambda: Queue(_WAITING))
    _thread: Thread | None = None
    _ring: deque[_Entry] = field(default_factory=deque)
    _bytes: int = 0
    _unasked: int = 0
    # Paths that were given away; their files may not be there yet.
    _asked: set[Path] = field(default_factory=set)
    # Whether the robot knew where it was at the last frame, and the stamp of that.
    _knew: bool = False
    _stamp_ns: int = 0

    def __post_init__(self) -> None:
        self.folder, self.about = Path(self.folder), plain(self.about)

    def note(
        self, arrived: Arrived, frame: Frame, result: Localisation, outcomes: list[Outcome]
    ) -> None:
        """Keeps one frame; writes a record if the robot has just been lost.

        Args:
            arrived: the images, which are copied, or the logged frame.
        """
        self._stamp_ns = frame.stamp_ns
        pair = None
        if isinstance(arrived, StereoPair):
            pair = (arrived.left.copy(), arrived.right.copy())
        logged = LoggedFrame(replace(frame, further=None), result.motion.odometry)
        self._put((logged, pair, _decision(result, outcomes)))
        lost = result.status in _LOST
        if lost and self._knew:
            self._write_unasked("lost")
        if result.localised or lost:
            self._knew = result.localised

    def withdrew(self) -> None:
        """Writes a record: the robot withdrew a fix."""
        self._write_unasked("withdrew a fix")

    def record(self, reason: str = "asked") -> Path:
        """Writes what is kept to a file; `written` names it once it is there."""
        stamp = datetime.fromtimestamp(self._stamp_ns / 1e9, UTC).strftime("%Y%m%dT%H%M%S")
        names = (self.folder / f"{self.info.name}-{stamp}-{n}.flight" for n in count(1))
        path = next(name for name in names if name not in self._asked and not name.exists())
        self._asked.add(path)
        self._start()
        self._queue.put(_Request(path, reason, {**self.about, "stamp_ns": self._stamp_ns}))
        return path

    def close(self) -> None:
        """Writes what was requested, and ends the thread."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join()
            self._thread = None

    def _write_unasked(self, reason: str) -> None:
        self._unasked += 1
        if self._unasked <= self.config.most_records:
            self.record(reason)

    def _put(self, item: object) -> None:
        self._start()
        try:
            self._queue.put_nowait(item)
        except Full:
            return

    def _start(self) -> None:
        if self._thread is None:
            self._thread = Thread(target=self._run, name="engram-recorder", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            if isinstance(item, _Request):
                try:
                    self._write(item)
                except (EngramError, OSError, TypeError, ValueError) as error:
                    # Whatever it is: the robot would wait for ever for a thread that has ended.
                    self.failure = f"{item.path}: {error}"
                continue
            self._keep(*item)

    def _keep(
        self,
        logged: LoggedFrame,
        pair: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None,
        decision: dict[str, Any],
    ) -> None:
        """Adds a frame to the ring, and drops what is too old or too much."""
        frame, images, pair_hash = logged.frame, None, ""
        if pair is not None:
            pair_hash = first_pair_hash(StereoPair(frame.stamp_ns, *pair, frame.camera))
            if self.images:
                images = (self._jpeg(pair[0]), self._jpeg(pair[1]))
        entry = _Entry(logged, pair_hash, images, decision)
        ring, newest = self._ring, frame.stamp_ns
        if ring and newest <= ring[-1].logged.frame.stamp_ns:
            ring.clear()  # the clock was set back
            self._bytes = 0
        ring.append(entry)
        self._bytes += entry.bytes
        oldest_ns = newest - round(self.config.seconds * 1e9)
        while len(ring) > 1 and (
            ring[0].logged.frame.stamp_ns < oldest_ns or self._bytes > self.config.most_bytes
        ):
            self._bytes -= ring.popleft().bytes

    def _write(self, request: _Request) -> None:
        """Writes the ring as one file; another name until it is whole."""
        if not self._ring:
            raise InputError("the robot has seen no frame yet")
        self.folder.mkdir(parents=True, exist_ok=True)
        draft = request.path.with_name(f".{request.path.stem}.part.flight")
        draft.unlink(missing_ok=True)
        first = self._ring[0].logged.frame
        info = SequenceInfo(
            request.path.stem, "flight", self.info.clock, self.info.robot,
            self.info.longitude_deg, self.info.zone,
        )  # fmt: skip
        header = FrameLogHeader(info, first.camera, first.descriptor, first.frontend)
        entries = [one for one in self._ring if one.made_as(first)]
        with FlightWriter(draft, header, checkpoint_every=10_000) as writer:
            images = sum(one.images is not None for one in entries)
            writer.add_report(self._about(request), frames=len(entries), images=images)
            for entry in entries:
                writer.append(self._anonymous(entry.logged), entry.pair_hash)
                writer.add_decision(entry.decision)
                if entry.images is not None:
                    writer.add_images(*entry.images)
        draft.replace(request.path)
        self.written.append(request.path)

    def _about(self, request: _Request) -> dict[str, Any]:
        """Why a record is made, where and by what."""
        return {
            "reason": request.reason,
            "engram": __version__,
            "machine": platform.machine(),
            "settings": to_dict(self.config),
            "made_by": config_hash(self.config),
            **request.about,
        }

    def _anonymous(self, logged: LoggedFrame) -> LoggedFrame:
        """The frame, without its thumbnail if no images are kept."""
        if self.images or logged.frame.thumbnail is None:
            return logged
        return LoggedFrame(replace(logged.frame, thumbnail=None), logged.odometry)

    def _jpeg(self, image: NDArray[np.uint8]) -> bytes:
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.config.jpeg_quality]
        return cv2.imencode(".jpg", image, quality)[1].tobytes()


def _decision(result: Localisation, outcomes: list[Outcome]) -> dict[str, Any]:
    """What the robot concluded from a frame, and from what."""
    position = result.position
    return {
        **result.to_dict(),
        "looked_up": result.looked_up,
        "moved_m": result.motion.moved_m,
        "guessed_m": _finite(result.motion.guessed_m),
        "jumped": result.motion.jumped,
        "belief": None
        if position is None
        else {
            "node": str(position.node),
            "node_from_live": position.node_from_live.matrix().ravel().tolist(),
            "sigma_m": _finite(position.sigma_m),
        },
        "tried": [
            {
                "node": str(outcome.candidate.node),
                "inliers": outcome.match.inliers,
                "accepted": bool(outcome.accepted),
            }
            for outcome in outcomes[:_ATTEMPTS]
        ],
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
