"""Anchors and goals: nodes in the map frame, from files and satellite receivers.

Parts of a map that nothing ties are joined where their anchors say that they are one place.
Anchors, such as satellite fixes, only propose which nodes may show the same; matches decide, two
that lie apart and agree.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.calibration.calibrated_pair import MAX_CHARACTERS, read_yaml
from engram.config import PUBLIC, check_bounds
from engram.counts import counted
from engram.errors import ConfigError, InputError, MapCorruptError
from engram.frontend.frame import Frame
from engram.frontend.frontend import as_live
from engram.frontend.matching import match_frames, pair_seed
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Anchor, Clock, Edge, EdgeKind, Goal, LandmarkSource, Node
from engram.graph.placing import DEFAULT_CONFIG as PLACING
from engram.graph.placing import (
    LEAST_APART_M,
    Anchored,
    PlacingConfig,
    Poses,
    anchor,
    farthest_m,
)
from engram.localiser.acceptance import AcceptanceConfig
from engram.localiser.relocalisation import Relocaliser, Suggested
from engram.mapper.loops import edges_agree
from engram.maps.map import Map
from engram.maps.map_frame import FARTHEST_M, ORIGIN, Layout, Moves, changed, local_m, moves
from engram.monitor import QUIET, Monitor
from engram.robot.localisers import DriveSequence, relocaliser_in
from engram.robot.settings import Settings
from engram.sequences.bags.bag_sequence import BagSequence
from engram.sequences.bags.containers import is_bag
from engram.sequences.bags.fixes import Fix, read_fixes
from engram.sequences.images import image_size
from engram.sequences.sequence import parse_time
from engram.untrusted import read_text

# Farthest in time from a node that a line with a time may be.
NEAR_NS = 500_000_000
# Nothing is surveyed better.
_LEAST_SIGMA_M = 1e-4


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


def read_anchors(source: Path) -> tuple[list[GivenAnchor], bool]:
    """The anchors of a file, and whether they are latitudes and longitudes."""
    text = read_text(source, InputError)
    is_json = source.suffix.lower() in {".geojson", ".json"}
    rows = _json_rows(text, source) if is_json else _csv_rows(text, source)
    found = [(line, row) for line, row in rows]
    if not found:
        raise InputError(f"{source}: holds no anchors")
    kinds = {_kind(row, line, source) for line, row in found}
    if len(kinds) > 1:
        raise InputError(f"{source}: mixes {' and '.join(sorted('/'.join(k) for k in kinds))}")
    (kind,) = kinds
    return [_given_in_row(row, line, kind, source) for line, row in found], kind == ("lat", "lon")


_NAMES = {
    "latitude": "lat", "longitude": "lon", "lng": "lon", "altitude": "z", "alt": "z",
    "height": "z", "x_m": "x", "y_m": "y", "z_m": "z", "sigma_m": "sigma", "stamp": "time",
    "timestamp": "time",
}  # fmt: skip
_PAIRS = (("lat", "lon"), ("x", "y"), ("u", "v"))


def _csv_rows(text: str, source: Path) -> Iterable[tuple[int, dict[str, str]]]:
    reader = csv.DictReader(text.splitlines())
    if reader.fieldnames is None:
        raise InputError(f"{source}: is empty; expected a header such as node,x,y or time,lat,lon")
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


def _given_in_row(
    row: Mapping[str, str], line: int, kind: tuple[str, str], source: Path
) -> GivenAnchor:
    def number(name: str) -> float | None:
        if not row.get(name):
            return None
        try:
            value = float(row[name])
        except ValueError:
            value = float("nan")
        if not abs(value) <= FARTHEST_M:
            raise InputError(
                f"{source}, line {line}: {name} {row[name]!r} is not a number of at most "
                f"{FARTHEST_M:g}"
            )
        return value

    node, time = row.get("node") or None, row.get("time") or None
    if (node is None) == (time is None):
        raise InputError(f"{source}, line {line}: give either a node or a time")
    first, second = (number(name) for name in kind)
    assert first is not None
    assert second is not None
    if kind == ("lat", "lon") and not (abs(first) <= 90 and abs(second) <= 180):
        raise InputError(f"{source}, line {line}: {first}, {second} is not latitude, longitude")
    sigma_m = number("sigma")
    if sigma_m is not None and sigma_m < _LEAST_SIGMA_M:
        raise InputError(
            f"{source}, line {line}: sigma is {sigma_m}, must be at least {_LEAST_SIGMA_M:g} m"
        )
    time_ns = None if time is None else _time_ns(time, line, source)
    return GivenAnchor(line, node, time_ns, (first, second), number("z"), sigma_m)


def _time_ns(text: str, line: int, source: Path) -> int:
    """ISO 8601, or seconds since 1970."""
    try:
        return round(float(text) * 1e9)
    except (ValueError, OverflowError):
        pass
    try:
        found = parse_time("stamp", text)
    except ConfigError as error:
        raise InputError(f"{source}, line {line}: {error}") from error
    assert found is not None
    return found


def on_grid(given: list[GivenAnchor], grid: Path) -> list[GivenAnchor]:
    """Pixels of an occupancy grid as metres in its frame; metres stay."""
    try:
        about = read_yaml(read_text(grid, InputError, 4 * MAX_CHARACTERS))
        resolution = float(about["resolution"])
        left, bottom, turned = (float(value) for value in about["origin"][:3])
        picture = grid.parent / str(about["image"])
    except (KeyError, TypeError, ValueError) as error:  # InputError is a ValueError
        raise InputError(f"{grid}: is not a map.yaml of an occupancy grid: {error}") from error
    if turned:
        raise InputError(f"{grid}: its origin is turned by {turned} rad; only 0 is supported")
    _, height = image_size(picture)
    return [
        GivenAnchor(
            one.line, one.node, one.time_ns,
            (left + resolution * (one.position[0] + 0.5),
             bottom + resolution * (height - one.position[1] - 0.5)),
            one.z_m, one.sigma_m,
        )
        for one in given
    ]  # fmt: skip


# Standard deviation of a fix that states none, metres.
_USUAL_SIGMA_M = 5.0

# A robot drives straight enough between fixes that are closer in time.
_APART_NS = 2_000_000_000


def anchors_of_fixes(fixes: Sequence[Fix], nodes_ns: NDArray[np.int64]) -> list[GivenAnchor]:
    """One anchor for each fix that has a node near it in time.

    The receiver's position is interpolated to the time of the node. At a fix a second, the nearest
    fix would be metres off.

    Args:
        fixes: by rising time. The receiver counts as being at the camera.
        nodes_ns: (N,) int64, UTC of the nodes, ns.

    Returns:
        An anchor for each fix; those without a node keep the fix's time.
    """
    times_ns = np.array([one.time_ns for one in fixes], np.int64)
    ordered = np.sort(nodes_ns)
    found = []
    for number, fix in enumerate(fixes):
        time_ns, position = fix.time_ns, (fix.latitude_deg, fix.longitude_deg)
        at = _nearest(ordered, time_ns)
        if at is not None:
            time_ns, position = at, _position(fixes, times_ns, at, number)
        found.append(GivenAnchor(number + 1, None, time_ns, position, None, fix.sigma_m))
    return found


def _nearest(ordered_ns: NDArray[np.int64], time_ns: int) -> int | None:
    """The nearest time of a node; None if it is too far away."""
    after = int(np.searchsorted(ordered_ns, time_ns))
    near = [int(one) for one in ordered_ns[max(after - 1, 0) : after + 1]]
    best = min(near, key=lambda one: abs(one - time_ns), default=None)
    return None if best is None or abs(best - time_ns) > NEAR_NS else best


def _position(
    fixes: Sequence[Fix], times_ns: NDArray[np.int64], at_ns: int, number: int
) -> tuple[float, float]:
    """The receiver's position at a time near a fix: between it and its neighbour."""
    after = int(np.clip(np.searchsorted(times_ns, at_ns), 1, max(len(fixes) - 1, 1)))
    if len(fixes) < 2 or times_ns[after] - times_ns[after - 1] > _APART_NS:
        return fixes[number].latitude_deg, fixes[number].longitude_deg
    a, b = fixes[after - 1], fixes[after]
    share = (at_ns - a.time_ns) / (b.time_ns - a.time_ns)
    return (
        a.latitude_deg + share * (b.latitude_deg - a.latitude_deg),
        a.longitude_deg + share * (b.longitude_deg - a.longitude_deg),
    )


