"""Settings: TOML text → frozen dataclasses and back. Unknown keys are errors at any depth.

A field declares its bounds, meaning, unit and source:
``Annotated[float, Meta(ge=0, description="search radius, m. Source: [L15] §III"), PUBLIC] = 8.0``.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import hashlib
import json
import math
import operator
import os
import re
import tomllib
import types
import typing
from collections.abc import Collection
from typing import Any, TypeVar

import msgspec

from engram.errors import ConfigError

T = TypeVar("T")


class Public:
    """Marks a field as a public setting: documented, and stable between versions.

    All others are for experts: they are in the resolved configuration, without promise.
    """


PUBLIC = Public()

_SIZE = re.compile(r"(?P<number>\d+(\.\d+)?)\s*(?P<unit>[kMGT]?i?B?)", re.ASCII)
_UNITS = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}
_UNITS |= {f"{name}i": 2 ** (10 * power) for power, name in enumerate("kMGT", start=1)}


def bytes_of(text: str) -> int | None:
    """Bytes of "200MB", "1.5 GiB" or "4096"; None if the text is not a size."""
    match = _SIZE.fullmatch(text.strip())
    unit = match["unit"].removesuffix("B") if match else ""
    if match is None or unit not in _UNITS:
        return None
    return int(float(match["number"]) * _UNITS[unit])


# Engram's own longest, all settings with what they mean, has 35,000 characters.
_MOST_CHARACTERS = 400_000
_MOST_DOTS = 100
_SHOWN_CHARACTERS = 80


def load_toml(text: str, kind: type[T], ignored: Collection[str] = ()) -> T:
    """Check TOML text against a dataclass and build it.

    Args:
        text: the text.
        kind: the dataclass.
        ignored: tables at the top that others read.

    Raises:
        ConfigError: the text is not TOML, a key is unknown at any depth, or a value has the wrong
            type or fails the dataclass's own checks.
    """
    return from_dict(read_toml(text), kind, ignored)


def read_toml(text: str) -> dict[str, Any]:
    """The values of a TOML text of any origin.

    Raises:
        ConfigError: it is not TOML, or beyond what settings and calibrations hold.
    """
    if len(text) > _MOST_CHARACTERS:
        raise ConfigError(f"{len(text)} characters, at most {_MOST_CHARACTERS} are read")
    for number, line in enumerate(text.splitlines(), start=1):
        # The parser takes time by the square of a key's parts.
        if line.count(".") > _MOST_DOTS and not line.lstrip().startswith("#"):
            raise ConfigError(f"line {number} has more than {_MOST_DOTS} dots: break it into lines")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also numbers of thousands of digits
        raise ConfigError(f"not valid TOML: {error}") from error


def from_dict(values: dict[str, Any], kind: type[T], ignored: Collection[str] = ()) -> T:
    """Build a dataclass from plain values; see `load_toml`."""
    _refuse_unknown_keys(values, kind, "", ignored)
    values = {key: value for key, value in values.items() if key not in ignored}
    try:
        return msgspec.convert(_over_defaults(values, kind), kind)
    except msgspec.ValidationError as error:
        raise ConfigError(_in_words(error, values)) from error


def _over_defaults(values: dict[str, Any], kind: Any) -> dict[str, Any]:
    """Values over the defaults of the tables that they are in.

    A table's default may differ from that of its type: what is not given keeps the former.
    """
    if not dataclasses.is_dataclass(kind):
        return values
    fields = {one.name: one for one in dataclasses.fields(kind)}
    return {key: _over(value, _default(fields[key])) for key, value in values.items()}


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is dataclasses.MISSING:
        return field.default
    return field.default_factory()


def _over(given: Any, default: Any) -> Any:
    """A value; over its default if both are tables."""
    if not isinstance(given, dict) or not dataclasses.is_dataclass(default):
        return given
    merged = {key: _over(value, getattr(default, key)) for key, value in given.items()}
    return to_dict(default) | merged


def _in_words(error: msgspec.ValidationError, values: dict[str, Any]) -> str:
    """A fault that msgspec found, by key and value; its path adds nothing to a fault of ours."""
    what, _, place = str(error).partition(" - at `$")
    if isinstance(error.__cause__, ConfigError):
        return what
    key, found = place.strip(".`"), typing.cast("Any", values)
    for part in key.split("."):
        found = found.get(part) if isinstance(found, dict) else None
    wanted = what.partition(", got")[0].replace("Expected ", "must be ").replace("`", "")
    if wanted.startswith("Invalid enum"):
        wanted = "not one of its names; engram settings show describes them"
    return f"{key} is {_shown(found)}: {wanted}"


def _shown(value: Any) -> str:
    """The beginning of a value of any size."""
    try:
        text = repr(value)
    except ValueError:  # an integer of thousands of digits
        return "a number of too many digits"
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}…"


def to_dict(config: Any) -> dict[str, Any]:
    """Plain values of a dataclass: the resolved configuration stored with every result."""
    plain: dict[str, Any] = msgspec.to_builtins(_spread(config))
    return plain


def _spread(value: Any) -> Any:
    """Dataclasses as dicts, at any depth.

    msgspec would leave out fields that it had filled in from their defaults.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {one.name: _spread(getattr(value, one.name)) for one in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: _spread(one) for key, one in value.items()}
    return value


