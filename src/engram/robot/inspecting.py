"""Content and integrity of a map as plain values, and exports of its nodes."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engram.errors import InputError
from engram.graph.clock import hour_of_day, zone_note
from engram.graph.model import Amendable, Node
from engram.maps.history import stamp_text
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.map_frame import FramePose, Layout, MapFrame
from engram.maps.schema import FORMAT_VERSION
from engram.monitor import write_whole
from engram.places.words import vocabulary_problems


def describe_map(path: Path, at: int | str | None = None) -> dict[str, Any]:
    """Counts and properties of a map, for ``engram info``."""
    with Map.open(path, at=at) as store:
        info, totals = store.info(), store.totals()
        return {
            "format_version": FORMAT_VERSION,
            "revision": info.revision,
            "content_hash": store.content_hash(),
            "descriptor": info.descriptor,
            "sessions": info.sessions,
            "robots": sorted({session.robot for session in store.sessions.values()}),
            "cameras": info.cameras,
            "nodes": info.nodes,
            "experiences": totals.experiences,
            "edges": dict(info.edges_of_kind),
            "components": totals.components,
            "largest_component": totals.largest_component,
            "paths": totals.paths,
            "path_entries": info.path_entries,
            "attempts": info.attempts,
            "mapped_m": info.mapped_m,
            "size_bytes": info.size_bytes,
            "interrupted": [str(one.session.id) for one in store.interrupted()],
        }


def list_sessions(path: Path, at: int | str | None = None) -> list[dict[str, Any]]:
    """The sessions of a map in order of arrival, for ``engram info --sessions``."""
    with Map.open(path, at=at) as store:
        sessions, sizes, frontends = store.sessions, store.session_sizes(), store.frontends
        amended = {(one.session, str(one.what)) for one in store.amendments}
    return [
        {
            "session": str(one.id),
            "robot": one.robot,
            "camera": one.camera,
            "start": stamp_text(one, one.start_ns),
            "start_ns": one.begin_ns,
            "clock": str(one.clock),
            "longitude_deg": one.longitude_deg,
            "zone": one.zone,
            "hour": hour_of_day(one, one.start_ns),
            "note": zone_note(one),
            "nodes": sizes[one.id][0],
            "path_entries": sizes[one.id][1],
            "descriptor": str(frontends[one.id][0]),
            "amended": sorted(what for session, what in amended if session == one.id),
        }
        for one in sessions.values()
    ]


def list_nodes(path: Path, at: int | str | None = None) -> list[dict[str, Any]]:
    """The nodes of a map in order of arrival, for ``engram info --nodes``."""
    with Map.open(path, at=at) as store:
        graph, sessions = store.graph, store.sessions
    components, experiences = graph.components(), graph.experiences
    return [
        {
            "node": str(node.id),
            "session": str(node.session),
            "robot": sessions[node.session].robot,
            "when": stamp_text(sessions[node.session], node.stamp_ns),
            "stamp_ns": node.stamp_ns,
            "hour": hour_of_day(sessions[node.session], node.stamp_ns),
            "driven_m": node.driven_m,
            "experience": int(experiences[index]),
            "component": int(components[index]),
        }
        for index, node in enumerate(graph.nodes)
    ]


def amend_session(
    path: Path,
    session: str,
    changes: Mapping[Amendable, str],
    *,
    author: str,
) -> dict[str, Any]:
    """Corrects the robot, zone or start of a session, for ``engram amend``; see `Map.amend`.

    Args:
        session: its UUID, or an unambiguous prefix.
    """
    with Map.open(path) as store:
        found = store.named_session(session).id
        revision = store.amend(found, changes, author=author)
        shown = store.sessions[found]
    return {
        "session": str(found),
        "revision": revision.number,
        "robot": shown.robot,
        "start": stamp_text(shown, shown.start_ns),
        "zone": shown.zone,
    }


def check_map(path: Path, *, clean: bool = False, since: int | str | None = None) -> dict[str, Any]:
    """Checks a map for damage, or the revisions after one, for ``engram check``."""
    removed = 0
    if clean:
        with Map.open(path, writes=True) as store:
            removed = store.clean()
    report = check_file(path, since=since)
    problems = [*report.problems, *vocabulary_problems(path)]
    return {
        "sound": not problems,
        "problems": [
            {"table": problem.table, "record": problem.record, "fact": problem.fact}
            for problem in problems
        ],
        "rows": report.rows,
        "blobs": report.blobs,
        "interrupted": [str(session) for session in report.interrupted],
        "abandoned_rows": report.abandoned_rows,
        "removed_rows": removed,
        "notes": list(report.notes),
    }


def seal_map(path: Path) -> list[dict[str, Any]]:
    """Commits the saved part of interrupted sessions, for ``engram check --seal``."""
    with Map.open(path, writes=True) as store:
        return [
            {
                "session": str(one.session.id),
                "nodes": one.nodes,
                "revision": store.seal(one.session.id).number,
            }
            for one in store.interrupted()
        ]


@dataclass(frozen=True, slots=True)
class Exported:
    """What an export wrote."""

    nodes: int
    goals: int


def export_map(
    path: Path, out: Path, form: str | None = None, at: int | str | None = None
) -> Exported:
    """Writes where the nodes and goals of a map lie; the nodes session by session.

    Args:
        out: the file; its suffix gives the format unless `form` does.
        form: key of `FORMS`.
        at: revision; None for the newest.
    """
    named = form or _SUFFIXES.get(out.suffix.lower(), "")
    if named not in FORMS:
        raise InputError(
            f"{out}: {form or out.suffix!r} is not a known format; its name must end in "
            f"{', '.join(_SUFFIXES)}"
        )
    with Map.open(path, at=at) as store:
        place = {one: number for number, one in enumerate(store.sessions)}
        nodes = sorted(store.graph.nodes, key=lambda one: (place[one.session], one.stamp_ns))
        text = FORMS[named](store, store.layout(), nodes)
        goals = len(store.goals) if named in _WITH_GOALS else 0
    try:
        with write_whole(out) as draft:
            draft.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    return Exported(len(nodes), goals)


def _tum(store: Map, layout: Layout, nodes: list[Node]) -> str:
    """Seconds, position, quaternion x y z w of ``map_from_camera``."""
    lines = ["# seconds x y z qx qy qz qw (map_from_camera, metres)"]
    for node in nodes:
        pose = layout.pose(node.id)
        w, x, y, z = pose.quaternion_wxyz()
        stamp_ns = node.stamp_ns + store.sessions[node.session].shift_ns
        sign, (seconds, nanos) = "-" * (stamp_ns < 0), divmod(abs(stamp_ns), 1_000_000_000)
        numbers = " ".join(f"{value:.9f}" for value in (*pose.translation, x, y, z, w))
        lines.append(f"{sign}{seconds}.{nanos:09d} {numbers}")
    return "\n".join(lines) + "\n"


def _kitti(store: Map, layout: Layout, nodes: list[Node]) -> str:
    """The first three rows of each ``map_from_camera``."""
    del store
    rows = (layout.pose(node.id).matrix()[:3].ravel() for node in nodes)
    return "".join(" ".join(f"{value:.9e}" for value in row) + "\n" for row in rows)


def _csv(store: Map, layout: Layout, nodes: list[Node]) -> str:
    """A line for each node, then one for each goal."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    places = ("x_m", "y_m", "z_m", "yaw_deg", "latitude", "longitude")
    writer.writerow(("what", "name", "session", "robot", "stamp_ns", *places))
    for node in nodes:
        session = store.sessions[node.session]
        pose = FramePose.of(layout.pose(node.id))
        row = ("node", node.id, session.id, session.robot, node.stamp_ns + session.shift_ns)
        writer.writerow((*row, *pose.to_dict().values(), *_geographic(store.frame, pose)))
    for name, goal in sorted(store.goals.items()):
        pose = store.frame.locate(goal)
        writer.writerow(
            ("goal", name, "", "", "", *pose.to_dict().values(), *_geographic(store.frame, pose))
        )
    return out.getvalue()


