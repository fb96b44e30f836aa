"""What a build cannot keep on the disk is said like any other error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from engram.errors import MapError, storage_full


@contextmanager
def keeping(folder: Path) -> Iterator[None]:
    """Turns the file system's errors, in what reads and writes in a build's folder, into Engram's.

    Raises:
        StorageFullError: no space is left.
        MapError: the folder or a file in it cannot be made, read, written or removed.
    """
    try:
        yield
    except OSError as error:
        where = error.filename or folder
        if full := storage_full(error, where):
            raise full from error
        raise MapError(
            f"{where}: {error.strerror or error}; a build keeps its maps in {folder}: it must be a "
            "folder that can be written to, or one that can be made there"
        ) from error
