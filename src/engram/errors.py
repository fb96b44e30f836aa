"""The error tree, grouped by what a handler would do.

::

    EngramError
    ├── InputError               what was given cannot be used: correct it and call again
    │   ├── SequenceError        images, stamps or layout of a drive
    │   ├── CalibrationError     a calibration that is missing, malformed or does not fit
    │   └── ConfigError          a setting: unknown key, wrong type, out of range
    ├── MapError                 a stored file: a map or a frame log
    │   ├── NotAMapError         the file is something else
    │   ├── FormatVersionError   written by a newer Engram: upgrade
    │   ├── MapLockedError       another process writes to it: wait
    │   ├── MapCorruptError      bytes do not match their hash: restore a copy
    │   ├── RevisionError        no such revision, or in a state that forbids the step
    │   └── StorageFullError     no space left: free some; nothing committed is lost
    ├── IncompatibleError        two things that are each fine do not fit together
    ├── RefusedError             a result did not pass the gate that was asked for
    ├── WorkerError              workers died, or cannot be reached: look at memory and disk
    └── MissingExtraError        an optional dependency: the message names the pip command

Not localising is never an error: it is a status of the result.
"""

import errno


class EngramError(Exception):
    """Base of all errors that Engram raises on purpose."""


class InputError(EngramError, ValueError):
    """What was given cannot be used."""


class SequenceError(InputError):
    """Images, stamps or the layout of a drive cannot be used; names the file and the fact."""


class CalibrationError(InputError):
    """A calibration is missing, malformed or does not fit the images."""


class ConfigError(InputError):
    """A setting is unknown, of the wrong type or out of range."""


class MapError(EngramError):
    """A map or a frame log cannot be used as asked."""


class NotAMapError(MapError):
    """The file is no Engram map."""


class FormatVersionError(MapError):
    """The file was written in a newer format than this version reads."""


class MapLockedError(MapError):
    """Another process is writing to the file."""


class MapCorruptError(MapError):
    """Stored bytes do not match their hash, or a record points at nothing."""


class RevisionError(MapError):
    """No such revision, or one in a state that forbids the step."""


class StorageFullError(MapError):
    """No space is left on the device; everything committed is intact."""


class IncompatibleError(EngramError):
    """Two things do not fit together, such as two kinds of descriptor."""


class RefusedError(EngramError):
    """A result is worse than what it would take the place of, and was not kept."""


class WorkerError(EngramError):
    """Workers of a build, a rendering or an evaluation died, or cannot be reached."""


class MissingExtraError(EngramError, ImportError):
    """An optional dependency is not installed."""


def storage_full(error: OSError, where: object) -> StorageFullError | None:
    """What to raise where the file system says that no space is left; None where it says else."""
    if error.errno not in {errno.ENOSPC, errno.EDQUOT}:
        return None
    return StorageFullError(
        f"{where}: no space is left; free some and give the same command again: what was finished "
        "is kept"
    )
