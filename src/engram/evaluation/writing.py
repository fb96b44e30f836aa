"""Where results cannot be written, that is said like any other error."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from engram.errors import InputError, StorageFullError


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
        if error.errno in {errno.ENOSPC, errno.EDQUOT}:
            raise StorageFullError(
                f"{where}: no space is left; free some and give the same command again: what was "
                "finished is kept"
            ) from error
        raise InputError(f"{where}: cannot be written: {error.strerror or error}") from error