class LatestFix:
    """The newest fix of a stream at a time that rises from call to call."""

    def __init__(self, fixes: Iterator[Fix]) -> None:
        self._fixes = fixes
        self._latest: Fix | None = None
        self._next = next(fixes, None)

    def __call__(self, time_ns: int) -> Fix | None:
        """The newest fix before a time; None if it is older than two seconds."""
        while self._next is not None and self._next.time_ns <= time_ns:
            self._latest, self._next = self._next, next(self._fixes, None)
        latest = self._latest
        return None if latest is None or time_ns - latest.time_ns > _APART_NS else latest


class ReceiverFix:
    """Latest fix of the robot's GNSS receiver."""

    def __init__(self) -> None:
        self._latest: Fix | None = None

    def tell(self, fix: Fix) -> None:
        """Takes a newer fix."""
        self._latest = fix

    def __call__(self, time_ns: int) -> Fix | None:
        """The newest fix; None if it is more than two seconds from a time."""
        latest = self._latest
        return None if latest is None or abs(time_ns - latest.time_ns) > _APART_NS else latest


NewestFix = Callable[[int], Fix | None]


def fixes_of(sequence: DriveSequence) -> NewestFix | None:
    """The newest satellite fix of a drive at a time, ns; None if it has none: only bags do."""
    fixes = sequence.fixes() if isinstance(sequence, BagSequence) else None
    return None if fixes is None else LatestFix(fixes)


