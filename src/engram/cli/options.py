"""What verbs share: options, help, where they write, and how they may end."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer
from typer.core import TyperCommand

from engram.errors import EngramError, InputError, SequenceError
from engram.files import check_output, check_output_folder, check_there, map_path

if TYPE_CHECKING:
    from engram.cli.settings import AllSettings
    from engram.doctor.table import Finding
    from engram.robot.settings import RobotOptions
    from engram.sequences.opening import Drive as OpenDrive
    from engram.sequences.sequence import OpenOptions


# In an option's help: the names of all layouts, which only the help itself is worth importing for.
LAYOUTS = "LAYOUTS"
# Widest first column of a table; a longer one has its meaning on the next line.
_COLUMN = 27


class Verb(TyperCommand):
    """A verb whose help names the options that few drives need without explaining them."""

    # Where those are explained.
    _EXPLAINED = "Also for drives, explained by engram drive info --help"

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The arguments in the line of usage."""
        del ctx
        arguments = [_typed(one) for one in self.params if one.param_type_name == "argument"]
        return [self.options_metavar or "", *arguments]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Tables of arguments and options, and the names of the options that are not explained."""
        arguments, options, others = [], [], []
        for one in self.get_params(ctx):
            if one.param_type_name == "argument":
                arguments.append((_typed(one), _meaning(one, ctx)))
            elif self._explains(one):
                options.append((one, ctx))
            else:
                others.append(one.opts[0])
        if arguments:
            with formatter.section("Arguments"):
                formatter.write_dl(arguments, col_max=_COLUMN)
        with formatter.section("Options"):
            formatter.write_dl([_record(*one) for one in options], col_max=_COLUMN)
        if others:
            with formatter.section(self._EXPLAINED):
                formatter.write_text(" ".join(others))

    def _explains(self, option: Any) -> bool:
        return not option.hidden


class VerbInFull(Verb):
    """A verb whose help explains those options, too."""

    def _explains(self, option: Any) -> bool:
        option.hidden = False
        return True


def _typed(argument: Any) -> str:
    """How an argument is typed: MAP, [REV], DRIVE..."""
    name = argument.metavar or argument.name.upper()
    many = "..." if argument.nargs != 1 else ""
    return f"{name}{many}" if argument.required else f"[{name}]{many}"


def _meaning(argument: Any, ctx: Any) -> str:
    return _record(argument, ctx)[1].removesuffix("[required]").rstrip()  # usage says so


def _record(parameter: Any, ctx: Any) -> tuple[str, str]:
    typed, meaning = parameter.get_help_record(ctx)
    if LAYOUTS in meaning:
        from engram.sequences.opening import layout_names

        meaning = meaning.replace(LAYOUTS, ", ".join(layout_names()))
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


def _british(word: str) -> str:
    """Both spellings of a rig's or a channel's name."""
    return {"color": "colour", "gray": "grey"}.get(word, word)


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
Lanes: TypeAlias = Annotated[
    int, typer.Option("--lanes", metavar="N", min=1, help="Match attempts in parallel (Np).")
]
Rounds: TypeAlias = Annotated[
    int,
    typer.Option(
        "--rounds", metavar="N", min=1, help="Rounds of attempts per frame (Nr); 32 when lost."
    ),
]
Relocaliser: TypeAlias = Annotated[
    str,
    typer.Option(
        "--relocaliser",
        metavar="NAME",
        help="How a lost robot is found: fabmap, signature (net), bag-of-words, exhaustive, none",
    ),
]
Features: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--features",
        metavar="KIND",
        help="Features of a new map or log; engram features list [default: brief].",
    ),
]
NoThumbnails: TypeAlias = Annotated[
    bool, typer.Option("--no-thumbnails", help="Store no small pictures with the nodes.")
]
Settings: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--config", metavar="FILE", help="A TOML file, or linegar2015 or gadd2016 (the papers')."
    ),
]


@dataclass(frozen=True, slots=True)
class Drive:
    """How a drive is read."""

    format: Annotated[
        str | None,
        typer.Option(
            "--format",
            metavar="NAME",
            help=f"{LAYOUTS} [default: detected].",
        ),
    ] = None
    rig: Annotated[
        str,
        typer.Option(
            "--rig",
            metavar="RIG",
            help="KITTI's cameras: grey or colour.",
            parser=_british,
            hidden=True,
        ),
    ] = "grey"
    channel: Annotated[
        str,
        typer.Option(
            "--channel",
            metavar="CHANNEL",
            help="What is taken of colour images: grey, red, green or blue.",
            parser=_british,
            hidden=True,
        ),
    ] = "grey"
    frames: Annotated[
        str | None,
        typer.Option("--frames", metavar="START:STOP:STEP", help="Only these frames: 0:100:2."),
    ] = None
    skip_bad: Annotated[
        bool,
        typer.Option("--skip-bad", help="Skip and count unreadable images.", hidden=True),
    ] = False
    robot: Annotated[
        str | None,
        typer.Option("--robot", metavar="NAME", help="Name of the robot [default: the drive's]."),
    ] = None
    recorded_at: Annotated[
        str | None,
        typer.Option("--recorded-at", metavar="TIME", help="Start of the drive in ISO 8601, UTC."),
    ] = None
    longitude: Annotated[
        float | None,
        typer.Option(
            "--longitude", metavar="DEG", help="Degrees east, for solar time.", hidden=True
        ),
    ] = None
    zone: Annotated[
        str | None,
        typer.Option("--zone", metavar="ZONE", help="Time zone of the drive: Europe/London."),
    ] = None
    from_: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="TIME",
            help="Begin here: seconds into the drive, or ISO 8601, UTC.",
            hidden=True,
        ),
    ] = None
    to: Annotated[
        str | None, typer.Option("--to", metavar="TIME", help="End here.", hidden=True)
    ] = None
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="FILE", help="TOML, Kalibr, ROS or OpenCV file."),
    ] = None
    field_of_view: Annotated[
        float | None,
        typer.Option(
            "--field-of-view",
            metavar="DEG",
            help="Field of view of the rectified images [default: the widest].",
            hidden=True,
        ),
    ] = None
    mask: Annotated[
        Path | None,
        typer.Option(
            "--mask",
            metavar="PNG",
            help="Image that is black where the robot sees itself.",
            hidden=True,
        ),
    ] = None
    left: Annotated[
        str | None,
        typer.Option("--left", metavar="TOPIC", help="Topic of a bag's left images.", hidden=True),
    ] = None
    right: Annotated[
        str | None,
        typer.Option(
            "--right", metavar="TOPIC", help="Topic of a bag's right images.", hidden=True
        ),
    ] = None
    motion: Annotated[
        list[str] | None,
        typer.Option(
            "--motion",
            metavar="TOPIC|FILE",
            help="Wheel odometry or gyroscope; repeatable.",
            hidden=True,
        ),
    ] = None

    def open(self, path: Path) -> OpenDrive:
        """The drive; see `engram.open_drive` for the errors."""
        check_there(path, SequenceError)  # before half a second of imports

        from engram.sequences.opening import open_with

        return open_with(path, self.options(), self.format)

    def options(self) -> OpenOptions:
        """How it is opened; see `OpenOptions` for the errors."""
        from engram.sequences.sequence import (
            Channel,
            FrameRange,
            OpenOptions,
            Rig,
            TimeRange,
            parse_choice,
            parse_time,
        )

        return OpenOptions(
            rig=parse_choice(Rig, self.rig),
            channel=parse_choice(Channel, self.channel),
            frames=FrameRange() if self.frames is None else FrameRange.parse(self.frames),
            times=TimeRange.parse(self.from_, self.to),
            skip_bad=self.skip_bad,
            robot=self.robot,
            recorded_at_ns=parse_time("--recorded-at", self.recorded_at),
            longitude_deg=self.longitude,
            zone=self.zone,
            calibration=self.calibration,
            field_of_view_deg=self.field_of_view,
            mask=self.mask,
            left=self.left,
            right=self.right,
            motion=tuple(self.motion or ()),
        )

    def typed(self, *besides: str) -> list[str]:
        """The options that were given, as words of a command.

        Args:
            besides: names of fields that are left out.
        """
        words: list[str] = []
        for one in dataclasses.fields(self):
            value, option = getattr(self, one.name), f"--{one.name.strip('_').replace('_', '-')}"
            if value == one.default or one.name in besides:
                continue
            if value is True:
                words.append(option)
            else:
                several = value if isinstance(value, list) else [value]
                words += [word for each in several for word in (option, str(each))]
        return words


@dataclass(frozen=True, slots=True)
class Effort:
    """Ranking and budget of a drive; what is not given comes from the settings."""

    ranking: Annotated[
        str | None,
        typer.Option(
            "--ranking",
            metavar="NAME",
            help="Which nodes to try first: recall, path, distance, … [default: recall].",
        ),
    ] = None
    lanes: Annotated[
        int | None,
        typer.Option(
            "--lanes", metavar="N", min=1, help="Match attempts in parallel (Np) [default: 2]."
        ),
    ] = None
    rounds: Annotated[
        int | None,
        typer.Option(
            "--rounds",
            metavar="N",
            min=1,
            help="Rounds of attempts per frame (Nr); 32 when lost [default: 2].",
        ),
    ] = None

    def over(self, settings: AllSettings) -> dict[str, Any]:
        """Ranking, lanes, rounds and threads: as given, else as in the settings."""
        drive = settings.drive
        return {
            "ranking": self.ranking or drive.ranking,
            "lanes": self.lanes or drive.lanes,
            "rounds": self.rounds or drive.rounds,
            "threads": drive.threads,
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
            names = [one.name for one in dataclasses.fields(kind)]
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
            annotation=kinds[one.name],
        )
        for one in dataclasses.fields(group)
    ]


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
    from engram.viewing.pictures import check_picture

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
_VIEW = typer.Option(
    "--view",
    metavar="window|FILE.rrd",
    help="Watch it in Rerun, or write a recording.",
    parser=output_recording,
)
View: TypeAlias = Annotated[Path | None, _VIEW]
Viewed: TypeAlias = Annotated[Path, _VIEW]


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
