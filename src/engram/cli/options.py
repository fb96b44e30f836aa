"""What verbs share: options, help, where they write, and how they may end."""

from __future__ import annotations

import copy
import dataclasses
import functools
import inspect
import json
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Protocol, TypeAlias, runtime_checkable

import typer
from msgspec import Meta
from typer.core import TyperCommand

from engram.drive_options import DriveOptions
from engram.errors import EngramError, InputError, SequenceError
from engram.files import check_output, check_output_folder, check_there, map_path

if TYPE_CHECKING:
    from engram.cli.settings import AllSettings
    from engram.doctor.table import Finding
    from engram.robot.settings import RobotOptions
    from engram.sequences.opening import Drive as OpenDrive


# Widest first column of a table; a longer one has its meaning on the next line.
_COLUMN = 27
# Key of a context's `meta`: whether its help explains every option.
_ALL = "engram.all"


class Verb(TyperCommand):
    """A verb whose help explains the usual options, and the others with `--all`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Takes `--all` out of a request for help."""
        if "--all" in args and not {"--help", "-h"}.isdisjoint(args):
            ctx.meta[_ALL] = True
            args = [word for word in args if word != "--all"]
        return super().parse_args(ctx, args)

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The arguments in the line of usage."""
        del ctx
        arguments = [_typed(one) for one in self.params if one.param_type_name == "argument"]
        return [self.options_metavar or "", *arguments]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Tables of arguments and options, and the names of the options that are not explained."""
        taken: list[Any] = self.get_params(ctx)
        arguments = [one for one in taken if one.param_type_name == "argument"]
        usual = [one for one in taken if one not in arguments and not one.hidden]
        more = [one for one in taken if one not in arguments and one.hidden]
        if arguments:
            with formatter.section("Arguments"):
                rows = [(_typed(one), _meaning(one, ctx)) for one in arguments]
                formatter.write_dl(rows, col_max=_COLUMN)
        with formatter.section("Options"):
            formatter.write_dl([_record(one, ctx) for one in usual], col_max=_COLUMN)
        if not more:
            return
        with formatter.section("More options"):
            if ctx.meta.get(_ALL):
                formatter.write_dl([_record(one, ctx) for one in more], col_max=_COLUMN)
            else:
                formatter.write_text(" ".join(one.opts[0] for one in more))
                formatter.write_text(f"{ctx.command_path} --help --all explains them")


def _typed(argument: Any) -> str:
    """How an argument is typed: MAP, [REV], DRIVE..."""
    name = argument.metavar or argument.name.upper()
    many = "..." if argument.nargs != 1 else ""
    return f"{name}{many}" if argument.required else f"[{name}]{many}"


def _meaning(argument: Any, ctx: Any) -> str:
    return _record(argument, ctx)[1].removesuffix("[required]").rstrip()  # usage says so


def _record(parameter: Any, ctx: Any) -> tuple[str, str]:
    shown = copy.copy(parameter)
    shown.hidden = False
    typed, meaning = shown.get_help_record(ctx)
    return typed, " ".join(meaning.split()).replace("]. [", "; ")


def map_file(text: str) -> Path:
    """A map as it is typed: a file, never the address of a database.

    Raises:
        BadParameter: it is an address.
    """
    try:
        return map_path(text)
    except InputError as error:
        raise typer.BadParameter(str(error)) from error


