"""What other installed packages add to Engram, by entry points.

A package names a ranking policy, a place recogniser, a reader of drives, a kind of features or a
verb in its `pyproject.toml`. Whatever comes in is checked where it is loaded; `examples/` shows
how.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from engram.errors import ConfigError, EngramError, IncompatibleError

T = TypeVar("T")

# What the laboratory adds: a map or a settings file may name it where it is not installed.
_OF_THE_LABORATORY = {
    "path-near": "engram-lab",
    "bag-of-words": "engram-lab",
    "teblid": "engram-lab[teblid]",
}


def where_from(name: str) -> str:
    """The package that brings a name, for an error about it; "" if none is known."""
    package = _OF_THE_LABORATORY.get(name)
    return "" if package is None else f", which comes with {package}"


@dataclass(frozen=True, slots=True)
class PluginGroup(Generic[T]):
    """One kind of thing that packages add.

    Attributes:
        group: its group of entry points, such as "engram.policies".
        what: what one of them is called in messages.
        accept: makes the usable thing of an entry's name and the object that it names. Raises a
            ConfigError that says what is wrong with an object that does not fit.
    """

    group: str
    what: str
    accept: Callable[[str, Any], T]

    def names(self) -> list[str]:
        """The names that packages add, sorted; nothing is imported."""
        return sorted({entry.name for entry in self._entries()})

    def load(self, name: str) -> T:
        """The thing of one of `names()`."""
        entries = [entry for entry in self._entries() if entry.name == name]
        if len(entries) > 1:
            packages = " and ".join(sorted(_package(entry) for entry in entries))
            raise IncompatibleError(
                f"{self.what} {name!r} is provided by {packages}; uninstall all but one of them"
            )
        (entry,) = entries
        try:
            return self.accept(name, entry.load())
        except Exception as error:  # the code of others may fail in any way
            reason = str(error) if isinstance(error, EngramError) else _named(error)
            raise IncompatibleError(
                f"{self.what} {name!r} of {_package(entry)} cannot be used: {reason}; fix that "
                "package or uninstall it"
            ) from error

    def _entries(self) -> list[EntryPoint]:
        return list(_installed().select(group=self.group))


def check_is(found: object, kind: type[T]) -> T:
    """The object, if it is of that kind."""
    if isinstance(found, kind):
        return found
    raise ConfigError(
        f"{found!r} is of type {type(found).__name__}, must be {kind.__module__}.{kind.__name__}"
    )


@cache
def _installed() -> Any:
    """All entry points of this environment: one search for all groups."""
    return entry_points()


def _package(entry: EntryPoint) -> str:
    return "a package" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"


def _named(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
