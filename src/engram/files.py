"""Files that one process at a time writes, and new ones that appear whole or not at all.

A new file is written as a draft next to its path and gets its name when nothing can fail any more.
Whatever happens before leaves nothing under the name. What a killed process leaves of its draft
goes away with the next draft for the same name.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import secrets
import shutil
import socket
import stat
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from glob import escape
from pathlib import Path

from engram.errors import EngramError, InputError, MapError, MapLockedError, StorageFullError

# struct flock on 64-bit Linux: type, whence, start, length, pid.
_FLOCK = struct.Struct("hhqqi4x")
_HOLDER_BYTES = 4096
# Do not follow symbolic links; do not block on FIFOs.
_OPEN_LOCK = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
_DRAFT_LOCK = "draft-lock"  # held by the process that writes the draft, for as long as it lives


def map_path(location: Path | str) -> Path:
    """The path of a map file."""
    if isinstance(location, str) and location.startswith("postgresql"):
        # Not shown, as it may hold a password.
        raise InputError(
            "this is the address of a PostgreSQL database, not a map file; a centre takes it: "
            "ENGRAM_DATABASE=ADDRESS engram centre serve FOLDER"
        )
    try:
        str(location).encode()
    except UnicodeEncodeError as error:
        raise InputError(f"{location}: the path is not UTF-8; rename file or folder") from error
    return Path(location)


def check_there(path: Path, error: type[EngramError] = InputError) -> None:
    """Refuses a path that does not exist."""
    if not path.exists():
        raise error(f"{path}: there is no such file or folder")


@dataclass(frozen=True, slots=True)
class Holder:
    """Who writes to a file.

    Attributes:
        token: distinguishes one taking of the lock from all others; process ids are reused, in
            containers almost at once.
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
    """The lock of a file's only writer, on ``NAME-lock`` next to it, held until `release`.

    An open-file-description lock: unlike flock it can be asked about without taking it, unlike
    POSIX record locks it also excludes a second writer in the same process, and the kernel drops
    it when the process dies. The lock file itself stays; it names the last holder.

    Raises:
        MapLockedError: another process holds it; names process and host.
        MapError: the lock file cannot be made, for example on read-only media, or something else,
            a symbolic link say, stands in its place.
    """

    def __init__(self, path: Path) -> None:
        self.holder = Holder.this_process()
        self._path = _lock_path(path)
        try:
            self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | _OPEN_LOCK, 0o666)
        except OSError as error:
            fact = "is a symbolic link" if error.errno == errno.ELOOP else error.strerror
            raise MapError(
                f"{path} cannot be opened for writing: {self._path.name}: {fact}"
            ) from error
        try:
            self._take(path)
            self._name_holder()
        except BaseException:
            self.release()
            raise

    def _take(self, path: Path) -> None:
        if not stat.S_ISREG(os.fstat(self._file).st_mode):
            raise MapError(f"{self._path} is not a regular file; remove it to write to {path}")
        try:
            fcntl.fcntl(self._file, fcntl.F_OFD_SETLK, _whole_file(fcntl.F_WRLCK))
        except OSError as error:
            if error.errno not in {errno.EAGAIN, errno.EACCES}:
                raise MapError(f"{self._path} cannot be locked: {error.strerror}") from error
            raise MapLockedError(
                f"{path} is being written by {current_holder(path) or 'another process'}; wait "
                "until it is done, or read it meanwhile"
            ) from error

    def _name_holder(self) -> None:
        try:
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, json.dumps(asdict(self.holder)).encode(), 0)
        except OSError as error:
            raise StorageFullError(f"{self._path} cannot be written: {error.strerror}") from error

    def release(self) -> None:
        """Let others write."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


@contextmanager
def taking_turns(path: Path) -> Iterator[None]:
    """Waits until no other thread or process is in such a block of this lock file; it stays."""
    file = os.open(path, os.O_RDWR | os.O_CREAT | _OPEN_LOCK, 0o600)
    try:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
    finally:
        os.close(file)


def current_holder(path: Path) -> Holder | None:
    """The process that writes to a file now; None if there is none. Takes no lock."""
    try:
        file = os.open(_lock_path(path), os.O_RDONLY | _OPEN_LOCK)
    except OSError:
        return None  # nobody ever wrote here, or nobody could
    try:
        if not stat.S_ISREG(os.fstat(file).st_mode):
            return None
        asked = fcntl.fcntl(file, fcntl.F_OFD_GETLK, _whole_file(fcntl.F_WRLCK))
        if _FLOCK.unpack(asked)[0] == fcntl.F_UNLCK:
            return None
        return _holder(os.pread(file, _HOLDER_BYTES, 0)) or Holder(0, "an unknown host", "")
    finally:
        os.close(file)


def _lock_path(path: Path) -> Path:
    return path.with_name(path.name + "-lock")


def _whole_file(kind: int) -> bytes:
    return _FLOCK.pack(kind, os.SEEK_SET, 0, 0, 0)


def _holder(content: bytes) -> Holder | None:
    try:
        values = json.loads(content)
        return Holder(int(values["pid"]), str(values["host"]), str(values["token"]))
    except (ValueError, KeyError, TypeError):
        return None  # between being created and being filled in


def check_parent(path: Path) -> None:
    """Reject a new file whose folder does not exist (it may be mistyped)."""
    if not path.parent.is_dir():
        raise InputError(f"{path.parent} is not a folder; make it first")


def check_output(path: Path) -> None:
    """Refuse, before the work, a file that could not be written at its end."""
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder; give the name of a file in it")
        if path.exists() and not path.is_file():
            raise InputError(f"{path} is a device or pipe; give the name of a file")
        check_parent(path)
        if path.exists() and not os.access(path, os.W_OK):
            raise InputError(f"{path} cannot be written: it is read-only")
        _try_folder(path.parent)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from error


def check_output_folder(path: Path) -> None:
    """Refuse, before the work, a folder that could not be made and filled at its end."""
    try:
        there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
        if not there.is_dir():
            raise InputError(f"{path} cannot be a folder: {there} is a file")
        _try_folder(there)
    except OSError as error:
        raise InputError(f"{path} cannot be written to: {error.strerror}") from error


def _try_folder(folder: Path) -> None:
    """Creates an unnamed file in a folder: permissions alone do not show all that forbids it."""
    tempfile.TemporaryFile(dir=folder).close()


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yields where to write a file that appears under its name when the block ends."""
    with naming(path), draft_folder(path) as folder:
        draft = folder / path.name
        yield draft
        publish(draft, path)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Context of making a new file: raises whatever prevents it as our errors."""
    taken = InputError(f"{path} exists already; open it, or choose another name")
    if path.exists():
        raise taken
    if path.is_symlink():
        raise InputError(
            f"{path} is a link to {path.readlink()}, which does not exist; remove the link, or "
            "name its target"
        )
    check_parent(path)
    try:
        yield
    except FileExistsError as error:
        raise taken from error
    except OSError as error:
        raise MapError(f"{path} cannot be created: {error.strerror}") from error


def publish(draft: Path, path: Path) -> None:
    """Give a draft its name, never replacing a file that came meanwhile as a rename would."""
    try:
        os.link(draft, path)
    except OSError as error:
        if error.errno not in {errno.EPERM, errno.ENOTSUP, errno.ENOSYS}:
            raise
        # No hard links here (FAT): take the name first, then fill it.
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        draft.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


@contextmanager
def draft_folder(path: Path) -> Iterator[Path]:
    """A folder of its own in the file system of a file to be; it goes away with what it holds."""
    check_parent(path)
    try:
        remove_left_drafts(path.parent, escape(path.name))
        folder, held = _new_folder(path)
    except OSError as error:
        raise MapError(f"{path} cannot be created: {error.strerror}") from error
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(held)


def remove_left_drafts(folder: Path, names: str) -> None:
    """Remove drafts left by killed processes; drafts that are being written stay.

    Drafts that cannot be removed, for example another user's, are left.
    """
    for left in folder.glob(f".{names}.*.draft"):
        with suppress(OSError):
            held = _take_draft(left)
            if held is not None:
                try:
                    shutil.rmtree(left)
                finally:
                    os.close(held)


def _new_folder(path: Path) -> tuple[Path, int]:
    """A draft's folder and its lock, before anybody can take it for one that was left."""
    while True:
        made = tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".draft", dir=path.parent)
        with suppress(FileNotFoundError):
            held = _take_draft(Path(made))
            if held is not None and os.fstat(held).st_nlink:
                return Path(made), held
            if held is not None:
                os.close(held)


def _take_draft(folder: Path) -> int | None:
    """The lock of a draft's folder; None while another process, or another draft, holds it."""
    held = os.open(folder / _DRAFT_LOCK, os.O_RDWR | os.O_CREAT | _OPEN_LOCK, 0o600)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(held)
        if error.errno in {errno.EAGAIN, errno.EACCES}:
            return None
        raise
    return held