MapPath: TypeAlias = Annotated[
    Path, typer.Argument(metavar="MAP", help="A map, NAME.engram.", parser=map_file)
]
DrivePath: TypeAlias = Annotated[
    Path,
    typer.Argument(metavar="DRIVE", help="A folder of stereo images, a ROS bag or a frame log."),
]
Json: TypeAlias = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
At: TypeAlias = Annotated[
    str | None,
    typer.Option("--at", metavar="REV", help="Read this revision: 7, a tag, head~2."),
]
Features: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--features",
        metavar="KIND",
        help="Features of a new map or log; engram features list [default: brief].",
    ),
]
Settings: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--config", metavar="FILE", help="A TOML file, or linegar2015 or gadd2016 (the papers')."
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive(DriveOptions):
    """How a drive is read; what is not given comes from the table `drive` of the settings."""

    taken: ClassVar[tuple[str, ...]] = (
        "frames", "robot", "recorded_at", "zone", "calibration", "left", "right", "motion",
    )  # fmt: skip

    def open(self, path: Path, settings: SettingsGiven) -> tuple[OpenDrive, AllSettings]:
        """The drive and the resolved settings; see `engram.open_drive` for the errors."""
        check_there(path, SequenceError)  # before half a second of imports

        from engram.sequences.opening import open_with

        resolved = settings.read()
        return open_with(path, self.over(resolved)), resolved

    def over(self, settings: AllSettings) -> DriveOptions:
        """The options as given, else as in the settings."""
        names = [one.name for one in dataclasses.fields(DriveOptions)]
        resolved = {name: getattr(settings.drive, name) for name in names}
        return DriveOptions(**{**resolved, **self._given()})

    def _given(self) -> dict[str, Any]:
        values = {one.name: getattr(self, one.name) for one in _declared_options(type(self))}
        return {name: value for name, value in values.items() if value not in (None, (), [])}

    def typed(self, *besides: str) -> list[str]:
        """The options that were given, as words of a command.

        Args:
            besides: names of fields that are left out.
        """
        words: list[str] = []
        for name, value in self._given().items():
            several = value if isinstance(value, list) else [value]
            if name not in besides:
                words += [word for each in several for word in (_flag(name), str(each))]
        return words


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen(Drive):
    """How a drive is read that is not kept: without when it was driven."""

    taken: ClassVar[tuple[str, ...]] = (
        "frames", "robot", "calibration", "left", "right", "motion",
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Effort:
    """How a robot drives; what is not given comes from the table `drive` of the settings."""

    ranking: Annotated[
        str | None,
        typer.Option(
            "--ranking",
            metavar="NAME",
            help="Which nodes to try first: recall, path, distance, … [default: recall].",
            hidden=True,
        ),
    ] = None

    memory: Annotated[
        str | None,
        typer.Option(
            "--memory",
            metavar="SIZE",
            help="Memory limit of the map's landmarks and graph: 200MB [default: 300MB].",
            hidden=True,
        ),
    ] = None

    def over(self, settings: AllSettings) -> dict[str, Any]:
        """How a robot drives: as given, else as in the settings."""
        drive = settings.drive
        if self.memory is not None:
            drive = dataclasses.replace(drive, memory=self.memory)
        return {
            "ranking": self.ranking or drive.ranking,
            "lanes": drive.lanes,
            "rounds": drive.rounds,
            "threads": drive.threads,
            "memory_bytes": drive.memory_bytes,
            "relocaliser": None if drive.relocaliser == "none" else drive.relocaliser,
        }


def driving_of(settings: AllSettings) -> RobotOptions:
    """How a robot drives by the settings alone."""
    from engram.robot.settings import RobotOptions

    return RobotOptions(**Effort().over(settings))


@dataclass(frozen=True, slots=True)
class SettingsGiven:
    """Where settings differ from the defaults."""

    config: Settings = None
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change one setting; repeatable."),
    ] = None

    def read(self) -> AllSettings:
        """The resolved settings; see `read_settings` for the errors."""
        from engram.cli.settings import read_settings

        return read_settings(self.config, self.changes or ())

    def typed(self) -> list[str]:
        """The options as words of a command."""
        words = [] if self.config is None else ["--config", str(self.config)]
        return [*words, *(word for one in self.changes or () for word in ("--set", one))]


def spread(verb: Callable[..., None]) -> Callable[..., None]:
    """Replaces each dataclass among a verb's parameters by its fields, one option each."""
    kinds = typing.get_type_hints(verb, include_extras=True)
    groups: dict[str, Any] = {
        name: kind for name, kind in kinds.items() if dataclasses.is_dataclass(kind)
    }
    parameters: list[inspect.Parameter] = []
    for one in inspect.signature(verb).parameters.values():
        if one.name in groups:
            parameters += _options_of(groups[one.name])
        else:
            parameters.append(one.replace(annotation=kinds[one.name]))

    @functools.wraps(verb)
    def run(*arguments: Any, **given: Any) -> None:
        for name, kind in groups.items():
            names = [one.name for one in _declared_options(kind)]
            given[name] = kind(**{option: given.pop(option) for option in names})
        verb(*arguments, **given)

    run.__annotations__ = {one.name: one.annotation for one in parameters}
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run


def _options_of(group: Any) -> list[inspect.Parameter]:
    kinds = typing.get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(
            one.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if one.default is dataclasses.MISSING else one.default,
            annotation=_as_option(one.name, kinds[one.name]),
        )
        for one in _declared_options(group)
    ]


def _declared_options(group: Any) -> list[Any]:
    """The fields of a group that are options of the verbs which take it: all, or some."""
    fields = dataclasses.fields(group)
    return [one for one in fields if one.name in getattr(group, "taken", {one.name})]


def _as_option(name: str, kind: Any) -> Any:
    """A field's annotation as Typer takes it: made of a `Meta` that has a `metavar`."""
    for mark in kind.__metadata__:
        if isinstance(mark, Meta) and mark.extra:
            metavar, rare = mark.extra["metavar"], mark.extra["rare"]
            option = typer.Option(_flag(name), metavar=metavar, help=mark.description, hidden=rare)
            return Annotated[_TYPED.get(name, str | None), option]
    return kind


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


# What is typed as something else than text.
_TYPED: dict[str, Any] = {"calibration": Path | None, "motion": list[str] | None}


class OutputError(EngramError):
    """The output of a verb cannot be written to its path."""


def _refusing(check: Callable[[str], Path]) -> Callable[[str], Path]:
    """The check as the parser of an argument or option."""

    def parse(text: str) -> Path:
        try:
            return check(text)
        except EngramError as error:
            # No ValueError: Typer would make a page of usage of it.
            raise OutputError(str(error)) from error

    return parse


