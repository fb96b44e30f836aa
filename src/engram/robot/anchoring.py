"""Anchors: where nodes of a map are known to be, from a CSV or GeoJSON file."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from engram.errors import ConfigError, InputError
from engram.graph.marks import Anchor
from engram.graph.model import Clock, Node
from engram.graph.placing import Anchored, anchor
from engram.maps import Map, MapFrame, Moves, moves
from engram.maps.laying_out import ORIGIN
from engram.maps.map_frame import changed, local_m
from engram.sequences.options import parse_start

# Standard deviation of an anchor whose line names none, metres: a GPS receiver's, a click's.
_GPS_SIGMA_M, _GRID_SIGMA_M = 2.0, 0.3
# Farthest in time from a node that a line with a time may be.
_NEAR_NS = 500_000_000
# Anchors must be this far apart to tell a direction, metres.
_LEAST_APART_M = 5.0
# An anchor this many standard deviations off does not fit.
_OUTLIER_SIGMAS = 4.0


@dataclass(frozen=True, slots=True)
class GivenAnchor:
    """One line of a file of anchors.

    Attributes:
        line: its number, for messages.
        node: UUID of a node, or its beginning; None if a time is given.
        time_ns: UTC, ns; None if a node is given.
        position: latitude and longitude in degrees, or x and y in metres, or pixels of a grid.
        z_m: height; None if unknown.
        sigma_m: standard deviation; None for the usual one.
    """

    line: int
    node: str | None
    time_ns: int | None
    position: tuple[float, float]
    z_m: float | None
    sigma_m: float | None


@dataclass(frozen=True, slots=True, eq=False)
class AnchorReport:
    """What anchoring came to.

    Attributes:
        revision: its number; None for a preview.
        anchors: number of anchors used.
        unplaced: lines whose time is of no node.
        residuals_m: distance of each anchored node from its anchor afterwards, by node.
        outliers: nodes whose anchors do not fit.
        moved: what moved in the map frame.
    """

    revision: int | None
    anchors: int
    unplaced: int
    residuals_m: Mapping[str, float]
    outliers: tuple[str, ...]
    moved: Moves

    def to_dict(self) -> dict[str, Any]:
        """What ``anchor --json`` prints."""
        return {
            "revision": self.revision,
            "anchors": self.anchors,
            "unplaced": self.unplaced,
            "residuals_m": {node: round(far_m, 3) for node, far_m in self.residuals_m.items()},
            "outliers": list(self.outliers),
            "moved": self.moved.to_dict(),
        }

    def text(self) -> str:
        """In words."""
        far_m = np.array(list(self.residuals_m.values()))
        lines = [
            f"{self.anchors} anchors: residuals median {np.median(far_m):.2f} m, 90 % "
            f"{np.percentile(far_m, 90):.2f} m, largest {far_m.max():.2f} m"
        ]
        if self.unplaced:
            lines.append(f"{self.unplaced} lines left out: no node within 0.5 s of their time")
        lines += [f"does not fit: node {node}" for node in self.outliers]
        if self.moved:
            lines.append(self.moved.text())
        undo = f"revision {self.revision}; to undo: engram revert MAP {self.revision}"
        lines.append("preview: nothing was written" if self.revision is None else undo)
        return "\n".join(lines)


def anchor_map(
    path: Path, source: Path, *, grid: Path | None = None, author: str, dry_run: bool = False
) -> AnchorReport:
    """Fits the map frame to known positions, in a revision of its own.

    Args:
        path: the map.
        source: CSV or GeoJSON with a node or a time and a position per line.
        grid: ``map.yaml`` of an occupancy grid, whose pixels the positions are.
        author: of the revision.
        dry_run: only report.

    Raises:
        InputError: the file cannot be read, names no node of the map, or too few of them.
        MapError: the map cannot be read or written.
    """
    given, geographic = read_anchors(source)
    if grid is not None:
        geographic = False
        given = _on_grid(given, grid)
    with Map.open(path, writes=not dry_run) as store:
        nodes, known = _nodes_of(store, given)
        origin = _origin(store, known) if geographic else None
        positions = np.array([one.position for one in known]).reshape(-1, 2)
        if origin is not None:
            positions = local_m(positions[:, 0], positions[:, 1], origin)
        _check_spread(positions, source)
        usual = _GPS_SIGMA_M if geographic else _GRID_SIGMA_M
        anchors = [
            Anchor(node.id, float(x), float(y), one.z_m, one.sigma_m or usual, source.name)
            for node, one, (x, y) in zip(nodes, known, positions, strict=True)
        ]
        frame = store.frame
        before = {one.node: one.map_from_node for one in frame.placements()}
        poses = anchor(store.graph, before, _anchored(store, anchors))
        after = MapFrame(store.graph, poses, origin)
        residuals = _residuals(after, anchors)
        revision = None if dry_run else _write(store, anchors, after, origin, author, source)
        places = {one.node: one.map_from_node for one in after.placements()}
        moved = moves(before, places, store.goals.values())
    outliers = tuple(
        str(one.node) for one in anchors if residuals[str(one.node)] > _OUTLIER_SIGMAS * one.sigma_m
    )
    return AnchorReport(revision, len(anchors), len(given) - len(known), residuals, outliers, moved)


def read_anchors(source: Path) -> tuple[list[GivenAnchor], bool]:
    """The anchors of a file, and whether they are latitudes and longitudes.

    Raises:
        InputError: it cannot be read, or a line cannot be used; names file and line.
    """
    try:
        text = source.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{source}: cannot be read: {error}") from error
    is_json = source.suffix.lower() in {".geojson", ".json"}
    rows = _json_rows(text, source) if is_json else _csv_rows(text, source)
    found = [(line, row) for line, row in rows]
    if not found:
        raise InputError(f"{source}: holds no anchors")
    kinds = {_kind(row, line, source) for line, row in found}
    if len(kinds) > 1:
        raise InputError(f"{source}: mixes {' and '.join(sorted('/'.join(k) for k in kinds))}")
    (kind,) = kinds
    return [_given(row, line, kind, source) for line, row in found], kind == ("lat", "lon")


_NAMES = {
    "latitude": "lat", "longitude": "lon", "lng": "lon", "altitude": "z", "alt": "z",
    "height": "z", "x_m": "x", "y_m": "y", "z_m": "z", "sigma_m": "sigma", "stamp": "time",
    "timestamp": "time",
}  # fmt: skip
_PAIRS = (("lat", "lon"), ("x", "y"), ("u", "v"))


def _csv_rows(text: str, source: Path) -> Iterable[tuple[int, dict[str, str]]]:
    reader = csv.DictReader(text.splitlines())
    if reader.fieldnames is None:
        raise InputError(f"{source}: is empty; expected a head such as node,x,y or time,lat,lon")
    for row in reader:
        yield (
            reader.line_num,
            {
                _NAMES.get(key.strip().lower(), key.strip().lower()): (value or "").strip()
                for key, value in row.items()
                if isinstance(key, str) and isinstance(value, str | None)
            },
        )


def _json_rows(text: str, source: Path) -> Iterable[tuple[int, dict[str, str]]]:
    try:
        features = json.loads(text)["features"]
        for number, feature in enumerate(features, start=1):
            longitude, latitude, *height = feature["geometry"]["coordinates"]
            given = {key.lower(): str(value) for key, value in feature["properties"].items()}
            row = {_NAMES.get(key, key): value for key, value in given.items()}
            row |= {"lat": str(latitude), "lon": str(longitude)}
            yield number, row | ({"z": str(height[0])} if height else {})
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{source}: is not a GeoJSON FeatureCollection of points ({type(error).__name__} "
            f"{error})"
        ) from error


def _kind(row: Mapping[str, str], line: int, source: Path) -> tuple[str, str]:
    for pair in _PAIRS:
        if all(row.get(name) for name in pair):
            return pair
    raise InputError(
        f"{source}, line {line}: no position; expected the columns lat,lon or x,y or u,v, "
        f"found {', '.join(row) or 'none'}"
    )


def _given(row: Mapping[str, str], line: int, kind: tuple[str, str], source: Path) -> GivenAnchor:
    def number(name: str) -> float | None:
        if not row.get(name):
            return None
        try:
            value = float(row[name])
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise InputError(f"{source}, line {line}: {name} {row[name]!r} is not a number")
        return value

    node, time = row.get("node") or None, row.get("time") or None
    if (node is None) == (time is None):
        raise InputError(f"{source}, line {line}: give a node or a time, one of them")
    first, second = (number(name) for name in kind)
    assert first is not None
    assert second is not None
    if kind == ("lat", "lon") and not (abs(first) <= 90 and abs(second) <= 180):
        raise InputError(f"{source}, line {line}: {first}, {second} is not latitude, longitude")
    sigma_m = number("sigma")
    if sigma_m is not None and sigma_m <= 0:
        raise InputError(f"{source}, line {line}: sigma is {sigma_m}, must be > 0")
    time_ns = None if time is None else _time_ns(time, line, source)
    return GivenAnchor(line, node, time_ns, (first, second), number("z"), sigma_m)


def _time_ns(text: str, line: int, source: Path) -> int:
    """ISO 8601, or seconds since 1970."""
    try:
        return round(float(text) * 1e9)
    except (ValueError, OverflowError):
        pass
    try:
        found = parse_start(text)
    except ConfigError as error:
        raise InputError(f"{source}, line {line}: {error}") from error
    assert found is not None
    return found


def _on_grid(given: list[GivenAnchor], grid: Path) -> list[GivenAnchor]:
    """Pixels of an occupancy grid as metres in its frame; metres stay."""
    try:
        about = yaml.safe_load(grid.read_text(encoding="utf-8"))
        resolution = float(about["resolution"])
        left, bottom, turned = (float(value) for value in about["origin"][:3])
        picture = grid.parent / str(about["image"])
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{grid}: is not a map.yaml of an occupancy grid: {error}") from error
    if turned:
        raise InputError(f"{grid}: its origin is turned by {turned} rad; only 0 is supported")
    image = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(f"{picture}: the image of {grid} cannot be read")
    height = image.shape[0]
    return [
        GivenAnchor(
            one.line, one.node, one.time_ns,
            (left + resolution * (one.position[0] + 0.5),
             bottom + resolution * (height - one.position[1] - 0.5)),
            one.z_m, one.sigma_m,
        )
        for one in given
    ]  # fmt: skip


def _nodes_of(store: Map, given: list[GivenAnchor]) -> tuple[list[Node], list[GivenAnchor]]:
    """The node of each anchor, and the anchors that have one; of one node the first counts."""
    stamps, order = _utc_stamps(store)
    found: dict[Node, GivenAnchor] = {}
    for one in given:
        if one.node is not None:
            origin = store.origin(one.node)
            found.setdefault(store.graph.node(store.graph.index(origin.node)), one)
        elif one.time_ns is not None and len(stamps):
            at = int(np.argmin(np.abs(stamps - one.time_ns)))
            if abs(int(stamps[at]) - one.time_ns) <= _NEAR_NS:
                found.setdefault(store.graph.node(int(order[at])), one)
    if not found:
        raise InputError(
            f"{store.location}: no anchor is of one of its nodes; times are UTC, and count for "
            "drives whose clock is UTC (see engram amend --recorded-at)"
        )
    return list(found), list(found.values())


def _utc_stamps(store: Map) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """UTC of the nodes of drives whose clock is UTC, and their dense indices."""
    known = [
        (node.stamp_ns + store.sessions[node.session].shift_ns, at)
        for at, node in enumerate(store.graph.nodes)
        if store.sessions[node.session].clock is Clock.UTC
    ]
    both = np.array(known, np.int64).reshape(-1, 2)
    return both[:, 0], both[:, 1]


def _origin(store: Map, known: list[GivenAnchor]) -> tuple[float, float]:
    """Latitude and longitude of the frame's origin: as before, else the first anchor's."""
    return store.frame.origin or known[0].position


def _check_spread(positions: NDArray[np.float64], source: Path) -> None:
    far_m = np.linalg.norm(positions - positions[0], axis=1).max()
    if not far_m >= _LEAST_APART_M:
        raise InputError(
            f"{source}: its anchors lie within {far_m:.1f} m; at least two must be "
            f"{_LEAST_APART_M:.0f} m apart to tell a direction"
        )


def _anchored(store: Map, anchors: list[Anchor]) -> Anchored:
    return Anchored(
        np.array([store.graph.index(one.node) for one in anchors], np.int64),
        np.array([(one.x_m, one.y_m, np.nan if one.z_m is None else one.z_m) for one in anchors]),
        np.array([one.sigma_m for one in anchors]),
    )


def _residuals(frame: MapFrame, anchors: list[Anchor]) -> dict[str, float]:
    return {
        str(one.node): float(np.hypot(*(frame.pose(one.node).translation[:2] - (one.x_m, one.y_m))))
        for one in anchors
    }


def _write(
    store: Map,
    anchors: list[Anchor],
    frame: MapFrame,
    origin: tuple[float, float] | None,
    author: str,
    source: Path,
) -> int:
    about = {"anchor": {"source": source.name, "anchors": len(anchors)}}
    with store.begin_revision(
        author=author, message=f"anchor {len(anchors)} nodes", configuration=about
    ) as writer:
        for one in anchors:
            writer.add_mark(one)
        for placement in changed(store.placements, store.graph, frame.poses):
            writer.add_mark(placement)
        if origin is not None:
            body = {"latitude_deg": origin[0], "longitude_deg": origin[1]}
            writer.put_statistic(ORIGIN, body)
        elif store.frame.origin is not None:
            writer.put_statistic(ORIGIN, {})
        return writer.commit().number
