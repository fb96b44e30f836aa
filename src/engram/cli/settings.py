"""All settings of a command: the defaults, a TOML file over them, `--set` over both."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import typing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from engram.config import PUBLIC, bytes_of, check_bounds, from_dict, read_toml, to_dict
from engram.drive_options import DriveOptions
from engram.errors import ConfigError
from engram.fleet.settings import BuildSettings, DownloadSettings, MergeSettings
from engram.frontend.frame import DescriptorKind
from engram.repair.finding import RepairConfig
from engram.robot.anchors import IslandsConfig
from engram.robot.settings import Settings, settings_text
from engram.weak_spots import WeakSpotsConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveSettings(DriveOptions):
    """How drives are opened, and how `map` and `localise` attempt; options count before them."""

    ranking: Annotated[
        str, Meta(description="which nodes to try first: recall, path, distance"), PUBLIC
    ] = "recall"
    lanes: Annotated[
        int, Meta(ge=1, description="attempts in parallel, Np. [L15] Fig. 3"), PUBLIC
    ] = 2
    rounds: Annotated[
        int, Meta(ge=1, description="rounds of attempts, Nr. [L15] Fig. 3"), PUBLIC
    ] = 2
    threads: (
        Annotated[
            int,
            Meta(
                ge=1,
                description="most threads of a robot, its loop included; none: one for "
                "each lane, and 2 to 4 that decode, read ahead, write and close loops",
            ),
            PUBLIC,
        ]
        | None
    ) = None
    memory: (
        Annotated[
            str,
            Meta(
                description="largest memory of the map's landmarks and graph, 200MB; none: 300 MB. "
                "A crowded place may take more",
            ),
            PUBLIC,
        ]
        | None
    ) = None
    relocaliser: Annotated[
        str,
        Meta(description="finds a lost robot: fabmap, signature (net), exhaustive, none"),
        PUBLIC,
    ] = "fabmap"

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.memory is not None and not self.memory_bytes:
            raise ConfigError(
                f"drive.memory is {self.memory!r}, must be a size such as 200MB, 1.5GiB or 4096"
            )

    @property
    def memory_bytes(self) -> int | None:
        """`memory` in bytes; None if it is not given."""
        return None if self.memory is None else bytes_of(self.memory)


@dataclass(frozen=True, slots=True)
class AllSettings(Settings):
    """What a settings file may contain: the robot's settings, then those of verbs."""

    drive: DriveSettings = field(default_factory=DriveSettings)
    merge: MergeSettings = field(default_factory=MergeSettings)
    build: BuildSettings = field(default_factory=BuildSettings)
    download: DownloadSettings = field(default_factory=DownloadSettings)
    repair: RepairConfig = field(default_factory=RepairConfig)
    islands: IslandsConfig = field(default_factory=IslandsConfig)
    weak_spots: WeakSpotsConfig = field(default_factory=WeakSpotsConfig)

    def of_robot(self, descriptor: str | None = None) -> Settings:
        """The part that maps and results keep.

        Args:
            descriptor: kind of descriptor that replaces the file's; None leaves it.

        Raises:
            ConfigError: there is no such kind.
        """
        names = [one.name for one in dataclasses.fields(Settings)]
        settings = Settings(**{name: getattr(self, name) for name in names})
        return settings.for_descriptor(None if descriptor is None else DescriptorKind(descriptor))


def read_settings(path: Path | None, changes: Sequence[str] = ()) -> AllSettings:
    """The defaults, changed by a file and then by `KEY=VALUE` texts.

    Raises:
        ConfigError: the file cannot be read, or a setting is unknown or out of range.
    """
    values = {} if path is None else _toml(path)
    try:
        from_file = from_dict(values, AllSettings)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    if not changes:
        return from_file
    for change in changes:
        _change(values, change)
    return from_dict(values, AllSettings)


def _toml(path: Path) -> dict[str, Any]:
    text = settings_text(path)
    try:
        return read_toml(text)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _change(values: dict[str, Any], change: str) -> None:
    key, equals, text = change.partition("=")
    tables = key.strip().split(".")
    if not equals or not all(tables):
        raise ConfigError(
            f"--set {change!r}: expected KEY=VALUE, such as mapper.save_every_m=2; "
            "engram settings show lists the keys"
        )
    for table in tables[:-1]:
        values = values.setdefault(table, {})
        if not isinstance(values, dict):
            raise ConfigError(f"--set {change!r}: {table} is a setting, not a table")
    values[tables[-1]] = _value(text.strip())