def suggesting(
    opened: Map,
    latest: NewestFix | None,
    settings: Settings,
    name: str | None,
    graph: ExperienceGraph,
) -> str | Relocaliser | None:
    """A relocaliser that also proposes nodes near a receiver's newest fix.

    Args:
        opened: the map; fixes propose nothing in one that is not anchored to the earth.
        latest: the newest fix at a time, ns; None if there are none.
        settings: `localiser.fix_sigmas` says how far from a fix nodes are proposed.
        name: one of `relocaliser_names()`; None for none.
        graph: the graph of the localiser.

    Returns:
        `name`, if fixes are not to be used.
    """
    sigmas = settings.localiser.fix_sigmas
    if latest is None or not sigmas or ORIGIN not in opened.statistics():
        return name
    descriptor = settings.frontend.descriptor
    inner = None if name is None else relocaliser_in(opened, name, descriptor, graph)
    return Suggested(inner, nodes_near(opened, graph, latest, sigmas))


def nodes_near(
    opened: Map, graph: ExperienceGraph, latest: NewestFix, sigmas: float
) -> Callable[[Frame], list[int]]:
    """The nodes near the newest fix, for `Suggested`.

    Args:
        opened: the map, anchored to the earth.
        graph: gives the dense indices of the nodes.
        latest: the newest fix at a time, ns; None without one.
        sigmas: how far from a fix, in its standard deviations.
    """
    frame = opened.frame

    def suggest(live: Frame) -> list[int]:
        fix = latest(live.stamp_ns)
        if fix is None:
            return []
        within_m = sigmas * (fix.sigma_m or _USUAL_SIGMA_M)
        near = frame.near(fix.latitude_deg, fix.longitude_deg, within_m)
        return [graph.index(one) for one in near]

    return suggest


