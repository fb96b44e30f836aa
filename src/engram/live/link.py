"""Images and messages between a robot's middleware and `engram live`, on one machine.

This file imports nothing of Engram and runs on Python 3.8 with NumPy: a middleware that is tied to
an older Python copies it, as the ROS 2 bridge does.

Protocol, version 1. `engram live --socket PATH` listens on a Unix stream socket and serves one
client at a time. Both sides send JSON objects, one a line, UTF-8, at most 1 MB. Images do not pass
the socket: they lie in a ring in a file, best in ``/dev/shm``, which the client makes.

The client sends:

* ``{"do": "camera", "ring": PATH, "camera": {…}}`` first, and whenever the calibration changes.
  A rectified camera is ``fx, fy, cx, cy, baseline_m, width, height``. Or it is ``left, right``,
  each a ROS ``camera_info`` with the names of its YAML file, and ``rectified``: whether the images
  are.
* ``{"do": "frame", "ticket": N, "stamp_ns": T}`` for a pair that was written to the ring; with
  ``"wheels_from_live"``, 16 numbers, where wheel odometry sees the camera at that time; with
  ``"gyro_from_live"``, 9 numbers, how a gyroscope sees it turned in a frame that stays.
* ``{"do": "map", "on": true}``, ``{"do": "save"}``, ``{"do": "switch", "map": PATH}``,
  ``{"do": "relocalise"}``, ``{"do": "place", "node": …, "node_from_live": …, "covariance": …}``
  with an older belief as a hint, ``{"do": "here", "x_m": …, "y_m": …, "yaw_rad": …}`` with the
  camera's place in the map frame, ``{"do": "fix", "stamp_ns": …, "latitude_deg": …,
  "longitude_deg": …, "sigma_m": …}`` with a satellite fix, ``{"do": "stop"}``; each may
  carry an ``"id"``, which the answer ``{"is": "reply", "id": …, "ok": …, "text": …}`` repeats.

The process sends ``{"is": "seen", …}`` for each frame that it took and ``{"is": "alive", …}`` five
times a second, even while it opens a map or waits for the camera.

Ring: a header of 64 bytes, ``EngramR1``, then uint32 slots, width, height; then the slots, each of
64 bytes and both images, uint8, left first, row by row. A slot begins with uint64 sequence and
int64 stamp. The sequence is odd while the slot is written and ``2 · ticket + 2`` afterwards, so a
reader finds out whether the images that it copied were overwritten meanwhile.
"""

from __future__ import annotations

import json
import mmap
import os
import select
import socket
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC = b"EngramR1"
LONGEST_LINE = 1 << 20
_HEADER = struct.Struct("<8sIII")
_SLOT = struct.Struct("<Qq")
_ALIGNED = 64
# More than any camera has: bounds what a damaged header can ask for.
_LARGEST_SIDE = 16384
_MOST_SLOTS = 64


class LinkError(Exception):
    """The other side broke the protocol, or its file is not a ring."""


