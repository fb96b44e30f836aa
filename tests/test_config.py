"""Settings: strict at any depth."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
from msgspec import Meta

from engram.cli.settings import AllSettings, read_settings, settings_toml
from engram.config import check_bounds, config_hash, from_dict, load_toml, plain, to_dict
from engram.errors import ConfigError
from engram.mapper.mapper import MapperConfig
from engram.robot.settings import VERB_TABLES, Settings, load_settings


@dataclass(frozen=True)
class Inner:
    size: int = 3
    share: float = 0.5


@dataclass(frozen=True)
class Outer:
    name: str = "x"
    inner: Inner = field(default_factory=Inner)
    other: Inner = field(default_factory=lambda: Inner(share=0.25))
    maybe: Inner | None = None


@dataclass(frozen=True)
class Outermost:
    outer: Outer = field(default_factory=lambda: Outer(inner=Inner(size=9)))


def test_what_is_not_said_keeps_its_default() -> None:
    assert load_toml("[inner]\nsize = 7", Outer) == Outer(inner=Inner(size=7))


def test_a_table_keeps_its_own_default_where_its_type_has_another() -> None:
    assert load_toml("[other]\nsize = 7", Outer).other == Inner(7, 0.25)
    found = load_toml("[outer.inner]\nshare = 0.75", Outermost).outer
    assert found == Outer(inner=Inner(9, 0.75))
    assert load_toml('[outer]\nname = "y"', Outermost).outer.inner == Inner(9)


@pytest.mark.parametrize("text", ["nam = 1", "[inner]\nsiez = 1", "[maybe]\nsiez = 1"])
def test_a_misspelt_key_is_an_error_at_any_depth(text: str) -> None:
    with pytest.raises(ConfigError, match="unknown setting"):
        load_toml(text, Outer)


def test_tables_that_others_read_are_left_alone_and_named_where_a_name_is_near() -> None:
    text = "[inner]\nsize = 7\n[fleet]\nwhatever = 1"
    assert load_toml(text, Outer, {"fleet"}) == Outer(inner=Inner(size=7))
    with pytest.raises(ConfigError, match=r"unknown setting 'fleet'; known here: inner, "):
        load_toml(text, Outer)
    with pytest.raises(ConfigError, match=r"'fleat'; did you mean fleet\? known here: fleet, "):
        load_toml("[fleat]\nwhatever = 1", Outer, {"fleet"})
    with pytest.raises(ConfigError, match=r"'inner.fleet'; known here: share, size"):
        load_toml("[inner.fleet]\nwhatever = 1", Outer, {"fleet"})


def test_a_robot_reads_a_file_that_has_tables_of_the_fleet(tmp_path: Path) -> None:
    verbs = {one.name for one in fields(AllSettings)} - {one.name for one in fields(Settings)}
    assert verbs == VERB_TABLES
    path = tmp_path / "fleet.toml"
    path.write_text(settings_toml(AllSettings()) + "\n[odometri]\n")
    with pytest.raises(ConfigError, match=r"fleet.toml: .*'odometri'; did you mean odometry\?"):
        load_settings(path)
    changed = ["mapper.save_every_m=2", "merge.lanes=3"]
    path.write_text(settings_toml(read_settings(None, changed)))
    assert load_settings(path).mapper == MapperConfig(save_every_m=2.0)


@pytest.mark.parametrize("text", ["name = 3", "[inner]\nsize = 'three'", "= 3", "inner = 4"])
def test_wrong_types_and_broken_toml_are_errors(text: str) -> None:
    with pytest.raises(ConfigError):
        load_toml(text, Outer)


def test_hash_changes_with_any_setting_and_only_then() -> None:
    assert config_hash(Outer()) == config_hash(load_toml("", Outer))
    assert config_hash(Outer()) != config_hash(Outer(inner=Inner(share=0.6)))


def test_round_trip_through_plain_values() -> None:
    assert to_dict(Outer(inner=Inner(size=9)))["inner"] == {"size": 9, "share": 0.5}


@dataclass(frozen=True)
class Bounded:
    radius_m: Annotated[float, Meta(gt=0, le=100, description="m")] = 8.0
    most: Annotated[int | None, Meta(ge=1)] = None

    def __post_init__(self) -> None:
        check_bounds(self)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"radius_m": 0.0}, "bounded: radius_m is 0.0, must be > 0 and <= 100"),
        ({"radius_m": 101.0}, "must be > 0 and <= 100"),
        ({"radius_m": float("nan")}, "must be finite"),
        ({"most": 0}, "most is 0, must be >= 1"),
    ],
)
def test_bounds_declared_with_a_field_are_kept(values, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        Bounded(**values)
    assert Bounded(radius_m=100.0, most=1).most == 1


def test_plain_values_of_what_json_does_not_know() -> None:
    value = {"path": Path("a/b"), "points": np.eye(2), "worst": float("inf"), "config": Bounded()}
    assert plain(value) == {
        "path": "a/b",
        "points": [[1.0, 0.0], [0.0, 1.0]],
        "worst": None,
        "config": {"radius_m": 8.0, "most": None},
    }


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("abc", "mapper.save_every_m is 'abc': must be float"),
        (None, "mapper.save_every_m is None: must be float"),
        (-2.0, "mapper: save_every_m is -2.0, must be finite and >= 0"),
    ],
)
def test_a_wrong_value_is_named_by_its_key(value: object, words: str) -> None:
    with pytest.raises(ConfigError) as refused:
        from_dict({"mapper": {"save_every_m": value}}, Settings)
    assert str(refused.value) == words


def test_a_wrong_choice_is_named_by_its_key() -> None:
    with pytest.raises(ConfigError, match=r"localiser\.success is 'foo': not one of its names"):
        from_dict({"localiser": {"success": "foo"}}, Settings)