def _geojson(store: Map, layout: Layout, nodes: list[Node]) -> str:
    """Points: the nodes, then the goals."""
    if store.frame.origin is None:
        raise InputError(
            f"{store.location} has no known position on Earth: anchor it with latitudes and "
            "longitudes (engram anchor), or export CSV, which has metres"
        )
    features = []
    for node in nodes:
        session = store.sessions[node.session]
        stamp_ns = node.stamp_ns + session.shift_ns
        about = {"node": str(node.id), "robot": session.robot, "stamp_ns": stamp_ns}
        features.append(_point(store.frame, FramePose.of(layout.pose(node.id)), about))
    for name, goal in sorted(store.goals.items()):
        features.append(_point(store.frame, store.frame.locate(goal), {"goal": name}))
    return json.dumps({"type": "FeatureCollection", "features": features}) + "\n"


def _point(frame: MapFrame, pose: FramePose, about: Mapping[str, object]) -> dict[str, object]:
    latitude, longitude = _geographic(frame, pose)
    place = [round(float(longitude), 8), round(float(latitude), 8), round(pose.z_m, 3)]
    yaw = {"yaw_deg": pose.to_dict()["yaw_deg"]}
    return {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": place},
        "properties": {**about, **yaw},
    }


def _geographic(frame: MapFrame, pose: FramePose) -> tuple[float | str, float | str]:
    return frame.geographic(pose.x_m, pose.y_m) or ("", "")


FORMS: Mapping[str, Callable[[Map, Layout, list[Node]], str]] = {
    "tum": _tum,
    "kitti": _kitti,
    "csv": _csv,
    "geojson": _geojson,
}
_WITH_GOALS = {"csv", "geojson"}
_SUFFIXES = {".tum": "tum", ".kitti": "kitti", ".csv": "csv", ".geojson": "geojson",
             ".json": "geojson"}  # fmt: skip