class Ring:
    """Pairs of images in a file that two processes map: one writes, one reads.

    The writer never waits: a reader that is too slow finds its pair overwritten.
    """

    def __init__(self, path: str, memory: mmap.mmap, shape: tuple[int, int, int]) -> None:
        self.path = path
        self.slots, self.width, self.height = shape
        self._memory = memory
        self._next = 0

    @staticmethod
    def create(path: str, width: int, height: int, slots: int = 8) -> Ring:
        """Makes the file of a ring, for the owner alone; replaces one that lies there.

        Raises:
            LinkError: the size is not between 1 and 16,384 px, or the slots not between 2 and 64.
            OSError: the file cannot be made.
        """
        shape = _checked((slots, width, height), path)
        draft = f"{path}.{os.getpid()}"
        handle = os.open(draft, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            size = _ALIGNED + slots * _slot_bytes(width, height)
            os.posix_fallocate(handle, 0, size)
            memory = mmap.mmap(handle, size)
            memory[: _HEADER.size] = _HEADER.pack(MAGIC, *shape)
            Path(draft).replace(path)
        except BaseException:
            Path(draft).unlink()
            raise
        finally:
            os.close(handle)
        return Ring(path, memory, shape)

    @staticmethod
    def open(path: str) -> Ring:
        """Maps the ring that another process made.

        Raises:
            LinkError: the file is not a ring, or shorter than its header says.
            OSError: it cannot be opened.
        """
        handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            size = os.fstat(handle).st_size
            head = os.pread(handle, _HEADER.size, 0)
            if len(head) < _HEADER.size or not head.startswith(MAGIC):
                raise LinkError(f"{path} is not a ring of images")
            shape = _checked(_HEADER.unpack(head)[1:], path)
            wanted = _ALIGNED + shape[0] * _slot_bytes(shape[1], shape[2])
            if size < wanted:
                raise LinkError(f"{path} has {size} bytes, its header asks for {wanted}")
            return Ring(path, mmap.mmap(handle, wanted), shape)
        finally:
            os.close(handle)

    def write(self, stamp_ns: int, left: Any, right: Any) -> int:
        """Writes a pair; returns the ticket by which it is read.

        Args:
            left, right: (height, width) uint8.

        Raises:
            LinkError: an image has another shape or type than the ring.
        """
        for image in (left, right):
            if image.shape != (self.height, self.width) or image.dtype != np.uint8:
                raise LinkError(
                    f"an image is {image.shape} {image.dtype}, the ring holds "
                    f"({self.height}, {self.width}) uint8"
                )
        ticket, self._next = self._next, self._next + 1
        at = self._at(ticket)
        _SLOT.pack_into(self._memory, at, 2 * ticket + 1, stamp_ns)
        for pixels, image in zip(self._images(ticket), (left, right)):  # noqa: B905  # 3.8
            pixels[...] = image
        _SLOT.pack_into(self._memory, at, 2 * ticket + 2, stamp_ns)
        return ticket

    def read(self, ticket: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]] | None:
        """Copies of a pair, (height, width) uint8 each; None if it was overwritten."""
        wanted = 2 * ticket + 2
        if ticket < 0 or self._sequence(ticket) != wanted:
            return None
        left, right = (pixels.copy() for pixels in self._images(ticket))
        return (left, right) if self._sequence(ticket) == wanted else None

    def close(self) -> None:
        """Unmaps the file; it stays where it is."""
        self._memory.close()

    def remove(self) -> None:
        """Unmaps the file and deletes it."""
        self.close()
        if Path(self.path).exists():
            Path(self.path).unlink()

    def _at(self, ticket: int) -> int:
        return _ALIGNED + (ticket % self.slots) * _slot_bytes(self.width, self.height)

    def _sequence(self, ticket: int) -> int:
        return int(_SLOT.unpack_from(self._memory, self._at(ticket))[0])

    def _images(self, ticket: int) -> list[NDArray[np.uint8]]:
        pixels = self.width * self.height
        begin = self._at(ticket) + _ALIGNED
        return [
            np.frombuffer(self._memory, np.uint8, pixels, begin + side * pixels).reshape(
                self.height, self.width
            )
            for side in (0, 1)
        ]


class Link:
    """JSON lines over a socket, each way; sending is bounded, receiving never blocks longer."""

    def __init__(self, connection: socket.socket, patience_s: float = 1.0) -> None:
        connection.settimeout(patience_s)
        self._socket = connection
        self._received = b""

    @staticmethod
    def connect(path: str, patience_s: float = 1.0) -> Link:
        """A link to the process that listens at `path`.

        Raises:
            OSError: no process listens there.
        """
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connection.settimeout(patience_s)
            connection.connect(path)
        except OSError:
            connection.close()
            raise
        return Link(connection, patience_s)

    def fileno(self) -> int:
        """For `select`."""
        return self._socket.fileno()

    def send(self, message: dict[str, Any]) -> None:
        """Sends one object.

        Raises:
            OSError: the other side is gone, or does not read.
        """
        self._socket.sendall(json.dumps(message, allow_nan=False).encode() + b"\n")

    def receive(self, wait_s: float = 0.0) -> list[dict[str, Any]]:
        """The objects that arrived, in order; waits for the first at most so long.

        Raises:
            EOFError: the other side closed the link.
            LinkError: the input is not one JSON object a line, or a line is too long.
            OSError: the link broke.
        """
        lines: list[bytes] = []
        while select.select([self._socket], [], [], 0.0 if lines else wait_s)[0]:
            chunk = self._socket.recv(1 << 16)
            if not chunk:
                if lines:
                    break
                raise EOFError("the other side closed the link")
            *whole, self._received = (self._received + chunk).split(b"\n")
            if len(self._received) > LONGEST_LINE:
                raise LinkError(f"a line is longer than {LONGEST_LINE} bytes")
            lines += whole
            if not lines:
                wait_s = 0.0
        return [_object(line) for line in lines if line]

    def close(self) -> None:
        """Ends the link."""
        self._socket.close()


def _object(line: bytes) -> dict[str, Any]:
    try:
        message = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise LinkError(f"a line is not JSON: {error}") from error
    if not isinstance(message, dict):
        raise LinkError("a line is not a JSON object")
    return message


def _slot_bytes(width: int, height: int) -> int:
    return _ALIGNED + -(-2 * width * height // _ALIGNED) * _ALIGNED


def _checked(shape: tuple[int, ...], path: str) -> tuple[int, int, int]:
    slots, width, height = (int(one) for one in shape)
    if not (2 <= slots <= _MOST_SLOTS and 1 <= width <= _LARGEST_SIDE >= height >= 1):
        raise LinkError(
            f"{path}: {slots} slots of {width} × {height} px are not the size of a ring"
        )
    return slots, width, height
