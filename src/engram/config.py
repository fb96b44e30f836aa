"""Settings: TOML text → frozen dataclasses and back. Unknown keys are errors at any depth."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import tomllib
import types
import typing
from typing import Any, TypeVar

import msgspec

from engram.errors import ConfigError

T = TypeVar("T")


def load_toml(text: str, kind: type[T]) -> T:
    """Check TOML text against a dataclass and build it.

    Raises:
        ConfigError: the text is no TOML, a key is unknown at any depth, or a value has the wrong
            type or fails the dataclass's own checks.
    """
    try:
        values = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also numbers of thousands of digits
        raise ConfigError(f"not valid TOML: {error}") from error
    return from_dict(values, kind)


def from_dict(values: dict[str, Any], kind: type[T]) -> T:
    """Build a dataclass from plain values; see `load_toml`."""
    _refuse_unknown_keys(values, kind, where="")
    try:
        return msgspec.convert(values, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(str(error)) from error


def to_dict(config: Any) -> dict[str, Any]:
    """Plain values of a dataclass: the resolved configuration that is kept with every result."""
    plain: dict[str, Any] = msgspec.to_builtins(_spread(config))
    return plain


def _spread(value: Any) -> Any:
    """Dataclasses as dicts, at any depth.

    msgspec would do it, but leaves out fields that it itself had filled in from their defaults.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {one.name: _spread(getattr(value, one.name)) for one in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: _spread(one) for key, one in value.items()}
    return value


def config_hash(config: Any) -> str:
    """Twelve hexadecimal digits that change when any setting does."""
    canonical = json.dumps(to_dict(config), sort_keys=True)
    return hashlib.sha256(canonical.encode()).hexdigest()[:12]


def _refuse_unknown_keys(values: Any, kind: Any, where: str) -> None:
    if isinstance(kind, types.UnionType):
        kind = next((arm for arm in kind.__args__ if dataclasses.is_dataclass(arm)), None)
    if not (dataclasses.is_dataclass(kind) and isinstance(values, dict)):
        return
    known = typing.get_type_hints(kind)
    for key, value in values.items():
        if key not in known:
            raise ConfigError(
                f"unknown setting '{where}{key}'; known here: {', '.join(sorted(known))}"
            )
        _refuse_unknown_keys(value, known[key], f"{where}{key}.")
