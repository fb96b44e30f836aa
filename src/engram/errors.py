"""The error tree, grouped by what a handler would do.

::

    EngramError
    ├── InputError               an input cannot be used: correct it and call again
    │   ├── SequenceError        images, stamps or layout of a drive
    │   │   └── UnfitDriveError  the doctor's fatal finding: repair the drive, or force it
    │   ├── CalibrationError     a calibration: missing, malformed, does not fit
    │   └── ConfigError          a setting: unknown key, wrong type, out of range
    ├── MapError                 a stored file: a map or a frame log
    │   ├── NotAMapError         the file is something else
    │   ├── FormatVersionError   written by a newer Engram: upgrade
    │   ├── MapLockedError       another process writes to it: wait
    │   ├── MapCorruptError      bytes do not match their hash: restore a copy
    │   ├── RevisionError        no such revision, or its state forbids the step
    │   └── StorageFullError     no space left: free some; nothing committed is lost
    ├── IncompatibleError        two valid things do not fit together
    ├── RefusedError             a result did not pass the requested gate
    ├── WorkerError              workers died, or cannot be reached: see memory and disk
    └── MissingExtraError        an optional dependency: the message names the pip command

Not localising is never an error: it is a status of the result.
"""

import errno
from collections.abc import Iterator
from contextlib import contextmanager


class EngramError(Exception):
    """Base of all errors that Engram raises on purpose."""


class InputError(EngramError, ValueError):
    """An input cannot be used."""


class SequenceError(InputError):
    """Images, stamps or the layout of a drive cannot be used; names the file and the fault."""


class UnfitDriveError(SequenceError):
    """The doctor found something in a drive that would ruin a map."""


class CalibrationError(InputError):
    """A calibration is missing, malformed or does not fit the images."""


class ConfigError(InputError):
    """A setting is unknown, of the wrong type or out of range."""


class MapError(EngramError):
    """A map or a frame log cannot be used as requested."""


class NotAMapError(MapError):
    """The file is not an Engram map."""


class FormatVersionError(MapError):
    """The file was written in a newer format than this version reads."""


class MapLockedError(MapError):
    """Another process is writing to the file."""


class MapCorruptError(MapError):
    """Stored bytes do not match their hash, or a record refers to a missing one."""


class RevisionError(MapError):
    """No such revision, or one in a state that forbids the step."""


class StorageFullError(MapError):
    """No space is left on the device; everything committed is intact."""


class IncompatibleError(EngramError):
    """Two things do not fit together, such as two kinds of descriptor."""


class RefusedError(EngramError):
    """A result is worse than the one it would replace, and was discarded."""


class WorkerError(EngramError):
    """Workers of a build, a rendering or an evaluation died, or cannot be reached."""


class MissingExtraError(EngramError, ImportError):
    """An optional dependency is not installed."""


@contextmanager
def extra(name: str, need: str) -> Iterator[None]:
    """Context of an optional import: a missing package is reported with its pip command.

    Args:
        name: the extra that has the package.
        need: the beginning of the message, such as "pictures need Matplotlib".
    """
    try:
        yield
    except ImportError as error:
        raise MissingExtraError(f"{need}: pip install 'engram-localisation[{name}]'") from error


def storage_full(error: OSError, where: object) -> StorageFullError | None:
    """The error to raise if a file system error means that no space is left; else None."""
    if error.errno not in {errno.ENOSPC, errno.EDQUOT}:
        return None
    return StorageFullError(
        f"{where}: no space is left; free some and run the same command again: what was finished "
        "is kept"
    )
