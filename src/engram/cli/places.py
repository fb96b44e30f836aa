"""`engram vocabulary`, `engram relocalise` and `engram places`."""

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
    from engram.drive.vocabularies import describe_vocabulary, train_map_vocabulary, use_vocabulary
    from engram.errors import InputError
    from engram.places import TrainingConfig

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


def relocalise(
    map_path: options.MapPath,
    path: options.DrivePath,
    *,
    relocaliser: Annotated[
        str,
        typer.Option("--relocaliser", help="How to search: fabmap, bag-of-words or exhaustive."),
    ] = "fabmap",
    lanes: options.Lanes = 2,
    rounds: options.Rounds = 32,
    at: options.At = None,
    format_: options.Format = None,
    rig: options.Rig = "grey",
    channel: options.Channel = "grey",
    frames: options.Frames = None,
    skip_bad: options.SkipBad = False,
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Find each frame of a drive in a map by itself, as a robot that was just switched on.

    \b
    Examples:
      engram relocalise town.engram drives/tuesday
      engram relocalise town.engram drives/tuesday --frames 0:1000:10 --json
    """
    from engram.cli.progress import progress
    from engram.drive import load_settings, open_drive
    from engram.drive.relocalising import relocalise_drive, summarise_cold_starts
    from engram.drive.results import damage_warning
    from engram.localiser import Budget

    sequence = open_drive(
        path, format=format_, rig=rig, channel=channel, frames=frames, skip_bad=skip_bad
    )
    with progress("relocalise", len(sequence)) as advance:
        starts = relocalise_drive(
            map_path,
            sequence,
            load_settings(config),
            relocaliser=relocaliser,
            budget=Budget(lanes, lost_rounds=rounds),
            at=at,
            advance=advance,
        )
    summary = summarise_cold_starts(starts)
    if as_json:
        print(json.dumps({"summary": summary, "frames": [one.to_dict() for one in starts]}))
        return
    if summary["damaged_nodes"]:
        typer.echo(damage_warning(summary["damaged_nodes"]), err=True)
    typer.echo(
        f"{summary['found']} of {summary['frames']} frames found at once, "
        f"{summary['unknown']} not found, {summary['new_place']} new for an empty map, "
        f"{summary['unusable_frame']} unusable; {summary['attempts']} attempts"
    )


def places(
    map_path: options.MapPath,
    *,
    top: Annotated[int, typer.Option("--top", min=1, help="How many pairs to list.")] = 10,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", metavar="FILE", help="Draw how alike all places look."),
    ] = None,
    at: options.At = None,
    as_json: options.Json = False,
) -> None:
    """List the places of a map that look most alike, though they are not near each other.

    \b
    Examples:
      engram places town.engram
      engram places town.engram --top 50 --picture confusion.png
    """
    from engram.cli.progress import progress
    from engram.drive.lookalikes import find_lookalikes, write_confusion_picture
    from engram.store import MapStore

    with MapStore.open(map_path, at=at) as store:
        count = store.node_count()
    with progress("compare", count) as advance:
        confusion = find_lookalikes(map_path, at, advance=advance)
    if picture is not None:
        write_confusion_picture(picture, confusion)
    pairs = confusion.lookalikes[:top]
    if as_json:
        listed = [
            {"node": str(one.node), "like": str(one.like), "similarity": one.similarity}
            for one in pairs
        ]
        print(json.dumps({"nodes": count, "lookalikes": listed}))
        return
    for one in pairs:
        typer.echo(f"{one.node} looks like {one.like}: {one.similarity:.2f}")
    if not pairs:
        typer.echo("no two places apart from each other look alike")
