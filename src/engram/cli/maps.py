"""`engram info`, `plot`, `view`, `check`, `amend`, `vocabulary`: what a map holds; is it sound."""

from __future__ import annotations

import json
from dataclasses import asdict
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from engram.cli import options
from engram.cli.options import untrusted_if
from engram.cli.wording import undo_text
from engram.counts import counted

if TYPE_CHECKING:
    from engram.repair.repairing import GeometryReport


class VocabularyAction(StrEnum):
    """What to do with a vocabulary."""

    TRAIN = "train"
    USE = "use"
    SHOW = "show"


class PlotBy(StrEnum):
    """What the colours of a plot distinguish."""

    EXPERIENCE = "experience"
    HOUR = "hour"
    REVISION = "revision"
    ROBOT = "robot"


def info(
    map_path: options.MapPath,
    *,
    sessions: Annotated[bool, typer.Option("--sessions", help="List the sessions.")] = False,
    nodes: Annotated[bool, typer.Option("--nodes", help="List the nodes.")] = False,
    at: options.At = None,
    as_json: options.Json = False,
) -> None:
    """Summarise a map.

    --sessions and --nodes list the ids that --near, --route, show and amend take; the first
    characters of an id are enough.

    \b
    Examples:
      engram info town.engram
      engram info town.engram --sessions
      engram info town.engram --at 3 --json
    """
    from engram.robot.inspecting import describe_map, list_nodes, list_sessions

    found = describe_map(map_path, at)
    listed: dict[str, list[dict[str, Any]]] = {}
    if sessions:
        listed["session_list"] = list_sessions(map_path, at)
    if nodes:
        listed["node_list"] = list_nodes(map_path, at)
    if as_json:
        print(json.dumps({**found, **listed}))
        return
    if not listed:
        for key, value in found.items():
            typer.echo(f"{key.replace('_', ' '):22s} {_plain(value)}")
    for one in listed.get("session_list", []):
        hour = "hour unknown" if one["hour"] is None else f"hour {one['hour']:.2f}"
        typer.echo(
            f"{one['session']}  {one['robot']:12s}  {one['start']}  {hour}  "
            f"{counted(one['nodes'], 'node')}"
        )
    for note in {one["note"]: None for one in listed.get("session_list", []) if one["note"]}:
        typer.echo(f"note: {note}", err=True)
    for one in listed.get("node_list", []):
        typer.echo(f"{one['node']}  session {one['session'][:8]}  {one['driven_m']:8.1f} m")


def plot(
    map_path: options.MapPath,
    out: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="The picture: .png, .svg, .pdf.", parser=options.output_picture
        ),
    ],
    *,
    by: Annotated[
        PlotBy,
        typer.Option(
            "--by", metavar="WHAT", help="Colours show experience, hour, revision or robot."
        ),
    ] = PlotBy.EXPERIENCE,
    at: options.At = None,
) -> None:
    """Draw a map from above.

    Shows the map frame, in which goals are stored, the goals, and where each drive started and
    went. Distances are true nearby; over long distances they drift unless anchors hold them. Parts
    whose places relative to each other are unknown are drawn apart.

    \b
    Examples:
      engram plot town.engram town.png
      engram plot town.engram hours.svg --by hour
      engram plot town.engram before.png --at 3 --by robot
    """
    from engram.viewing.drawings import plot_map

    drawn = plot_map(map_path, out, by.value, at)
    undrawn = f"; {drawn.text()}" if drawn.text() else ""
    typer.echo(f"{out}: {counted(drawn.nodes, 'node')} by {by.value}{undrawn}")


