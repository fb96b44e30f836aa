"""New map files are written beside their place, and get their name when nothing can fail any more.

Whatever happens before leaves nothing under the name: no empty centre, no half download. What a
killed process leaves of its draft goes away with the next draft for the same name.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path

from engram.errors import InputError, MapError

_LOCK = "draft-lock"  # held by the process that writes the draft, for as long as it lives


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
    """Removes what killed processes left of drafts; drafts that are being written stay.

    What cannot be removed, somebody else's, say, is in nobody's way and stays.

    Args:
        folder: where the files were to be.
        names: of the files, as a glob pattern.
    """
    for left in folder.glob(f".{names}.*.draft"):
        with suppress(OSError):
            held = _take(left)
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
            held = _take(Path(made))
            if held is not None and os.fstat(held).st_nlink:
                return Path(made), held
            if held is not None:
                os.close(held)


def _take(folder: Path) -> int | None:
    """The lock of a draft's folder; None while another process, or another draft, holds it."""
    held = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(held)
        if error.errno in {errno.EAGAIN, errno.EACCES}:
            return None
        raise
    return held
