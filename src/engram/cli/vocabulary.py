"""`engram vocabulary`."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options


class VocabularyAction(StrEnum):
    """What to do with a vocabulary."""

    TRAIN = "train"
    USE = "use"
    SHOW = "show"


def vocabulary(
    action: Annotated[VocabularyAction, typer.Argument(help="train, use or show.")],
    map_path: options.MapPath,
    sources: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[SOURCE]...",
            help="Maps and drives to train on [default: the map itself]; for use, whose to take.",
        ),
    ] = None,
    *,
    words: Annotated[int, typer.Option("--words", help="How many words to find.")] = 10_000,
    seed: Annotated[int, typer.Option("--seed", help="Of all that is drawn at random.")] = 0,
    author: Annotated[str, typer.Option("--author", help="Kept in the map's history.")] = "unknown",
    at: Annotated[
        str | None, typer.Option("--at", metavar="REV|TAG", help="show: as of this revision.")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Train the visual words by which lost robots are found in a map, or take another map's.

    A map without a vocabulary of its own uses the one that comes with Engram, which is small and
    was trained on simulated drives only.

    \b
    Examples:
      engram vocabulary train town.engram
      engram vocabulary train town.engram monday.framelog tuesday.framelog --words 20000
      engram vocabulary use robot.engram town.engram
      engram vocabulary show town.engram --json
    """
    from engram.cli.progress import progress
    from engram.errors import InputError
    from engram.places import TrainingConfig
    from engram.robot.vocabularies import describe_vocabulary, train_map_vocabulary, use_vocabulary

    if action is VocabularyAction.SHOW:
        report = describe_vocabulary(map_path, at)
    else:
        steps: tuple[str, ...] = ("read", "cluster", "quantise", "relate", "words")
        if action is VocabularyAction.USE:
            steps = ("words",)
            if not sources or len(sources) != 1:
                raise InputError(
                    "use takes one map, or one vocabulary file, whose words to take: "
                    "engram vocabulary use MAP SOURCE"
                )
        with progress(action.value, 100 * len(steps)) as advance:  # of 100 % each
            done = dict.fromkeys(steps, 0)

            def advance_to(what: str, share: float) -> None:
                for _ in range(done[what], int(100 * share)):
                    advance(what)
                done[what] = max(done[what], int(100 * share))

            if action is VocabularyAction.USE and sources:
                report = use_vocabulary(map_path, sources[0], author=author, advance=advance_to)
            else:
                config = TrainingConfig(words=words, seed=seed)
                report = train_map_vocabulary(
                    map_path, sources or [], config, author=author, advance=advance_to
                )
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        typer.echo(report.text())
