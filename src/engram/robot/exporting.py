"""Exports of a map's nodes in the map frame: TUM, KITTI, CSV, GeoJSON."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from engram.errors import InputError
from engram.graph.model import Node
from engram.maps import FramePose, Map, MapFrame
from engram.monitor import write_whole


@dataclass(frozen=True, slots=True)
class Exported:
    """What an export wrote.

    Attributes:
        nodes, goals: how many of each.
    """

    nodes: int
    goals: int


def export_map(
    path: Path, out: Path, form: str | None = None, at: int | str | None = None
) -> Exported:
    """Writes where the nodes and goals of a map lie; the nodes session by session.

    Args:
        path: the map.
        out: the file; its suffix gives the format unless `form` does.
        form: key of `FORMS`.
        at: revision; None for the newest.

    Raises:
        InputError: the format is not known, the map has no place on Earth for GeoJSON, or the file
            cannot be written.
        MapError: the map cannot be read, or has no such revision.
    """
    named = form or _SUFFIXES.get(out.suffix.lower(), "")
    if named not in FORMS:
        raise InputError(
            f"{out}: {form or out.suffix!r} is not a known format; choose --format from "
            f"{', '.join(FORMS)}"
        )
    with Map.open(path, at=at) as store:
        place = {one: number for number, one in enumerate(store.sessions)}
        nodes = sorted(store.graph.nodes, key=lambda one: (place[one.session], one.stamp_ns))
        text = FORMS[named](store, store.frame, nodes)
        goals = len(store.goals) if named in _WITH_GOALS else 0
    try:
        with write_whole(out) as draft:
            draft.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    return Exported(len(nodes), goals)


def _tum(store: Map, frame: MapFrame, nodes: list[Node]) -> str:
    """Seconds, position, quaternion x y z w of ``map_from_camera``."""
    lines = ["# seconds x y z qx qy qz qw (map_from_camera, metres)"]
    for node in nodes:
        pose = frame.pose(node.id)
        w, x, y, z = pose.quaternion_wxyz()
        stamp_ns = node.stamp_ns + store.sessions[node.session].shift_ns
        sign, (seconds, nanos) = "-" * (stamp_ns < 0), divmod(abs(stamp_ns), 1_000_000_000)
        numbers = " ".join(f"{value:.9f}" for value in (*pose.translation, x, y, z, w))
        lines.append(f"{sign}{seconds}.{nanos:09d} {numbers}")
    return "\n".join(lines) + "\n"


def _kitti(store: Map, frame: MapFrame, nodes: list[Node]) -> str:
    """The first three rows of each ``map_from_camera``."""
    del store
    rows = (frame.pose(node.id).matrix()[:3].ravel() for node in nodes)
    return "".join(" ".join(f"{value:.9e}" for value in row) + "\n" for row in rows)


def _csv(store: Map, frame: MapFrame, nodes: list[Node]) -> str:
    """A line for each node, then one for each goal."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    places = ("x_m", "y_m", "z_m", "yaw_deg", "latitude", "longitude")
    writer.writerow(("what", "name", "session", "robot", "stamp_ns", *places))
    for node in nodes:
        session = store.sessions[node.session]
        pose = FramePose.of(frame.pose(node.id))
        row = ("node", node.id, session.id, session.robot, node.stamp_ns + session.shift_ns)
        writer.writerow((*row, *pose.to_dict().values(), *_geographic(frame, pose)))
    for name, goal in sorted(store.goals.items()):
        pose = frame.locate(goal)
        writer.writerow(
            ("goal", name, "", "", "", *pose.to_dict().values(), *_geographic(frame, pose))
        )
    return out.getvalue()


def _geojson(store: Map, frame: MapFrame, nodes: list[Node]) -> str:
    """Points: the nodes, then the goals."""
    if frame.origin is None:
        raise InputError(
            f"{store.location} has no known position on Earth: anchor it with latitudes and "
            "longitudes (engram anchor), or export CSV, which has metres"
        )
    features = []
    for node in nodes:
        session = store.sessions[node.session]
        stamp_ns = node.stamp_ns + session.shift_ns
        about = {"node": str(node.id), "robot": session.robot, "stamp_ns": stamp_ns}
        features.append(_point(frame, FramePose.of(frame.pose(node.id)), about))
    for name, goal in sorted(store.goals.items()):
        features.append(_point(frame, frame.locate(goal), {"goal": name}))
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


FORMS: Mapping[str, Callable[[Map, MapFrame, list[Node]], str]] = {
    "tum": _tum,
    "kitti": _kitti,
    "csv": _csv,
    "geojson": _geojson,
}
_WITH_GOALS = {"csv", "geojson"}
_SUFFIXES = {".tum": "tum", ".kitti": "kitti", ".csv": "csv", ".geojson": "geojson",
             ".json": "geojson"}  # fmt: skip
