"""`engram localise --explain`: one frame's candidates in their order."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from engram.robot import Settings
    from engram.robot.explaining import ExplainedCandidate, ExplainOptions, Explanation
    from engram.sequences import Drive

_LISTED = 20


def explain_and_print(
    map_path: Path,
    sequence: Drive,
    settings: Settings,
    asked: ExplainOptions,
    *,
    as_json: bool,
) -> None:
    """Localises the drive up to a frame and says how its candidates were ordered."""
    from engram.robot.explaining import explain_frame

    found = explain_frame(map_path, sequence, settings, asked)
    if as_json:
        print(json.dumps(found.to_dict()))
    else:
        _print(found)


def _print(found: Explanation) -> None:
    typer.echo(
        f"frame {found.frame}: {found.status.value.replace('_', ' ')}; "
        f"{len(found.candidates)} candidates, "
        f"{sum(one.would_match for one in found.candidates)} would match; "
        f"ordered by {found.ranking}"
    )
    if not found.candidates:
        typer.echo("nothing to rank: the robot is lost, or the frame is unusable")
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
    for place, one in enumerate(found.candidates[:_LISTED], 1):
        terms = "".join(f"{value:>{_width(name)}.2f}" for name, value in one.terms.items())
        reckoned = "" if one.chance is None else f"{one.chance:6.1%}  "
        typer.echo(
            f"{place:4d} {str(one.node)[:8]} {one.drive:34.34s} {one.along_m:+7.2f}"
            f"{one.across_m:+7.2f}{57.29578 * one.yaw_rad:+6.0f}{one.success_rate:6.2f}  "
            f"{reckoned}{terms}  {_outcome(one)}"
        )
    if len(found.candidates) > _LISTED:
        typer.echo(f"     and {len(found.candidates) - _LISTED} more; --json lists all")


def _outcome(one: ExplainedCandidate) -> str:
    matched, failed = ("matched", "failed") if one.attempted else ("would match", "would fail")
    outcome = f"{matched}, {one.inliers} inliers" if one.would_match else failed
    return f"{outcome} (its turn)" if one.by_turn else outcome


def _width(name: str) -> int:
    return max(len(name) + 2, 8)
