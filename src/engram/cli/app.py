"""The `engram` program: its verbs, and what every one of them does with errors."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from typing import Annotated, Any, cast

import typer

from engram import PRE_RELEASE, __version__
from engram.cli.endings import ExitStatus, PartlyDoneError, VerbInterruptedError
from engram.cli.screen import UnwritableError, forget, screen
from engram.cli.verbs import Program, register
from engram.errors import EngramError, UnfitDriveError

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
        print(f"engram {__version__}, {PRE_RELEASE}")
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


register(app)

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
