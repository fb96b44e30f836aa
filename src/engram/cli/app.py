"""The `engram` program: its verbs in their groups, and what every one of them does with errors."""

from __future__ import annotations

import functools
import inspect
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, cast

import typer
from typer.core import TyperCommand, TyperGroup

from engram import __version__
from engram.cli.drive import drive_group, live
from engram.cli.drives import doctor, localise, map_, record
from engram.cli.frame import anchor, export, goal
from engram.cli.history import diff, log, revert, show, tag
from engram.cli.maps import amend, check, info, plot, upgrade, view, vocabulary
from engram.cli.options import ExitStatus, PartlyDoneError, Verb, VerbInterruptedError, spread
from engram.cli.reports import evaluate, report
from engram.cli.screen import UnwritableError, forget, screen
from engram.cli.showing import features, settings
from engram.cli.trying import try_
from engram.cli.weakness import weak_spots
from engram.errors import ConfigError, EngramError, IncompatibleError, InputError, UnfitDriveError
from engram.fleet.cli.joined import FLEET_GROUPS, FLEET_VERBS
from engram.plugins import PluginGroup

GROUPS: dict[str, dict[str, Callable[..., None]]] = {
    "Drives": {
        "try": try_,
        "doctor": doctor,
        "map": map_,
        "localise": localise,
        "evaluate": evaluate,
        "report": report,
        "record": record,
        "live": live,
    },
    "Maps": {
        "info": info,
        "plot": plot,
        "weak-spots": weak_spots,
        "view": view,
        "check": check,
        "amend": amend,
        "upgrade": upgrade,
        "vocabulary": vocabulary,
        "anchor": anchor,
        "goal": goal,
        "export": export,
    },
    "History": {"log": log, "show": show, "diff": diff, "tag": tag, "revert": revert},
    "Fleet": FLEET_VERBS,
    "Settings": {"settings": settings, "features": features},
}
VERBS = {name: verb for group in GROUPS.values() for name, verb in group.items()}

# Verbs with verbs of their own.
NESTED: dict[str, dict[str, typer.Typer]] = {
    "Drives": {"drive": drive_group},
    "Service": FLEET_GROUPS,
}

# What the laboratory brings, a distribution of its own.
LABORATORY = ("demo", "lab")
# Other spellings of a verb.
SPELLINGS = {"localize": "localise"}
# Section of the verbs that installed packages add.
_ADDED = "Lab"
_RESUMABLE = "interrupted; finished parts are kept, and the same command resumes"


class Verbs(Mapping[str, Any]):
    """Every verb and group of verbs by name; each is made when it is first looked up.

    A command line needs one of them, and making all takes longer than most of what they do.
    """

    def __init__(self) -> None:
        self._made: dict[str, Any] = {}
        groups = {name for groups in NESTED.values() for name in groups}
        added = [name for name in _PLUGINS.names() if name not in {*VERBS, *groups}]
        self._sections = {
            **{name: title for title, verbs in GROUPS.items() for name in verbs},
            **dict.fromkeys(added, _ADDED),
            **{name: title for title, groups in NESTED.items() for name in groups},
        }

    def section(self, name: str) -> str:
        """Title of the help's section that lists a verb."""
        return self._sections[name]

    def summary(self, name: str) -> str:
        """First line of a verb's help."""
        verb = _verb(name)
        text = verb.info.help if isinstance(verb, typer.Typer) else inspect.getdoc(verb)
        return str(text or "").partition("\n")[0]

    def __getitem__(self, name: str) -> Any:
        """The verb as a command, or the group."""
        if name not in self._sections:
            raise KeyError(name)
        if name not in self._made:
            self._made[name] = _command(name)
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        """The names, section by section."""
        return iter(self._sections)

    def __len__(self) -> int:
        """Verbs and groups."""
        return len(self._sections)


class Program(TyperGroup):
    """Lists verbs by group, and accepts other spellings."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.commands: Any = Verbs()

    def list_commands(self, ctx: Any) -> list[str]:
        """The names of all verbs."""
        del ctx
        return list(self.commands)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """One section of the help for each group."""
        del ctx
        width = max(map(len, self.commands))
        for title in dict.fromkeys(map(self.commands.section, self.commands)):
            with formatter.section(title):
                formatter.write_dl(
                    [
                        (f"{name:{width}}", self.commands.summary(name))
                        for name in self.commands
                        if self.commands.section(name) == title
                    ]
                )

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The verb of this name, in either spelling."""
        return super().get_command(ctx, SPELLINGS.get(cmd_name, cmd_name))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The verb that the arguments begin with.

        Raises:
            InputError: it comes with the laboratory, which is not installed.
        """
        if args[0] in LABORATORY and args[0] not in self.commands:
            raise InputError(
                f"`engram {args[0]}` comes with engram-lab, which is not installed; from "
                "a checkout of Engram: pip install ./lab"
            )
        return super().resolve_command(ctx, args)


def _verb(name: str) -> Callable[..., None] | typer.Typer:
    """A verb's function, or a group of verbs; one that cannot be used says so when it runs."""
    if name in VERBS:
        return VERBS[name]
    for groups in NESTED.values():
        if name in groups:
            return groups[name]
    try:
        return _PLUGINS.load(name)
    except IncompatibleError as error:
        return _refusal(error)