def _value(text: str) -> Any:
    """A TOML value; text that is not valid TOML is a string, so that nothing is quoted twice."""
    try:
        return read_toml(f"x = {text}")["x"]
    except ConfigError:
        return text


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting, as `engram settings show` lists it.

    Attributes:
        key: with its tables, "mapper.save_every_m".
        value: as resolved.
        description: unit, meaning and source.
        bounds: such as ">= 0"; empty where none are declared.
        public: whether it is documented and stable; others are for experts.
        changed: whether it differs from its default.
    """

    key: str
    value: Any
    description: str
    bounds: str
    public: bool
    changed: bool

    @property
    def comment(self) -> str:
        """Bounds and the first sentence of the description, for a line on the screen."""
        first = self.description.split(". ")[0].rstrip(".")
        return "  ".join(text for text in (self.bounds, first) if text)


def every_setting(settings: AllSettings) -> Iterator[Setting]:
    """All settings, in the order of their declaration."""
    return _settings_in(settings, AllSettings(), "")


def _settings_in(settings: Any, defaults: Any, tables: str) -> Iterator[Setting]:
    """Those of a dataclass at any depth."""
    hints = typing.get_type_hints(type(settings), include_extras=True)
    documented = _documented(type(settings))
    for one in dataclasses.fields(settings):
        value, key = getattr(settings, one.name), f"{tables}{one.name}"
        if dataclasses.is_dataclass(value):
            yield from _settings_in(value, getattr(defaults, one.name), f"{key}.")
            continue
        marks = _annotations(hints[one.name])
        metas = [mark for mark in marks if isinstance(mark, Meta)]
        words = "; ".join(m.description for m in metas if m.description)
        words = words or documented.get(one.name, "")
        yield Setting(
            key,
            to_dict({"": value})[""],
            words,
            bounds=", ".join(map(_bounds, metas)),
            public=PUBLIC in marks,
            changed=value != getattr(defaults, one.name),
        )


def _documented(kind: type) -> dict[str, str]:
    """Descriptions of a configuration's attributes, from its docstring."""
    _, _, section = (inspect.getdoc(kind) or "").partition("Attributes:\n")
    found = {}
    for entry in re.split(r"\n {4}(?=\w)", "\n" + section.split("\n\n")[0]):
        names, _, text = " ".join(entry.split()).partition(": ")
        found.update(dict.fromkeys(names.split(", "), text))
    return found


def _annotations(kind: Any) -> list[Any]:
    """The metadata declared with a type, or with the other arm of an optional one."""
    within = [one for arm in typing.get_args(kind) for one in getattr(arm, "__metadata__", ())]
    return [*getattr(kind, "__metadata__", ()), *within]


def _bounds(meta: Meta) -> str:
    signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
    given = [(sign, getattr(meta, name)) for name, sign in signs.items()]
    return ", ".join(f"{sign} {limit:g}" for sign, limit in given if limit is not None)


def shown_settings(settings: AllSettings, *, every: bool) -> list[Setting]:
    """The public settings and those that were changed, or every one."""
    return [one for one in every_setting(settings) if every or one.public or one.changed]


def listed_settings(settings: AllSettings, *, every: bool) -> str:
    """The settings as people read them, one a line."""
    return "\n".join(
        f"{one.key} = {json.dumps(one.value)}" + (f"  # {words}" if (words := one.comment) else "")
        for one in shown_settings(settings, every=every)
    )


def settings_toml(settings: AllSettings, *, every: bool = True) -> str:
    """The settings as a file that `--config` reads; a setting that is not given is a comment."""
    lines: list[str] = []
    table = None
    for one in shown_settings(settings, every=every):
        above, _, name = one.key.rpartition(".")
        if above != table:
            lines += ["", f"[{above}]"]
            table = above
        words = one.comment
        value = f"{name} = {json.dumps(one.value)}" if one.value is not None else f"# {name} ="
        lines.append(f"{value}  # {words}" if words else value)
    return "\n".join(lines[1:])
