"""Keywords of the public functions: a wrong one is an error that names the right ones."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from engram.errors import ConfigError

_P = ParamSpec("_P")
_T = TypeVar("_T")


def keywords(**meant: str) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """Makes a function refuse unknown keywords with a `ConfigError` in place of a `TypeError`.

    Args:
        **meant: other words for a keyword, and the keyword for each.
    """

    def checked(function: Callable[_P, _T]) -> Callable[_P, _T]:
        known = [
            parameter.name
            for parameter in inspect.signature(function).parameters.values()
            if parameter.name != "self" and parameter.kind is not parameter.POSITIONAL_ONLY
        ]

        @wraps(function)
        def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
            for unknown in kwargs.keys() - known:
                near = meant.get(unknown) or next(
                    iter(difflib.get_close_matches(unknown, known, 1)), None
                )
                question = "" if near is None else f"did you mean {near}? "
                raise ConfigError(
                    f"{function.__name__}() takes no keyword {unknown!r}; {question}"
                    f"It takes {', '.join(known)}"
                )
            return function(*args, **kwargs)

        return call

    return checked


def keywords_of(
    options: Callable[_P, Any], **meant: str
) -> Callable[[Callable[..., _T]], Callable[Concatenate[str | Path, _P], _T]]:
    """Gives a function of a path the keywords of a dataclass, for people and for type checkers.

    Args:
        options: the dataclass.
        **meant: as in `keywords`.
    """

    def declared(function: Callable[..., _T]) -> Callable[Concatenate[str | Path, _P], _T]:
        own = list(inspect.signature(function).parameters.values())[:1]
        taken = inspect.signature(options).parameters.values()
        function.__signature__ = inspect.Signature([*own, *taken])  # type: ignore[attr-defined]
        return keywords(**meant)(function)

    return declared
