"""The `engram` program: its verbs, and what every one of them does with errors."""

from __future__ import annotations

import json
import sys

import typer

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

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


class VerbInterruptedError(Exception):
    """A verb was stopped by Ctrl-C before it had a result."""


def main() -> None:
    """Runs the program; an error that Engram foresaw is one line, never a traceback."""
    from engram.cli import verbs  # registers the verbs on `app`

    verbs.register(app)
    try:
        app()
    except EngramError as error:
        _complain(error)
        sys.exit(EXIT_BAD_INPUT)
    except VerbInterruptedError as error:
        _complain(error)
        sys.exit(EXIT_INTERRUPTED)


def _complain(error: Exception) -> None:
    kind = type(error).__name__
    if "--json" in sys.argv:
        print(json.dumps({"error": {"kind": kind, "message": str(error)}}))
    print(f"engram: {error}", file=sys.stderr)
