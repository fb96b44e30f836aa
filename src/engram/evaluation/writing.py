"""Where results cannot be written, that is said like any other error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from engram.errors import InputError, storage_full


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
