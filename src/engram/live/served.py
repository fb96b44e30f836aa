"""The process's end of the link: who may ask, and what is answered."""

from __future__ import annotations

import os
import socket
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import Any, Protocol, Self, TypeAlias

import cv2
import numpy as np

from engram.calibration.calibrated_pair import Cameras
from engram.calibration.formats import cameras_of_infos, parse_camera_info
from engram.errors import CalibrationError, InputError
from engram.frontend.frame import StereoPair
from engram.frontend.frontend import check_pair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.live.driving import Outside
from engram.live.link import Link, LinkError, Ring
from engram.robot.front import Arrived, arriving, paced
from engram.robot.localisers import DriveSequence

Message: TypeAlias = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class FrameEvent:
    """A frame that arrived.

    Attributes:
        arrived: a pair of rectified images, or a frame of a log.
        arrived_s: `time.perf_counter` when it did.
        dropped: frames that were dropped for this one since the last.
        outside: what wheels and gyroscope say at its time; None without them.
    """

    arrived: Arrived
    arrived_s: float
    dropped: int = 0
    outside: Outside | None = None


@dataclass(frozen=True, slots=True)
class Command:
    """A request to the process.

    Attributes:
        do: such as `map` or `stop`; see `engram.live.link`.
    """

    do: str
    given: Message = field(default_factory=dict)
    id: Any = None


class Transport(Protocol):
    """Brings frames and commands to a live process, and takes its messages away."""

    def events(self) -> Iterator[FrameEvent | Command | None]:
        """Arrivals in order, of frames the newest only; None whenever nothing came for a while.

        Ends when nothing more can come.
        """
        ...

    def tell(self, message: Message) -> None:
        """Sends a message, or drops it if no client is connected; any thread may call it."""
        ...


class Played:
    """A transport that plays a recorded drive, in real time or as fast as the robot goes.

    Args:
        rate_hz: frames a second, of which late ones are dropped; None plays every frame at once.
            The first one waits for the robot, which opens its map with it.
    """

    def __init__(
        self,
        sequence: DriveSequence,
        hear: Callable[[Message], None],
        rate_hz: float | None = None,
    ) -> None:
        self._sequence = sequence
        self._hear = hear
        self._rate_hz = rate_hz

    def events(self) -> Iterator[FrameEvent | Command | None]:
        """See `Transport`."""
        dropped = 0
        with closing(arriving(self._sequence)) as entries:
            for first in islice(entries, 1):  # opens the map: time runs once the robot is ready
                yield FrameEvent(first, time.perf_counter())
            for due, arrived in paced(entries, self._rate_hz):
                if self._rate_hz is not None and time.perf_counter() > due + 1 / self._rate_hz:
                    dropped += 1
                    continue
                yield FrameEvent(arrived, due, dropped)
                dropped = 0

    def tell(self, message: Message) -> None:
        """See `Transport`."""
        self._hear(message)


_IDLE_S = 0.1
_LONGEST_ALONE_S = 60.0


class Served:
    """Listens on a Unix socket, and serves one client at a time; see `engram.live.link`.

    A client that goes away, or breaks the protocol, leaves the process waiting for the next one. A
    context manager: the socket's file goes with it.

    Args:
        path: where the socket's file is made, for its owner alone.
        once: end with the first client, or if none comes within a minute: nothing else
            would stop the process.
    """

    def __init__(self, path: Path, *, once: bool = False) -> None:
        self._path = path
        self._once = once
        self._began_s = time.monotonic()
        self._listening = _listening(path)
        self._link: Link | None = None
        self._sending = Lock()
        self._images: _Images | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._part()
        self._listening.close()
        self._path.unlink(missing_ok=True)

    def events(self) -> Iterator[FrameEvent | Command | None]:
        """See `Transport`; ends by itself only if it serves once."""
        met = False
        while True:
            if self._link is None:
                alone_s = time.monotonic() - self._began_s
                if self._once and (met or alone_s > _LONGEST_ALONE_S):
                    return
                self._meet()
                met = self._link is not None
                yield None
                continue
            try:
                messages = self._link.receive(_IDLE_S)
            except (OSError, EOFError, LinkError) as error:
                self._part(error)
                continue
            frames = [one for one in messages if one.get("do") == "frame"]
            for message in messages:
                if message.get("do") == "camera":
                    self._told(message, self._see)
                elif message.get("do") != "frame":
                    yield Command(str(message.get("do")), message, message.get("id"))
            yield self._frame(frames) if frames else None

    def tell(self, message: Message) -> None:
        """See `Transport`."""
        with self._sending:
            if self._link is None:
                return
            try:
                self._link.send(message)
            except OSError:
                # Whoever reads finds the broken link and parts; a client that is stuck is dropped.
                self._link.close()

    def _meet(self) -> None:
        try:
            connection, _ = self._listening.accept()
        except TimeoutError:
            return
        with self._sending:
            self._link = Link(connection)

    def _part(self, error: Exception | None = None) -> None:
        if isinstance(error, LinkError):
            self.tell({"is": "reply", "id": None, "do": "link", "ok": False, "text": str(error)})
        with self._sending:
            if self._link is not None:
                self._link.close()
            self._link = None
        if self._images is not None:
            self._images.close()
        self._images = None

    def _see(self, message: Message) -> None:
        images = _Images(message)
        if self._images is not None:
            self._images.close()
        self._images = images

    def _frame(self, frames: list[Message]) -> FrameEvent | None:
        """The newest frame that is still whole."""
        now = time.perf_counter()
        for older, message in enumerate(reversed(frames)):
            if self._images is None:
                self._refuse(message, "no camera was given yet")
                return None
            taken = self._told(message, self._images.taken)
            if taken is not None:
                return FrameEvent(taken[0], now, len(frames) - 1 - older, taken[1])
        return None

    def _told(self, message: Message, act: Callable[[Message], Any]) -> Any:
        """Does what a message says; a message that is wrong is answered, and goes no further."""
        try:
            return act(message)
        except (InputError, LinkError, OSError) as error:
            self._refuse(message, str(error))
        except KeyError as error:
            self._refuse(message, f"{message.get('do')} needs {error}")
        except (TypeError, ValueError, OverflowError) as error:
            self._refuse(message, f"{message.get('do')} is not understood: {error}")
        return None

    def _refuse(self, message: Message, text: str) -> None:
        do, asked = message.get("do"), message.get("id")
        self.tell({"is": "reply", "id": asked, "do": do, "ok": False, "text": text})


