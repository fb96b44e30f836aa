"""`engram dream`: a better fleet map from what robots handed in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options


def dream(
    centre: Annotated[
        Path, typer.Argument(metavar="FLEET", help="The fleet map.", parser=options.map_file)
    ],
    handed: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="ROBOT",
            help="Robots' maps as handed in [default: those kept by merge --keep].",
            parser=options.map_file,
        ),
    ] = None,
    *,
    validate: Annotated[
        list[Path],
        typer.Option(
            "--validate", metavar="DRIVE", help="Held-out drive; give three or more. Required."
        ),
    ],
    minutes: Annotated[
        float | None,
        typer.Option(
            "--minutes", metavar="MIN", help="Stop after this long [default: try everything]."
        ),
    ] = None,
    workers: Annotated[
        int, typer.Option("--workers", metavar="N", min=1, help="Processes on this machine.")
    ] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Try on a Dask cluster instead."),
    ] = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Optimise a fleet map by held-out drives.

    Merges the robots' maps again, in other orders and with other settings, and compares the results
    on held-out drives. If the drives then localise significantly better, what is new in the best
    result is added to the fleet map as one revision. Nothing is removed. The same command resumes
    an interrupted search.

    \b
    Examples:
      engram dream fleet.engram r1.engram --validate mon --validate tue --validate wed
      engram dream fleet.engram --validate mon --validate tue --validate wed --minutes 30
    """
    from engram.cli.fleet import merging_of
    from engram.cli.progress import Bars
    from engram.fleet.dream import DreamOptions, hand_ins_of
    from engram.fleet.dream import dream as look_for_better
    from engram.monitor import interruptible

    given = settings.read()
    asked = DreamOptions(
        minutes=minutes,
        workers=workers,
        scheduler=scheduler,
        merging=merging_of(given),
        localising=options.driving_of(given),
        judge_at_m=given.build.max_gap_m,
        estimator=given.build.estimator,
    )
    with interruptible(Bars()) as monitor:
        report = look_for_better(
            centre, handed or hand_ins_of(centre), validate, given.of_robot(), asked, monitor
        )
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        typer.echo(report.text())
