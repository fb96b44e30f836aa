"""New map files are written beside their place, and get their name when nothing can fail any more.

Whatever happens before leaves nothing under the name: no empty centre, no half download.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from engram.errors import InputError, MapError


def check_parent(path: Path) -> None:
    """Refuses a file to be whose folder is not there: a mistyped one is not to be made.

    Raises:
        InputError: the folder of the file is not there.
    """
    if not path.parent.is_dir():
        raise InputError(f"{path.parent} is no folder; make it first")


@contextmanager
def draft_folder(path: Path) -> Iterator[Path]:
    """A folder of its own in the file system of a file to be; it goes away with what it holds.

    Raises:
        InputError: the folder of the file is not there.
        MapError: it cannot be written to.
    """
    check_parent(path)
    try:
        folder = tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise MapError(f"{path} cannot be created: {error.strerror}") from error
    with folder as name:
        yield Path(name)