class _Images:
    """The ring of a client, and its camera."""

    def __init__(self, message: Mapping[str, Any]) -> None:
        given = message["camera"]
        if "left" in given:
            left, right = (parse_camera_info(dict(given[side])) for side in ("left", "right"))
            self._cameras = cameras_of_infos(left, right, rectified=bool(given.get("rectified")))
            size = left.width, left.height
        else:
            self._cameras = Cameras(StereoCamera(**{key: given[key] for key in _RECTIFIED}))
            size = self._cameras.camera.width, self._cameras.camera.height
        self._ring = Ring.open(str(message["ring"]))
        if (self._ring.width, self._ring.height) != size:
            self._ring.close()
            raise CalibrationError(
                f"images are {self._ring.width} × {self._ring.height} px, those of the "
                f"calibration {size[0]} × {size[1]}"
            )

    def taken(self, message: Mapping[str, Any]) -> tuple[StereoPair, Outside | None] | None:
        """The rectified pair of a ticket, and what else moved; None if it was overwritten."""
        images = self._ring.read(int(message["ticket"]))
        if images is None:
            return None
        left, right = images
        rectification = self._cameras.rectification
        if rectification is not None:
            tables = rectification.left, rectification.right
            left, right = (
                np.asarray(
                    cv2.remap(image, table.pixels, table.fractions, cv2.INTER_LINEAR), np.uint8
                )
                for image, table in zip((left, right), tables, strict=True)
            )
        pair = StereoPair(int(message["stamp_ns"]), left, right, self._cameras.camera)
        check_pair(pair)
        return pair, _outside(message)

    def close(self) -> None:
        """Lets go of the ring."""
        self._ring.close()


def _outside(message: Mapping[str, Any]) -> Outside | None:
    """The motion of a frame by wheels and gyroscope; None without any."""
    wheels, gyro = message.get("wheels_from_live"), message.get("gyro_from_live")
    if wheels is None and gyro is None:
        return None
    still = np.zeros(3)
    turned = None if gyro is None else SE3.from_matrix(np.c_[np.reshape(gyro, (3, 3)), still])
    moved = None if wheels is None else SE3.from_matrix(np.reshape(wheels, (4, 4)))
    return Outside(moved, turned)


_RECTIFIED = ("fx", "fy", "cx", "cy", "baseline_m", "width", "height")


def _listening(path: Path) -> socket.socket:
    """A socket that listens at a path; a file that a dead process left there is replaced."""
    if path.exists() or path.is_symlink():
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise InputError(f"{path} is not a socket; give another path")
        with suppress(OSError):
            Link.connect(str(path)).close()
            raise InputError(f"another process listens at {path}; give another path")
        path.unlink()
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    before = os.umask(0o177)
    try:
        listening.bind(str(path))
    except OSError as error:
        listening.close()
        raise InputError(f"{path}: cannot listen there: {error.strerror or error}") from error
    finally:
        os.umask(before)
    listening.listen(1)
    listening.settimeout(_IDLE_S)
    return listening
