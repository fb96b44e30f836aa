"""`engram anchor`, `goal`, `export`: a map's frame, and what people store and take in it."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options
from engram.cli.progress import Bars


class GoalAction(StrEnum):
    """What to do with goals."""

    ADD = "add"
    LIST = "list"


class ExportFormat(StrEnum):
    """Formats of an export."""

    TUM = "tum"
    KITTI = "kitti"
    CSV = "csv"
    GEOJSON = "geojson"


def anchor(
    map_path: options.MapPath,
    positions: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="CSV or GeoJSON: node or time, and a position; or a bag with GPS."
        ),
    ],
    *,
    topic: Annotated[
        str | None, typer.Option("--topic", metavar="TOPIC", help="Of a bag's NavSatFix.")
    ] = None,
    grid: Annotated[
        Path | None,
        typer.Option("--grid", metavar="MAP.YAML", help="Positions are pixels u,v of this grid."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Report residuals and moves; write nothing.")
    ] = False,
    as_json: options.Json = False,
) -> None:
    """Fit a map's frame to known positions.

    A line names a node, or a time (UTC) at which one was saved, and where it is: lat,lon or x,y in
    metres, or u,v pixels of an occupancy grid; z and sigma in metres may follow. Of a bag the GPS
    fixes count that were taken while nodes were saved. Goals stay with their nodes. The anchoring
    is a revision, which revert takes back. Where parts that nothing ties now lie at one place,
    their nodes are compared; matches that confirm each other join them, in a revision of its own.

    \b
    Examples:
      engram anchor town.engram gps.csv
      engram anchor town.engram monday.mcap
      engram anchor town.engram corners.csv --grid map.yaml --dry-run
    """
    from engram.cli.history import user
    from engram.robot.anchoring import anchor_map
    from engram.robot.islands import IslandReport, join_islands

    report = anchor_map(map_path, positions, grid=grid, topic=topic, author=user(), dry_run=dry_run)
    islands = IslandReport() if dry_run else join_islands(map_path, user(), monitor=Bars())
    if as_json:
        typer.echo(json.dumps({**report.to_dict(), "islands": islands.to_dict()}))
        return
    typer.echo("\n".join(filter(None, (report.text(), islands.text()))))


def goal(
    action: Annotated[GoalAction, typer.Argument(help="add or list.")],
    map_path: options.MapPath,
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="add: its name.")] = None,
    *,
    x_m: Annotated[float | None, typer.Option("--x", help="add: position, metres.")] = None,
    y_m: Annotated[float | None, typer.Option("--y", help="add: position, metres.")] = None,
    yaw_deg: Annotated[
        float, typer.Option("--yaw", help="add: direction, degrees from x towards y.")
    ] = 0.0,
    at: Annotated[
        str | None, typer.Option("--at", metavar="REV", help="list: as of this revision.")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Store poses in a map, or list where they are.

    A goal is stored relative to the nearest node, so it survives merges, downloads and another
    anchoring. A goal of a name that is there already replaces it.

    \b
    Examples:
      engram goal add town.engram dock --x 12.5 --y -3 --yaw 90
      engram goal list town.engram
    """
    import math

    from engram.cli.history import user
    from engram.errors import InputError
    from engram.robot.goals import add_goal, list_goals

    if action is GoalAction.LIST:
        found = list_goals(map_path, at)
        if as_json:
            print(json.dumps({"goals": found}))
        for one in [] if as_json else found:
            typer.echo(_goal_text(one))
        return
    if name is None or x_m is None or y_m is None:
        raise InputError("add needs a name and a position: engram goal add MAP NAME --x X --y Y")
    added = add_goal(map_path, name, x_m, y_m, math.radians(yaw_deg), author=user())
    typer.echo(json.dumps(added) if as_json else
               f"{_goal_text(added)}; revision {added['revision']}")  # fmt: skip


def _goal_text(one: dict[str, object]) -> str:
    return (
        f"{one['name']:16s} x {one['x_m']:9.2f}  y {one['y_m']:9.2f}  yaw {one['yaw_deg']:7.1f}°  "
        f"{one['from_node_m']:.1f} m from node {str(one['node'])[:8]}"
    )


def export(
    map_path: options.MapPath,
    out: Annotated[Path, typer.Argument(metavar="FILE", help="NAME.tum, .kitti, .csv, .geojson.")],
    *,
    form: Annotated[
        ExportFormat | None, typer.Option("--format", help="Format [default: by FILE's suffix].")
    ] = None,
    at: options.At = None,
    as_json: options.Json = False,
) -> None:
    """Write where the nodes of a map lie in its frame.

    CSV and GeoJSON hold the goals, too. GeoJSON needs anchors with latitudes and longitudes.

    \b
    Examples:
      engram export town.engram town.csv
      engram export town.engram poses.txt --format tum
    """
    from engram.robot.exporting import export_map

    count = export_map(map_path, out, None if form is None else form.value, at)
    typer.echo(json.dumps({"nodes": count, "file": str(out)}) if as_json else
               f"{out}: {count} nodes")  # fmt: skip