def _file(text: str) -> Path:
    check_output(Path(text))
    return Path(text)


def _picture(text: str) -> Path:
    from engram.viewing.drawings import check_picture

    check_picture(Path(text))
    return Path(text)


def _folder(text: str) -> Path:
    check_output_folder(Path(text))
    return Path(text)


def _map(text: str) -> Path:
    path = map_file(text)
    check_output(path)
    return path


def _fleet_map(text: str) -> Path:
    """One that is there may be only looked at (`merge --dry-run`)."""
    path = map_file(text)
    return path if path.is_file() else _map(text)


def _recording(text: str) -> Path:
    return Path(text) if text == "window" else _file(text)


output_file = _refusing(_file)
output_picture = _refusing(_picture)
output_folder = _refusing(_folder)
output_map = _refusing(_map)
output_fleet_map = _refusing(_fleet_map)
output_recording = _refusing(_recording)

WrittenMap: TypeAlias = Annotated[
    Path, typer.Argument(metavar="MAP", help="A map, NAME.engram.", parser=output_map)
]
WrittenFleetMap: TypeAlias = Annotated[
    Path,
    typer.Argument(
        metavar="FLEET",
        help="The fleet map; created if it does not exist.",
        parser=output_fleet_map,
    ),
]


def _view(*, rare: bool = False) -> Any:
    return typer.Option(
        "--view",
        metavar="window|FILE.rrd",
        help="Watch it in Rerun, or write a recording.",
        parser=output_recording,
        hidden=rare,
    )


def _page(text: str) -> Path:
    from engram.viewing.drawings import matplotlib_for_files

    matplotlib_for_files()  # before the work, not after it
    if Path(text).suffix not in {".html", ".htm"}:
        raise InputError(f"{text}: a report is a page, NAME.html")
    return _file(text)


output_page = _refusing(_page)
Reported: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--report",
        metavar="FILE.html",
        help="Write a page with map, gaps and matches.",
        parser=output_page,
    ),
]
View: TypeAlias = Annotated[Path | None, _view()]
RareView: TypeAlias = Annotated[Path | None, _view(rare=True)]
Viewed: TypeAlias = Annotated[Path, _view()]


@runtime_checkable
class Report(Protocol):
    """What a verb found or did."""

    def to_dict(self) -> Mapping[str, Any]:
        """What ``--json`` prints."""
        ...

    def text(self) -> str:
        """What people read."""
        ...


def show(found: Any, text: str | Callable[[], str] | None = None, *, as_json: bool) -> None:
    """Prints a result.

    Args:
        found: a `Report`, or plain values for ``--json``.
        text: what people read, or what makes it; None for the report's own.
        as_json: whether machines read it.
    """
    if as_json:
        print(json.dumps(found.to_dict() if isinstance(found, Report) else found))
        return
    words = found.text() if text is None else text() if callable(text) else text
    if words:
        typer.echo(words)


class ExitStatus(IntEnum):
    """How a verb ended, for scripts. `docs/commands.md` has the same table."""

    meaning: str

    def __new__(cls, value: int, meaning: str) -> ExitStatus:
        """A status with what it means."""
        one = int.__new__(cls, value)
        one._value_ = value
        one.meaning = meaning
        return one

    DONE = 0, "done"
    DAMAGED_MAP = 1, "`check` found damage, or wrong edges"
    BAD_INPUT = 2, "the input cannot be used; one line says why and what to do"
    LOST_PARTS = 3, "parts of a drive were lost, by damage or wrong stamps; the rest was used"
    UNFIT_DRIVE = 4, "the drive has a fatal fault: `doctor` found it, or `map` refused it"
    NOT_TO_BE_TRUSTED = (
        5,
        "`localise`, `live`, `record` and `view` did it, but the drive has a fatal fault: do not "
        "trust the result",
    )
    INTERRUPTED = 130, "interrupted"
    READER_LEFT = 141, "the reader closed the output"  # as of a program that SIGPIPE ends


def untrusted_if(fatal: Sequence[Finding]) -> None:
    """Ends a verb that finished its work on an unfit drive.

    Raises:
        Exit: the doctor found something fatal; stderr says what.
    """
    if not fatal:
        return
    for one in fatal:
        typer.echo(f"not to be trusted: {one.text()}", err=True)
    raise typer.Exit(ExitStatus.NOT_TO_BE_TRUSTED)


class VerbInterruptedError(Exception):
    """A verb was stopped by Ctrl-C before it had a result."""


class PartlyDoneError(Exception):
    """A verb failed or was stopped after part of its work was committed.

    Attributes:
        error: what ended it.
        done: what ``--json`` prints of the committed part, in addition to the error.
    """

    def __init__(self, error: EngramError | VerbInterruptedError, done: Mapping[str, Any]) -> None:
        super().__init__(str(error))
        self.error = error
        self.done = done