def check(
    map_path: options.MapPath,
    *,
    since: Annotated[
        str | None,
        typer.Option("--since", metavar="REV", help="Verify only the revisions after this one."),
    ] = None,
    clean: Annotated[
        bool, typer.Option("--clean", help="Remove rows that abandoned revisions left behind.")
    ] = False,
    seal: Annotated[
        bool, typer.Option("--seal", help="Commit what interrupted sessions had saved.")
    ] = False,
    geometry: Annotated[
        bool, typer.Option("--geometry", help="Look for edges that join different places.")
    ] = False,
    repair: Annotated[
        bool, typer.Option("--repair", help="Preview the removal of those edges; --yes commits.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Commit the repair.")] = False,
    pictures: Annotated[
        Path | None,
        typer.Option(
            "--pictures",
            metavar="DIR",
            help="Draw both sides of those edges.",
            parser=options.output_folder,
        ),
    ] = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Verify a map.

    Checks every record against its hash, and every edge and path against its nodes; with --since
    those of later revisions. The exit status is 1 if anything is wrong. --geometry looks for wrong
    edges instead. A repair is a revision that engram revert can undo.

    \b
    Examples:
      engram check town.engram
      engram check town.engram --since head~2
      engram check town.engram --geometry --pictures suspects
      engram check town.engram --geometry --repair --yes
      engram check town.engram --seal
      engram check town.engram --clean
    """
    from engram.robot.inspecting import check_map, seal_map

    if geometry or repair:
        looked = _check_geometry(map_path, pictures, settings, commits=repair and yes)
        undo = undo_text(map_path, *filter(None, [looked.revision]))
        text = "\n".join(filter(None, (looked.text(), undo)))
        options.show(looked, text, as_json=as_json)
        if looked.findings.wrong and looked.revision is None:
            raise typer.Exit(1)
        return
    sealed = seal_map(map_path) if seal else []
    report = check_map(map_path, clean=clean, since=since)
    found = {**report, "sealed": sealed} if seal else report
    options.show(found, partial(_checked_text, report, sealed if seal else None), as_json=as_json)
    if report["problems"]:
        raise typer.Exit(1)


def _check_geometry(
    map_path: Path, pictures: Path | None, settings: options.SettingsGiven, *, commits: bool
) -> GeometryReport:
    from engram.cli.history import user
    from engram.cli.screen import Bars
    from engram.repair.repairing import check_geometry

    author = user() if commits else None
    chosen = settings.read()
    return check_geometry(
        map_path,
        chosen.repair,
        placing=chosen.placing,
        author=author,
        pictures=pictures,
        monitor=Bars(),
    )


def _checked_text(report: dict[str, Any], sealed: list[dict[str, Any]] | None) -> str:
    """What `check` found; and what it sealed, None if that was not requested."""
    lines = [
        f"sealed session {one['session']}: {counted(one['nodes'], 'node')}, "
        f"revision {one['revision']}"
        for one in sealed or ()
    ]
    lines += ["no session was interrupted"] if sealed == [] else []
    lines += [f"{one['table']} {one['record']}: {one['fact']}" for one in report["problems"]]
    lines += report["notes"]
    lines += [
        f"session {session} was interrupted: map its drive again to resume it, or commit "
        "what it saved with --seal"
        for session in report["interrupted"]
    ]
    lines.append(
        f"{counted(len(report['problems']), 'problem')} in {counted(report['rows'], 'row')} and "
        f"{counted(report['blobs'], 'blob')}; {counted(report['abandoned_rows'], 'abandoned row')}"
        f", {report['removed_rows']} removed"
    )
    return "\n".join(lines)


def upgrade(map_path: options.MapPath, *, as_json: options.Json = False) -> None:
    """Convert a map of an earlier format.

    Nothing is lost: the new file is compared with the old one, row by row, before it takes its
    place. It needs as much free space as the map. Close the map everywhere else first.

    \b
    Examples:
      engram upgrade town.engram
      engram upgrade town.engram --json
    """
    from engram.maps.upgrading import upgrade_map

    done = upgrade_map(map_path)
    text = (
        f"{map_path}: format {done.before} → {done.after}, "
        f"{counted(done.revisions, 'revision')}, {counted(done.rows, 'row')} compared"
    )
    if done.before == done.after:
        text = f"{map_path} is of format {done.after} already"
    options.show(asdict(done), text, as_json=as_json)


def amend(
    map_path: options.MapPath,
    session: Annotated[
        str,
        typer.Argument(
            metavar="SESSION", help="Its id, or the beginning of it; see info --sessions."
        ),
    ],
    *,
    robot: Annotated[
        str | None, typer.Option("--robot", metavar="NAME", help="Name of the robot.")
    ] = None,
    recorded_at: Annotated[
        str | None,
        typer.Option("--recorded-at", metavar="TIME", help="Start of the drive in ISO 8601, UTC."),
    ] = None,
    zone: Annotated[
        str | None,
        typer.Option("--zone", metavar="ZONE", help="Time zone of the drive: Europe/London."),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Correct a session's robot, start or zone.

    The session's record and all ids stay as they are. The correction is a revision of its own that
    engram revert can undo; the latest correction counts.

    \b
    Examples:
      engram amend town.engram 3f2a --zone Europe/London
      engram amend town.engram 3f2a --recorded-at 2026-03-01T09:30:00Z
    """
    from engram.cli.history import user
    from engram.errors import InputError
    from engram.graph.model import Amendable
    from engram.robot.inspecting import amend_session
    from engram.sequences.sequence import parse_time

    start_ns = parse_time("--recorded-at", recorded_at)
    given = {
        Amendable.ROBOT: robot,
        Amendable.START: None if start_ns is None else str(start_ns),
        Amendable.ZONE: zone,
    }
    changes = {what: value for what, value in given.items() if value is not None}
    if not changes:
        raise InputError("nothing to correct: give --robot, --recorded-at or --zone")
    done = amend_session(map_path, session, changes, author=user())
    text = (
        f"session {done['session']}: robot {done['robot']}, start {done['start']}, "
        f"zone {done['zone'] or 'unknown'}; revision {done['revision']}"
    )
    options.show(done, text, as_json=as_json)


def vocabulary(
    action: Annotated[
        VocabularyAction, typer.Argument(metavar="ACTION", help="train, use or show.")
    ],
    map_path: options.MapPath,
    sources: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="SOURCE",
            help="train: maps and drives [default: MAP]; use: the map to copy from.",
        ),
    ] = None,
    *,
    words: Annotated[
        int, typer.Option("--words", metavar="N", help="train: number of words.")
    ] = 10_000,
    as_json: options.Json = False,
) -> None:
    """Train, copy or show a map's visual words.

    Visual words find lost robots. A map without its own uses a small vocabulary that comes with
    Engram and was trained on simulated drives.

    \b
    Examples:
      engram vocabulary train town.engram
      engram vocabulary train town.engram monday.framelog --words 20000
      engram vocabulary use robot.engram town.engram
      engram vocabulary show town.engram --json
    """
    from engram.cli.history import user
    from engram.cli.screen import Bars
    from engram.errors import InputError
    from engram.places.vocabulary import TrainingConfig
    from engram.robot.vocabularies import describe_vocabulary, train_map_vocabulary, use_vocabulary

    if action is VocabularyAction.SHOW:
        report = describe_vocabulary(map_path)
    elif action is VocabularyAction.USE:
        if not sources or len(sources) != 1:
            raise InputError(
                "use needs one map, or one vocabulary file, to copy from: "
                "engram vocabulary use MAP SOURCE"
            )
        report = use_vocabulary(map_path, sources[0], author=user(), monitor=Bars())
    else:
        config = TrainingConfig(words=words)
        report = train_map_vocabulary(
            map_path, sources or [], config, author=user(), monitor=Bars()
        )
    options.show(report, as_json=as_json)


