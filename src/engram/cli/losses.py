"""How a bag was read, and the exit status if parts of it were lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from engram.sequences import Drive

EXIT_DAMAGED = 3


def tell_losses(sequence: Drive) -> None:
    """Says on stderr how a bag's images were paired, and what could not be read.

    Raises:
        Exit: parts of the bag were lost; what could be read was used.
    """
    from engram.sequences import BagSequence

    if not isinstance(sequence, BagSequence):
        return
    if sequence.pairing.left:
        typer.echo(sequence.pairing.text(), err=True)
    if sequence.lost:
        typer.echo("the bag is damaged; what could be read was used:", err=True)
        for loss in sequence.lost:
            typer.echo(f"  {loss}", err=True)
        raise typer.Exit(EXIT_DAMAGED)