def _command(name: str) -> Any:
    verb = _verb(name)
    alone = typer.Typer(add_completion=False, rich_markup_mode=None)
    if isinstance(verb, typer.Typer):
        alone.add_typer(_prepared(verb), name=name)
        return cast("TyperGroup", typer.main.get_command(alone)).commands[name]
    broken = getattr(verb, "broken", False)
    anything = {"ignore_unknown_options": broken, "allow_extra_args": broken}
    alone.command(name, cls=Verb, context_settings=anything)(_tells_of_interruption(spread(verb)))
    return typer.main.get_command(alone)


def _refusal(error: IncompatibleError) -> Callable[[], None]:
    def refused() -> None:
        """Cannot be used: its package is broken."""
        raise error

    refused.broken = True  # type: ignore[attr-defined]
    return refused


def _checked(name: str, found: Any) -> Callable[..., None] | typer.Typer:
    del name
    if isinstance(found, typer.Typer) or inspect.isfunction(found):
        return found
    raise ConfigError(f"{found!r} is of type {type(found).__name__}, must be a function or a Typer")


# Functions, or Typer groups of them.
_PLUGINS = PluginGroup("engram.verbs", "verb", _checked)


@functools.cache
def _prepared(group: typer.Typer) -> typer.Typer:
    """The same for every verb of a group, and of the groups in it."""
    for command in group.registered_commands:
        assert command.callback is not None
        command.callback = _tells_of_interruption(spread(command.callback), _RESUMABLE)
        command.cls = command.cls if issubclass(command.cls or TyperCommand, Verb) else Verb
    for inner in group.registered_groups:
        assert inner.typer_instance is not None
        _prepared(inner.typer_instance)
    return group


def _tells_of_interruption(
    verb: Callable[..., None], told: str = "interrupted; nothing had been saved yet"
) -> Callable[..., None]:
    """Reports Ctrl-C like any other end, if the verb itself has nothing more to save."""

    @functools.wraps(verb)
    def run(*arguments: Any, **options: Any) -> None:
        try:
            verb(*arguments, **options)
        except KeyboardInterrupt:
            raise VerbInterruptedError(told) from None

    return run


app = typer.Typer(
    name="engram",
    cls=Program,
    help="Lifelong visual localisation for fleets of robots with stereo cameras.",
    epilog="Start with: engram try, or engram map street.engram DRIVE",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(asked: bool) -> None:
    if asked:
        print(f"engram {__version__}")
        raise typer.Exit


@app.callback()
def _program(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    del version  # printed by its callback


# What Typer raises for any mistyped command line; of its kinds it exports only this one's child.
_UsageError = cast("type[typer.BadParameter]", typer.BadParameter.__mro__[1])


def main() -> None:
    """Runs the program; an error that Engram foresaw is one line, never a traceback."""
    try:
        with screen():
            _run()
    except UnwritableError as error:
        forget(sys.stdout)
        if error.reader_left:
            sys.exit(ExitStatus.READER_LEFT)
        print(f"engram: {error}", file=sys.stderr)
        sys.exit(ExitStatus.BAD_INPUT)


def _run() -> None:
    try:
        code = app(prog_name="engram", standalone_mode=False)
    except _UsageError as error:  # a verb or option that is mistyped
        _tell_machines(error.format_message(), type(error).__name__)
        error.show()
        sys.exit(error.exit_code)
    except typer.Abort:
        _complain(VerbInterruptedError("interrupted"))
        sys.exit(ExitStatus.INTERRUPTED)
    except PartlyDoneError as partly:
        _complain(partly.error, partly.done)
        sys.exit(_status_of(partly.error))
    except (EngramError, VerbInterruptedError) as error:
        _complain(error)
        sys.exit(_status_of(error))
    except AttributeError as error:  # after an update whose C++ part was not built
        if getattr(error.obj, "__name__", "") != "engram._core":
            raise
        _complain(
            EngramError(
                f"the compiled core is older than the program: it has no {error.name}; build it "
                "again with make setup or pip install ."
            )
        )
        sys.exit(ExitStatus.BAD_INPUT)
    sys.exit(code)


def _status_of(error: EngramError | VerbInterruptedError) -> int:
    if isinstance(error, VerbInterruptedError):
        return ExitStatus.INTERRUPTED
    return ExitStatus.UNFIT_DRIVE if isinstance(error, UnfitDriveError) else ExitStatus.BAD_INPUT


def _complain(error: Exception, done: Mapping[str, Any] | None = None) -> None:
    _tell_machines(str(error), type(error).__name__, done)
    print(f"engram: {error}", file=sys.stderr)


def _tell_machines(message: str, kind: str, done: Mapping[str, Any] | None = None) -> None:
    if "--json" in sys.argv:
        print(json.dumps({**(done or {}), "error": {"kind": kind, "message": message}}))
