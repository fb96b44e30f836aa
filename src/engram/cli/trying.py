"""`engram try`: two drives that ship, and the first tour on them."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options
from engram.cli.options import ExitStatus, VerbInterruptedError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_INTERRUPTED = "interrupted; what was done is kept, and the same command resumes"


@dataclass(frozen=True, slots=True)
class Step:
    """One command of the tour.

    Attributes:
        about: what it is for.
        words: of the command, without `engram`.
        extra: module that it needs and the extra that brings it; None if it needs none.
        runs: whether the tour runs it, or only names it.
    """

    about: str
    words: tuple[str, ...]
    extra: tuple[str, str] | None = None
    runs: bool = True

    @property
    def typed(self) -> str:
        """The command as one types it."""
        return shlex.join(["engram", *self.words])


def try_(
    ctx: typer.Context,
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="FOLDER",
            help="Folder for drives, map and pictures.",
            parser=options.output_folder,
        ),
    ] = Path("engram-try"),
    drives_only: Annotated[
        bool, typer.Option("--drives-only", help="Write the two drives, and run nothing.")
    ] = False,
) -> None:
    """Try Engram on two short drives that ship.

    Writes two simulated drives of one street, 6 MB, maps the first, localises the second, and shows
    each command before it runs. It takes seconds and needs no network. The same command resumes.

    \b
    Examples:
      engram try
      engram try --out /tmp/first
      engram try --drives-only --out drives
    """
    try:
        _write_drives(out)
        if not drives_only:
            _tour(ctx, out)
    except (KeyboardInterrupt, VerbInterruptedError):
        raise VerbInterruptedError(_INTERRUPTED) from None


def _write_drives(out: Path) -> None:
    from engram.cli.screen import Bars
    from engram.sample.drives import DRIVES, write_drives

    write_drives(out, Bars())
    typer.echo("Two drives of one street by one robot. They are simulated:")
    for one in DRIVES:
        typer.echo(f"  {out / one.name}: {one.about}")


def steps(out: Path) -> Iterator[Step]:
    """The tour through a folder that holds the drives."""
    monday, tuesday, street = str(out / "monday"), str(out / "tuesday"), str(out / "street.engram")
    yield Step("Is a drive sound?", ("doctor", monday))
    yield Step("What does it hold?", ("drive", "info", monday))
    yield Step("Make a map of it.", ("map", street, monday))
    yield Step(
        "Find the next day's drive in the map.",
        ("localise", street, tuesday, "--pictures", str(out / "matches"), *_page(out)),
    )
    yield Step(
        "Draw the map from above.",
        ("plot", street, str(out / "map.png")),
        extra=("matplotlib", "plots"),
    )
    yield Step(
        "To watch the drive in the Rerun viewer:",
        ("view", street, tuesday),
        extra=("rerun", "view"),
        runs=False,
    )


def _page(out: Path) -> tuple[str, ...]:
    """The option that makes a page of the drive, where what draws it is installed."""
    return () if find_spec("matplotlib") is None else ("--report", str(out / "tuesday.html"))


def _tour(ctx: typer.Context, out: Path) -> None:
    """Runs the steps as the program would.

    Raises:
        Exit: a step failed.
        VerbInterruptedError: it was interrupted.
    """
    for step in steps(out):
        typer.echo(f"\n{step.about}\n$ {step.typed}")
        if step.extra is not None and find_spec(step.extra[0]) is None:
            module, extra = step.extra
            typer.echo(f"({module} is not installed: pip install 'engram-localisation[{extra}]')")
        elif step.runs and (status := _run(ctx, step)):
            raise typer.Exit(status)
    _end(out)


def _run(ctx: typer.Context, step: Step) -> int:
    """Runs a command in this process; its exit status.

    Raises:
        VerbInterruptedError: it was interrupted.
    """
    status = int(ctx.find_root().command.main(list(step.words), standalone_mode=False) or 0)
    if status == ExitStatus.INTERRUPTED:
        raise VerbInterruptedError("interrupted")
    return status


def _end(out: Path) -> None:
    """How right it was, what to look at, and what comes next."""
    from engram.sample.drives import offsets_m

    street = out / "street.engram"
    typer.echo(f"\n{_how_right(offsets_m(street, out))}")
    typer.echo(
        f"Look at {' or '.join([*_page(out)[1:], str(out / 'matches')])}: what a frame shares "
        "with the node that it matched. Tuesday's "
        "last 7 m lie beyond Monday's drive.\n\n"
        "Add what Tuesday's drive has seen for the first time:\n"
        f"  {shlex.join(['engram', 'map', str(street), str(out / 'tuesday')])}\n"
        "Your own drive, a ROS bag or a folder of stereo images:\n"
        "  engram doctor DRIVE\n"
        "  engram map own.engram DRIVE"
    )


def _how_right(offsets_m: NDArray[np.float64]) -> str:
    """The errors of fixes, in words."""
    import numpy as np

    if not len(offsets_m):
        return "No frame was localised."
    return (
        f"The true poses are known, as the drives are simulated: of {len(offsets_m)} fixes, half "
        f"are within {100 * np.median(offsets_m):.1f} cm of them, all within "
        f"{100 * offsets_m.max():.1f} cm."
    )