# Standard deviation of an anchor whose line names none, metres: a GPS receiver's, a click's.
_GPS_SIGMA_M, _GRID_SIGMA_M = 2.0, 0.3
# An anchor this many standard deviations off does not fit.
_OUTLIER_SIGMAS = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class AnchorReport:
    """Result of anchoring.

    Attributes:
        revision: its number; None for a preview.
        residuals_m: distance of each anchored node from its anchor afterwards, by node.
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
            f"{counted(self.anchors, 'anchor')}: residuals median {np.median(far_m):.2f} m, 90 % "
            f"{np.percentile(far_m, 90):.2f} m, largest {far_m.max():.2f} m"
        ]
        if self.unplaced:
            lines.append(
                f"{counted(self.unplaced, 'line')} left out: no node within 0.5 s of their time"
            )
        lines += [f"does not fit: node {node}" for node in self.outliers]
        if self.moved:
            lines.append(self.moved.text())
        lines.append(
            "preview: nothing was written" if self.revision is None else f"revision {self.revision}"
        )
        return "\n".join(lines)


def anchor_map(
    path: Path,
    source: Path,
    *,
    grid: Path | None = None,
    topic: str | None = None,
    author: str,
    dry_run: bool = False,
    placing: PlacingConfig = PLACING,
) -> AnchorReport:
    """Fits the map frame to known positions, in a revision of its own.

    Args:
        source: CSV or GeoJSON with a node or a time and a position per line; or a bag with the
            fixes of a satellite receiver.
        topic: topic of the fixes; None if the bag has only one.
        grid: ``map.yaml`` of an occupancy grid, whose pixels the positions are.
        dry_run: only report.
        placing: how the frame is laid out.
    """
    with Map.open(path, writes=not dry_run) as store:
        given, geographic = _given_by_source(store, source, grid, topic)
        nodes, known = _nodes_of(store, given, source)
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
        before = {one.node: one.map_from_node for one in store.layout().placements()}
        poses = anchor(store.graph, before, _anchored(store, anchors), placing)
        after = Layout(store.graph, poses)
        residuals = _residuals(after, anchors)
        about = {"author": author, **_about(source, anchors)}
        revision = None if dry_run else _write(store, anchors, poses, origin, about, placing)
        places = {one.node: one.map_from_node for one in after.placements()}
        moved = moves(before, places, store.goals.values())
    outliers = tuple(
        str(one.node) for one in anchors if residuals[str(one.node)] > _OUTLIER_SIGMAS * one.sigma_m
    )
    return AnchorReport(revision, len(anchors), len(given) - len(known), residuals, outliers, moved)


def _given_by_source(
    store: Map, source: Path, grid: Path | None, topic: str | None
) -> tuple[list[GivenAnchor], bool]:
    """The anchors of a source, and whether they are latitudes and longitudes."""
    if is_bag(source):
        if grid is not None:
            raise InputError(f"{source}: a bag holds latitudes and longitudes; leave out --grid")
        return anchors_of_fixes(read_fixes(source, topic), _utc_stamps(store)[0]), True
    if topic is not None:
        raise InputError(f"--topic names fixes of a bag; {source} is not a bag")
    given, geographic = read_anchors(source)
    return (given, geographic) if grid is None else (on_grid(given, grid), False)


def _nodes_of(
    store: Map, given: list[GivenAnchor], source: Path
) -> tuple[list[Node], list[GivenAnchor]]:
    """The node of each anchor, and the anchors that have one; of one node the first counts."""
    stamps, order = _utc_stamps(store)
    found: dict[Node, GivenAnchor] = {}
    for one in given:
        if one.node is not None:
            try:
                origin = store.origin(one.node)
            except InputError as error:
                raise InputError(f"{source}: {error}") from error
            found.setdefault(store.graph.node(store.graph.index(origin.node)), one)
        elif one.time_ns is not None and len(stamps):
            at = int(np.argmin(np.abs(stamps - one.time_ns)))
            if abs(int(stamps[at]) - one.time_ns) <= NEAR_NS:
                found.setdefault(store.graph.node(int(order[at])), one)
    if not found:
        raise InputError(
            f"{source}: none of the anchors belongs to one of the nodes of {store.location}; times "
            "are UTC, and match only drives whose clock is UTC (see engram amend --recorded-at)"
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
    far_m = farthest_m(positions)
    if not far_m >= LEAST_APART_M:
        raise InputError(
            f"{source}: its anchors lie within {far_m:.1f} m; at least two must be "
            f"{LEAST_APART_M:.0f} m apart to determine a direction"
        )


def _anchored(store: Map, anchors: list[Anchor]) -> Anchored:
    return Anchored(
        np.array([store.graph.index(anchor.node) for anchor in anchors], np.int64),
        np.array(
            [
                (anchor.x_m, anchor.y_m, np.nan if anchor.z_m is None else anchor.z_m)
                for anchor in anchors
            ]
        ),
        np.array([anchor.sigma_m for anchor in anchors]),
    )


def _residuals(layout: Layout, anchors: list[Anchor]) -> dict[str, float]:
    return {
        str(anchor.node): float(
            np.hypot(*(layout.pose(anchor.node).translation[:2] - (anchor.x_m, anchor.y_m)))
        )
        for anchor in anchors
    }


def _about(source: Path, anchors: list[Anchor]) -> dict[str, Any]:
    about = {"anchor": {"source": source.name, "anchors": len(anchors)}}
    return {"message": f"anchor {counted(len(anchors), 'node')}", "configuration": about}


def _write(
    store: Map,
    anchors: list[Anchor],
    poses: Poses,
    origin: tuple[float, float] | None,
    about: dict[str, Any],
    placing: PlacingConfig,
) -> int:
    with store.begin_revision(**about) as writer:
        for anchor in anchors:
            writer.add_mark(anchor)
        for placement in changed(store.placements, store.graph, poses, placing.same_m):
            writer.add_mark(placement)
        if origin is not None:
            body = {"latitude_deg": origin[0], "longitude_deg": origin[1]}
            writer.put_statistic(ORIGIN, body)
        elif store.frame.origin is not None:
            writer.put_statistic(ORIGIN, {})
        return writer.commit(placing).number


# A goal that comes back as near to one that was removed is that goal.
_SAME_M, _SAME_RAD = 0.2, 0.1


def add_goal(
    path: Path, name: str, x_m: float, y_m: float, yaw_rad: float, *, author: str
) -> dict[str, Any]:
    """Stores a pose of the map frame as a goal, in a revision of its own.

    Returns:
        The goal as `list_goals` describes it; `replaced`, the earlier goal of its name or None; and
        the number of the `revision`.
    """
    if not name.strip():
        raise InputError("a goal needs a name")
    with Map.open(path, writes=True) as store:
        before, goal = store.goals.get(name), store.frame.goal(x_m, y_m, yaw_rad, name)
        about = {"goal": {"name": name, "x_m": x_m, "y_m": y_m, "yaw_rad": yaw_rad}}
        with store.begin_revision(
            author=author, message=f"goal {name}", configuration=about
        ) as writer:
            writer.add_mark(goal)
            revision = writer.commit().number
        replaced = None if before is None else _described(before, store)
        return {**_described(goal, store), "replaced": replaced, "revision": revision}


def remove_goal(path: Path, name: str, *, author: str) -> dict[str, Any]:
    """Removes a goal, in a revision of its own that `Map.revert` undoes."""
    with Map.open(path, writes=True) as store:
        if name not in store.goals:
            known = ", ".join(sorted(store.goals)) or "none"
            raise InputError(f"{path} has no goal {name!r}; its goals: {known}")
        with store.begin_revision(
            author=author, message=f"remove goal {name}", configuration={"removed_goal": name}
        ) as writer:
            writer.remove_goal(name)
            return {"name": name, "revision": writer.commit().number}


def had_goal(seen: Iterable[Goal], graph: ExperienceGraph, goal: Goal) -> bool:
    """Whether a map ever had a goal of this name at this place, at nodes that it has.

    Args:
        seen: `Map.seen_goals`.
        graph: the map's.
        goal: the goal.
    """
    for one in seen:
        if one.name != goal.name or one.node not in graph or goal.node not in graph:
            continue
        way = graph.predict(graph.index(one.node), graph.index(goal.node))
        if way is not None:
            apart = one.node_from_goal.inverse() @ way[0] @ goal.node_from_goal
            if apart.distance_m <= _SAME_M and apart.angle_rad <= _SAME_RAD:
                return True
    return False


def list_goals(path: Path, at: int | str | None = None) -> list[dict[str, Any]]:
    """The goals of a map by name, and where they lie now."""
    with Map.open(path, at=at) as store:
        return [_described(goal, store) for _, goal in sorted(store.goals.items())]


def _described(goal: Goal, store: Map) -> dict[str, Any]:
    """Name, node and place of a goal."""
    return {
        "name": goal.name,
        "node": str(goal.node),
        "from_node_m": round(goal.node_from_goal.distance_m, 3),
        **store.frame.locate(goal).to_dict(),
    }


T = TypeVar("T")

# Matches between two parts that are compared with each other, way by way.
_JUDGED = 40


@dataclass(frozen=True, slots=True)
class IslandsConfig:
    """Which nodes of two parts are compared, and which matches join them.

    Attributes:
        sigmas: nodes are compared up to so many standard deviations of their parts' anchors.
        reach_m: and this much farther, as separate views match, too.
        turn_rad: largest difference of their headings.
        nearest: nodes of the other part that each node is compared with.
        attempts: most matches that are tried between two parts.
        apart_m: least distance between two matches that confirm each other. Source: that of loops.
        certain_m: largest standard deviation of the distances between them.
    """

    sigmas: Annotated[float, Meta(gt=0, le=10), PUBLIC] = 3.0
    reach_m: Annotated[float, Meta(ge=0, le=50), PUBLIC] = 4.0
    turn_rad: Annotated[float, Meta(gt=0, le=np.pi)] = 0.8
    nearest: Annotated[int, Meta(ge=1, le=100)] = 5
    attempts: Annotated[int, Meta(ge=1, le=100_000)] = 400
    apart_m: Annotated[float, Meta(ge=0, le=100)] = 8.0
    certain_m: Annotated[float, Meta(gt=0, le=100)] = 1.0

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True)
class IslandReport:
    """Result of joining the parts of a map.

    Attributes:
        revision: its number; None if nothing was joined.
        joined: nodes of both sides of each edge that joins two parts.
    """

    revision: int | None = None
    compared: int = 0
    joined: tuple[tuple[str, str], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """What ``anchor --json`` prints under ``islands``."""
        return {"revision": self.revision, "compared": self.compared, "joined": list(self.joined)}

    def text(self) -> str:
        """In words; "" if there was nothing to compare."""
        if not self.compared:
            return ""
        if self.revision is None:
            pairs = counted(self.compared, "pair")
            return f"unconnected parts: {pairs} of nodes compared, none joins them"
        return (
            f"unconnected parts: {counted(len(self.joined), 'match')} of {self.compared} joined, "
            f"revision {self.revision}"
        )


def join_islands(
    path: Path,
    author: str,
    settings: Settings | None = None,
    config: IslandsConfig | None = None,
    monitor: Monitor = QUIET,
) -> IslandReport:
    """Joins the parts of an anchored map that show the same places, in a revision of its own."""
    with Map.open(path, writes=True) as store:
        resolved = (settings or Settings()).for_descriptor(store.descriptor)
        islands = _Islands(store.layout(), store.frames, resolved, config)
        edges = islands.edges(_sigmas_m(store), monitor)
        ids = tuple((str(edge.a), str(edge.b)) for edge in edges)
        if not edges:
            return IslandReport(None, islands.compared, ids)
        about = {"islands": {"compared": islands.compared, "joined": len(edges)}}
        with store.begin_revision(
            author=author,
            message=f"join parts by {counted(len(edges), 'match')}",
            configuration=about,
        ) as writer:
            for edge in edges:
                writer.add_edge(edge)
            number = writer.commit(resolved.placing).number
        return IslandReport(number, islands.compared, ids)


def _sigmas_m(store: Map) -> dict[int, float]:
    """Standard deviation of the anchors of each component that has two or more, by label."""
    labels = store.graph.components()
    found: dict[int, list[float]] = {}
    for one in store.anchors:
        if one.node in store.graph:
            label = int(labels[store.graph.index(one.node)])
            found.setdefault(label, []).append(one.sigma_m)
    return {label: float(np.median(all_m)) for label, all_m in found.items() if len(all_m) > 1}


class _Islands:
    """Compares the nodes of parts that lie at the same place."""

    def __init__(
        self,
        layout: Layout,
        frames: LandmarkSource,
        settings: Settings,
        config: IslandsConfig | None,
    ) -> None:
        self.compared = 0
        self._graph, self._frames = layout.graph, frames
        self._places = layout.positions[:, :2]
        self._ahead = layout.poses.rotations[:, :2, 2]
        self._matcher = settings.localiser.matcher
        self._acceptance: AcceptanceConfig = settings.localiser.acceptance
        self._config = config or IslandsConfig()

    def edges(self, sigmas_m: dict[int, float], monitor: Monitor) -> list[Edge]:
        """The matches that join parts, each confirmed by another.

        Args:
            sigmas_m: of the anchors, by label of the parts that have some.
            monitor: receives progress, and may cancel.
        """
        labels = self._graph.components()
        found: list[Edge] = []
        with monitor.stage("parts that nothing ties", len(sigmas_m)) as stage:
            for one, other in combinations(sorted(sigmas_m), 2):
                within_m = self._config.sigmas * float(np.hypot(sigmas_m[one], sigmas_m[other]))
                within_m += self._config.reach_m
                sides = np.flatnonzero(labels == one), np.flatnonzero(labels == other)
                found += self._confirmed(list(self._matches(*sides, within_m)))
                stage.check()
        return found

    def _matches(
        self, ones: NDArray[np.int64], others: NDArray[np.int64], within_m: float
    ) -> Iterator[Edge]:
        """The matches between two parts, of nodes that may show the same."""
        low, high = self._places[others].min(axis=0), self._places[others].max(axis=0)
        inside = (self._places[ones] > low - within_m) & (self._places[ones] < high + within_m)
        near = ones[inside.all(axis=1)]
        pairs = [pair for one in near for pair in self._near(int(one), others, within_m)]
        for pair in _evenly(pairs, self._config.attempts):
            edge = self._match(*pair)
            if edge is not None:
                yield edge

    def _near(self, node: int, others: NDArray[np.int64], within_m: float) -> list[tuple[int, int]]:
        far_m = np.linalg.norm(self._places[others] - self._places[node], axis=1)
        alike = self._ahead[others] @ self._ahead[node] >= np.cos(self._config.turn_rad)
        order = np.argsort(np.where(alike, far_m, np.inf), kind="stable")[: self._config.nearest]
        return [(node, int(others[at])) for at in order if alike[at] and far_m[at] <= within_m]

    def _match(self, a: int, b: int) -> Edge | None:
        """The match of two nodes, if it would place a lost robot."""
        self.compared += 1
        ids = self._graph.node(a).id, self._graph.node(b).id
        try:
            match = match_frames(
                self._frames.frame(ids[0]),
                as_live(self._frames.frame(ids[1])),
                self._matcher,
                pair_seed(ids[1], ids[0]),
            )
        except MapCorruptError:
            return None
        pose, covariance = match.reference_from_live, match.covariance
        if pose is None or covariance is None or pose.distance_m > self._acceptance.reach_m:
            return None
        if match.inliers < self._acceptance.min_inliers_plausible:
            return None
        sure = np.trace(covariance[:3, :3]) <= self._acceptance.max_sigma_m**2
        return Edge(*ids, EdgeKind.MATCH, pose, covariance) if sure else None

    def _confirmed(self, edges: list[Edge]) -> list[Edge]:
        """The largest group of matches that confirm each other, one of each place."""
        config, graph = self._config, self._graph
        best: list[Edge] = []
        judged = _evenly(edges, _JUDGED)
        for first in judged:
            group = [first]
            for edge in judged:
                ends = [(edge.a, group[-1].a), (edge.b, group[-1].b)]
                ways = [graph.predict(graph.index(then), graph.index(to)) for to, then in ends]
                apart = all(way is not None and way[0].distance_m >= config.apart_m for way in ways)
                if apart and edges_agree(
                    graph, group[-1], edge, self._acceptance, config.certain_m
                ):
                    group.append(edge)
            best = max(best, group, key=len)
        return best if len(best) > 1 else []


def _evenly(items: list[T], most: int) -> list[T]:
    """A given number of items, spread over a list: what one place hides another may show."""
    if len(items) <= most:
        return items
    return [items[at] for at in np.linspace(0, len(items) - 1, most).astype(np.int64).tolist()]
