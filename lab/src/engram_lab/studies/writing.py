"""Results are written by one run at a time; failures are reported like any error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from engram.errors import InputError, MapLockedError, storage_full
from engram.files import WriterLock, current_holder


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turns the file system's errors, in what writes below a folder, into Engram's.

    Raises:
        StorageFullError: no space is left.
        InputError: the folder or a file in it cannot be written.
    """
    try:
        yield
    except OSError as error:
        where = error.filename or folder
        if full := storage_full(error, where):
            raise full from error
        raise InputError(f"{where}: cannot be written: {error.strerror or error}") from error


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Lets no other run work in a folder meanwhile: they would take each other's drafts away.

    Raises:
        MapLockedError: another run works there.
        MapError: the folder cannot be locked.
    """
    locked = folder / "run"
    try:
        lock = WriterLock(locked)
    except MapLockedError as error:
        raise MapLockedError(
            f"{folder}: {current_holder(locked) or 'another process'} evaluates there; wait until "
            "it is done, give another --work, or look at what is done with --report-only"
        ) from error
    try:
        yield
    finally:
        lock.release()
