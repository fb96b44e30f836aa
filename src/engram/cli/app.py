"""The `engram` program: its verbs, and what every one of them does with errors."""

from __future__ import annotations

import json
import sys
from typing import cast

import typer

from engram.cli.verbs import VerbInterruptedError, register
from engram.errors import EngramError

app = typer.Typer(
    name="engram",
    help="Lifelong visual localisation for fleets of robots with stereo cameras.",
    epilog="Start with: engram demo --out demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

register(app)

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130

# What Typer raises for any mistyped command line; of its kinds it exports only this one's child.
_UsageError = cast("type[typer.BadParameter]", typer.BadParameter.__mro__[1])


def main() -> None:
    """Runs the program; an error that Engram foresaw is one line, never a traceback."""
    try:
        code = app(prog_name="engram", standalone_mode=False)
    except _UsageError as error:  # a verb or option that is mistyped
        _tell_machines(error.format_message(), type(error).__name__)
        error.show()
        sys.exit(error.exit_code)
    except typer.Abort:
        _complain(VerbInterruptedError("interrupted"))
        sys.exit(EXIT_INTERRUPTED)
    except EngramError as error:
        _complain(error)
        sys.exit(EXIT_BAD_INPUT)
    except VerbInterruptedError as error:
        _complain(error)
        sys.exit(EXIT_INTERRUPTED)
    sys.exit(code)


def _complain(error: Exception) -> None:
    _tell_machines(str(error), type(error).__name__)
    print(f"engram: {error}", file=sys.stderr)


def _tell_machines(message: str, kind: str) -> None:
    if "--json" in sys.argv:
        print(json.dumps({"error": {"kind": kind, "message": message}}))
