"""`engram anchor`, `goal`, `export`: a map's frame, and what people store and take in it."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options
from engram.cli.screen import Bars
from engram.cli.wording import undo_text
from engram.counts import counted

# Further from the nodes, a goal hangs on the direction of one node.
_FAR_M = 30.0


class GoalAction(StrEnum):
    """What to do with goals."""

    ADD = "add"
    LIST = "list"
    REMOVE = "remove"


def anchor(
    map_path: options.MapPath,
    positions: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="CSV or GeoJSON (node or time, position), or a bag with GPS."
        ),
    ],
    *,
    topic: Annotated[
        str | None,
        typer.Option("--topic", metavar="TOPIC", help="Topic of a bag's NavSatFix messages."),
    ] = None,
    grid: Annotated[
        Path | None,
        typer.Option(
            "--grid", metavar="MAP.YAML", help="Positions are pixels of this occupancy grid."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Report residuals and moves; write nothing.")
    ] = False,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Fit a map's frame to known positions.

    Each line names a node, or the time (UTC) at which one was saved, and its position: lat,lon, or
    x,y in metres, or u,v in pixels of an occupancy grid; z and sigma in metres may follow. From a
    bag, the GPS fixes that were taken while nodes were saved are used. Goals stay with their nodes.
    The anchoring is a revision that engram revert can undo. Unconnected parts of the map that now
    lie at one place are matched, and joined by matches that confirm each other.

    \b
    Examples:
      engram anchor town.engram gps.csv
      engram anchor town.engram monday.mcap
      engram anchor town.engram corners.csv --grid map.yaml --dry-run
    """
    from engram.cli.history import user
    from engram.robot.anchors import IslandReport, anchor_map, join_islands

    chosen, islands = settings.read(), IslandReport()
    report = anchor_map(
        map_path,
        positions,
        grid=grid,
        topic=topic,
        author=user(),
        dry_run=dry_run,
        placing=chosen.placing,
    )
    if not dry_run:
        islands = join_islands(map_path, user(), chosen.of_robot(), chosen.islands, Bars())
    undo = undo_text(map_path, *filter(None, (islands.revision, report.revision)))
    text = "\n".join(filter(None, (report.text(), islands.text(), undo)))
    options.show({**report.to_dict(), "islands": islands.to_dict()}, text, as_json=as_json)


def goal(
    action: Annotated[GoalAction, typer.Argument(metavar="ACTION", help="add, list or remove.")],
    map_path: options.MapPath,
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="add, remove: name of the goal.")
    ] = None,
    *,
    x_m: Annotated[
        float | None, typer.Option("--x", metavar="M", help="add: position in metres.")
    ] = None,
    y_m: Annotated[
        float | None, typer.Option("--y", metavar="M", help="add: position in metres.")
    ] = None,
    yaw_deg: Annotated[
        float,
        typer.Option("--yaw", metavar="DEG", help="add: direction in degrees, from x towards y."),
    ] = 0.0,
    as_json: options.Json = False,
) -> None:
    """Store poses in a map, list or remove them.

    A goal is stored relative to the nearest node, so it survives merges, downloads and new anchors.
    Adding a goal under an existing name moves it. Each change is a revision that engram revert
    can undo. A goal that was removed from a fleet map does not come back with a robot's hand-in.

    \b
    Examples:
      engram goal add town.engram dock --x 12.5 --y -3 --yaw 90
      engram goal list town.engram
      engram goal remove town.engram dock
    """
    import math

    from engram.cli.history import user
    from engram.errors import InputError
    from engram.robot.anchors import add_goal, list_goals, remove_goal

    if action is GoalAction.LIST:
        found = list_goals(map_path)
        options.show({"goals": found}, "\n".join(map(_goal_text, found)), as_json=as_json)
        return
    if action is GoalAction.REMOVE:
        if name is None:
            raise InputError("remove needs a name: engram goal remove MAP NAME")
        gone = remove_goal(map_path, name, author=user())
        undo = undo_text(map_path, gone["revision"])
        options.show(gone, f"goal {name} is removed\n{undo}", as_json=as_json)
        return
    if name is None or x_m is None or y_m is None:
        raise InputError("add needs a name and a position: engram goal add MAP NAME --x X --y Y")
    added = add_goal(map_path, name, x_m, y_m, math.radians(yaw_deg), author=user())
    if (far_m := added["from_node_m"]) > _FAR_M:
        typer.echo(
            f"warning: {name} is {far_m:.0f} m from the nearest node: if that turns by 1°, it "
            f"moves by {far_m * math.radians(1):.1f} m. Did you mean the map frame that engram "
            "plot shows?",
            err=True,
        )
    text = [f"{_goal_text(added)}; revision {added['revision']}"]
    if (before := added["replaced"]) is not None:
        text.append(_goal_text({**before, "name": "moved from"}))
        text.append(undo_text(map_path, added["revision"]))
    options.show(added, "\n".join(text), as_json=as_json)


def _goal_text(one: dict[str, object]) -> str:
    return (
        f"{one['name']:16s} x {one['x_m']:9.2f}  y {one['y_m']:9.2f}  yaw {one['yaw_deg']:7.1f}°  "
        f"{one['from_node_m']:.1f} m from node {str(one['node'])[:8]}"
    )


def export(
    map_path: options.MapPath,
    out: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="NAME.tum, .kitti, .csv or .geojson.",
            parser=options.output_file,
        ),
    ],
    *,
    at: options.At = None,
    as_json: options.Json = False,
) -> None:
    """Write the poses of a map's nodes in its frame.

    CSV and GeoJSON include the goals. GeoJSON needs anchors with latitudes and longitudes.

    \b
    Examples:
      engram export town.engram town.csv
      engram export town.engram before.tum --at 3
    """
    from engram.robot.inspecting import export_map

    wrote = export_map(map_path, out, at=at)
    goals = f", {counted(wrote.goals, 'goal')}" if wrote.goals else ""
    text = f"{out}: {counted(wrote.nodes, 'node')}{goals}"
    found = {"nodes": wrote.nodes, "goals": wrote.goals, "file": str(out)}
    options.show(found, text, as_json=as_json)
