"""`engram explain`."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options

if TYPE_CHECKING:
    from engram.robot.explaining import ExplainedCandidate, Explanation


def explain(
    map_path: options.MapPath,
    path: options.DrivePath,
    *,
    frame: Annotated[int, typer.Option("--frame", min=0, help="Which frame of the drive.")],
    policy: options.Policy = "recall",
    lanes: options.Lanes = 2,
    rounds: options.Rounds = 2,
    top: Annotated[int, typer.Option("--top", min=1, help="How many candidates to list.")] = 20,
    at: options.At = None,
    format_: options.Format = None,
    rig: options.Rig = "grey",
    channel: options.Channel = "grey",
    skip_bad: options.SkipBad = False,
    robot: options.Robot = None,
    start: options.Start = None,
    longitude: options.Longitude = None,
    zone: options.Zone = None,
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Say why the candidates of one frame stand in their order, and which would have matched.

    The drive is localised up to that frame first: what a policy knows is what happened before.

    \b
    Examples:
      engram explain town.engram drives/tuesday --frame 120 --policy recall
      engram explain town.engram drives/tuesday --frame 120 --policy path --json
    """
    from engram.robot import load_settings, open_drive
    from engram.robot.explaining import ExplainOptions, explain_frame

    sequence = open_drive(
        path,
        format=format_,
        rig=rig,
        channel=channel,
        skip_bad=skip_bad,
        robot=robot,
        start=start,
        longitude_deg=longitude,
        zone=zone,
    )
    asked = ExplainOptions(frame, policy, lanes, rounds, at=at)
    found = explain_frame(map_path, sequence, load_settings(config), asked)
    if as_json:
        print(json.dumps(found.to_dict()))
    else:
        _print(found, top)


def _print(found: Explanation, top: int) -> None:
    typer.echo(
        f"frame {found.frame}: {found.status.value.replace('_', ' ')}; "
        f"{len(found.candidates)} candidates, "
        f"{sum(one.would_match for one in found.candidates)} would match; "
        f"ordered by {found.policy}"
    )
    if not found.candidates:
        typer.echo("there was nothing to order: no position is known, or the frame is unusable")
        return
    if found.rule:
        typer.echo(f"  order: {found.rule}")
    for name, meaning in found.meaning.items():
        typer.echo(f"  {name}: {meaning}")
    names = list(found.candidates[0].terms)
    chance = "chance  " if found.candidates[0].chance is not None else ""
    head = "".join(f"{name:>{_width(name)}}" for name in names)
    typer.echo(f"   # node     {'drive':34s} {'ahead':>7s}{'aside':>7s}{'yaw':>6s}{'g':>6s}  "
               f"{chance}{head}  outcome")  # fmt: skip
    for place, one in enumerate(found.candidates[:top], 1):
        terms = "".join(f"{value:>{_width(name)}.2f}" for name, value in one.terms.items())
        reckoned = "" if one.chance is None else f"{one.chance:6.1%}  "
        typer.echo(
            f"{place:4d} {str(one.node)[:8]} {one.drive:34.34s} {one.along_m:+7.2f}"
            f"{one.across_m:+7.2f}{57.29578 * one.yaw_rad:+6.0f}{one.success_rate:6.2f}  "
            f"{reckoned}{terms}  {_outcome(one)}"
        )
    if len(found.candidates) > top:
        typer.echo(f"     and {len(found.candidates) - top} more; --top lists them")


def _outcome(one: ExplainedCandidate) -> str:
    matched, failed = ("matched", "failed") if one.attempted else ("would match", "would fail")
    outcome = f"{matched}, {one.inliers} inliers" if one.would_match else failed
    return f"{outcome} (its turn)" if one.by_turn else outcome


def _width(name: str) -> int:
    return max(len(name) + 2, 8)