def _plain(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.1f}"
    if isinstance(value, list):
        return ", ".join(str(item) for item in value) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{key} {item}" for key, item in value.items()) or "none"
    return "none" if value is None else str(value)


def view(
    map_path: options.MapPath,
    path: Annotated[
        Path | None, typer.Argument(metavar="DRIVE", help="A drive to localise in the map.")
    ] = None,
    *,
    view: options.Viewed = Path("window"),
    at: options.At = None,
    drive: options.Seen,
    settings: options.SettingsGiven,
) -> None:
    """Look at a map, and at a drive in it.

    Shows the map from above, coloured by experience. With a drive, or a file of the flight
    recorder, it also shows the images with their inliers, the nodes that were tried, and the
    robot's position and uncertainty. Needs the extra `view`.

    \b
    Examples:
      engram view town.engram
      engram view town.engram drives/tuesday
      engram view town.engram drives/tuesday --view tuesday.rrd
    """
    from engram.cli.screen import Bars
    from engram.maps.map import open_map
    from engram.robot.starting import robot_on
    from engram.viewing.viewer import WINDOW, viewer_on

    with open_map(map_path, at) as opened, viewer_on(view) as viewer:
        if path is None:
            viewer.show(opened)
        else:
            sequence, given = drive.open(path, settings)
            asked = options.driving_of(given)
            with (
                robot_on(opened, sequence, given.of_robot(), asked) as robot,
                Bars().stage("view", len(sequence)) as monitor,
            ):
                viewer.watch(robot, opened)
                for _ in robot.drive(sequence, monitor):
                    pass
        unfit = () if path is None else robot.unfit
    if view != WINDOW:
        typer.echo(f"wrote {view}; open it with: rerun {view}")
    untrusted_if(unfit)
