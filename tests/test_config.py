"""Settings: strict at any depth."""

from dataclasses import dataclass, field

import pytest

from engram.config import config_hash, load_toml, to_dict
from engram.errors import ConfigError


@dataclass(frozen=True)
class Inner:
    size: int = 3
    share: float = 0.5


@dataclass(frozen=True)
class Outer:
    name: str = "x"
    inner: Inner = field(default_factory=Inner)
    maybe: Inner | None = None


def test_what_is_not_said_keeps_its_default() -> None:
    assert load_toml("[inner]\nsize = 7", Outer) == Outer(inner=Inner(size=7))


@pytest.mark.parametrize("text", ["nam = 1", "[inner]\nsiez = 1", "[maybe]\nsiez = 1"])
def test_a_misspelt_key_is_an_error_at_any_depth(text: str) -> None:
    with pytest.raises(ConfigError, match="unknown setting"):
        load_toml(text, Outer)


@pytest.mark.parametrize("text", ["name = 3", "[inner]\nsize = 'three'", "= 3", "inner = 4"])
def test_wrong_types_and_broken_toml_are_errors(text: str) -> None:
    with pytest.raises(ConfigError):
        load_toml(text, Outer)


def test_hash_changes_with_any_setting_and_only_then() -> None:
    assert config_hash(Outer()) == config_hash(load_toml("", Outer))
    assert config_hash(Outer()) != config_hash(Outer(inner=Inner(share=0.6)))


def test_round_trip_through_plain_values() -> None:
    assert to_dict(Outer(inner=Inner(size=9)))["inner"] == {"size": 9, "share": 0.5}
