"""One writer at a time: a lock on a file beside the map, gone with its process however it ends."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import secrets
import socket
import struct
from dataclasses import asdict, dataclass
from pathlib import Path

from engram.errors import MapError, MapLockedError, StorageFullError

# struct flock on 64-bit Linux: type, whence, start, length, pid.
_FLOCK = struct.Struct("hhqqi4x")
_HOLDER_BYTES = 4096


@dataclass(frozen=True, slots=True)
class Holder:
    """Who writes to a map.

    Attributes:
        pid, host: the process, for people.
        token: tells one taking of the lock from all others; process ids come again, in containers
            almost at once.
    """

    pid: int
    host: str
    token: str

    @staticmethod
    def this_process() -> Holder:
        """This process, with a token of its own."""
        return Holder(os.getpid(), socket.gethostname(), secrets.token_hex(8))

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}"


class WriterLock:
    """The lock of a map's only writer, held from creation to `release`.

    An open-file-description lock: unlike flock it can be asked about without taking it, unlike
    POSIX record locks it also excludes a second writer in the same process, and the kernel drops
    it when the process dies. The file itself stays; it names the last holder.

    Attributes:
        holder: who holds it: this process.

    Raises:
        MapLockedError: somebody else holds it; names process and host.
        MapError: the lock file cannot be made, for example on read-only media.
    """

    def __init__(self, map_path: Path) -> None:
        self.holder = Holder.this_process()
        self._path = _lock_path(map_path)
        try:
            self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise MapError(
                f"{map_path} cannot be opened for writing: {self._path.name}: {error.strerror}"
            ) from error
        try:
            fcntl.fcntl(self._file, fcntl.F_OFD_SETLK, _whole_file(fcntl.F_WRLCK))
        except OSError as error:
            os.close(self._file)
            if error.errno not in {errno.EAGAIN, errno.EACCES}:
                raise MapError(f"{self._path} cannot be locked: {error.strerror}") from error
            raise MapLockedError(
                f"{map_path} is being written by {_read_holder(self._path) or 'another process'}; "
                "wait until it is done, or read the map meanwhile"
            ) from error
        try:
            self._name_holder()
        except OSError as error:
            self.release()
            raise StorageFullError(f"{self._path} cannot be written: {error.strerror}") from error

    def _name_holder(self) -> None:
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, json.dumps(asdict(self.holder)).encode(), 0)

    def release(self) -> None:
        """Let others write."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def current_holder(map_path: Path) -> Holder | None:
    """Who writes to the map now; None if nobody does. Disturbs nobody."""
    path = _lock_path(map_path)
    try:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None  # nobody ever wrote here, or nobody could
    try:
        asked = fcntl.fcntl(file, fcntl.F_OFD_GETLK, _whole_file(fcntl.F_WRLCK))
    finally:
        os.close(file)
    if _FLOCK.unpack(asked)[0] == fcntl.F_UNLCK:
        return None
    return _read_holder(path) or Holder(0, "an unknown host", "")


def _lock_path(map_path: Path) -> Path:
    return map_path.with_name(map_path.name + "-lock")


def _whole_file(kind: int) -> bytes:
    return _FLOCK.pack(kind, os.SEEK_SET, 0, 0, 0)


def _read_holder(path: Path) -> Holder | None:
    try:
        with path.open("rb") as file:
            values = json.loads(file.read(_HOLDER_BYTES))
        return Holder(int(values["pid"]), str(values["host"]), str(values["token"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None  # between being created and being filled in