def plain(value: Any) -> Any:
    """A value for JSON: dataclasses as objects, arrays as lists, ids and paths as text.

    Not-a-number and infinities become None, as JSON has none.
    """
    return msgspec.json.decode(_encode(_spread(value)))


def _of_other_kinds(value: Any) -> Any:
    import numpy as np

    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise NotImplementedError(f"{type(value).__name__} has no plain form")


_encode = msgspec.json.Encoder(enc_hook=_of_other_kinds).encode


def check_bounds(config: Any) -> None:
    """Checks the fields of a dataclass against their declared bounds; for ``__post_init__``.

    Raises:
        ConfigError: a value is out of its bounds or not finite.
    """
    kind: type = type(config)
    hints = _annotations(kind)
    for one in dataclasses.fields(config):
        value = getattr(config, one.name)
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{_prose(kind)}: {one.name} is {value}, must be finite")
        for bound in _bounds(hints[one.name]):
            if value is not None and (says := _broken(value, bound)):
                raise ConfigError(f"{_prose(kind)}: {one.name} is {value}, must be {says}")


def _bounds(hint: Any) -> tuple[Any, ...]:
    """The metadata declared with a field, or with the other arm of an optional one."""
    if typing.get_origin(hint) in {typing.Union, types.UnionType}:
        hint = hint.__args__[0]
    return getattr(hint, "__metadata__", ())


@functools.cache
def _annotations(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind, include_extras=True)


def _prose(kind: type) -> str:
    """The section name of a configuration, for people: "mapper" for MapperConfig."""
    name = kind.__name__.removesuffix("Config").removesuffix("Options")
    return "".join(f" {c.lower()}" if c.isupper() else c for c in name).strip()


def _broken(value: Any, bound: Any) -> str:
    """The bound that a value breaks, as text; empty if it breaks none."""
    if not isinstance(bound, msgspec.Meta):
        return ""
    limits = (
        (bound.ge, ">=", operator.ge),
        (bound.gt, ">", operator.gt),
        (bound.le, "<=", operator.le),
        (bound.lt, "<", operator.lt),
    )
    broken = [(sign, limit) for limit, sign, holds in limits if limit is not None]
    if all(holds(value, limit) for limit, _, holds in limits if limit is not None):
        return ""
    return " and ".join(f"{sign} {limit:g}" for sign, limit in broken)


def config_hash(config: Any) -> str:
    """Twelve hexadecimal digits that change when any setting does."""
    canonical = json.dumps(to_dict(config), sort_keys=True)
    return hashlib.sha256(canonical.encode()).hexdigest()[:12]


def _refuse_unknown_keys(values: Any, kind: Any, where: str, ignored: Collection[str] = ()) -> None:
    if isinstance(kind, types.UnionType):
        kind = next((arm for arm in kind.__args__ if dataclasses.is_dataclass(arm)), None)
    if not (dataclasses.is_dataclass(kind) and isinstance(values, dict)):
        return
    known = typing.get_type_hints(kind)
    for key, value in values.items():
        if key in ignored:
            continue
        if key not in known:
            names = sorted({*known, *ignored})
            near = "".join(
                f"did you mean {one}? " for one in difflib.get_close_matches(key, names, 1)
            )
            raise ConfigError(
                f"unknown setting '{where}{key:.{_SHOWN_CHARACTERS}}'; {near}known here: "
                f"{', '.join(names)}"
            )
        _refuse_unknown_keys(value, known[key], f"{where}{key}.")
