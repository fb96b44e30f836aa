"""Anchoring: the map frame is fitted to where nodes are known to be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.counts import counted
from engram.errors import InputError
from engram.graph.marks import Anchor
from engram.graph.model import Clock, Node
from engram.graph.placing import DEFAULT_CONFIG as PLACING
from engram.graph.placing import Anchored, PlacingConfig, anchor
from engram.maps import Map, MapFrame, Moves, moves
from engram.maps.laying_out import ORIGIN
from engram.maps.map_frame import changed, local_m
from engram.robot.anchors import NEAR_NS, GivenAnchor, on_grid, read_anchors
from engram.robot.fixed import anchors_of_fixes
from engram.sequences.bags import is_bag
from engram.sequences.bags.fixes import read_fixes

# Standard deviation of an anchor whose line names none, metres: a GPS receiver's, a click's.
_GPS_SIGMA_M, _GRID_SIGMA_M = 2.0, 0.3
# Anchors must be this far apart to tell a direction, metres.
_LEAST_APART_M = 5.0
# An anchor this many standard deviations off does not fit.
_OUTLIER_SIGMAS = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class AnchorReport:
    """Result of anchoring.

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
        path: the map.
        source: CSV or GeoJSON with a node or a time and a position per line; or a bag with the
            fixes of a satellite receiver.
        topic: topic of the fixes; None if the bag has only one.
        grid: ``map.yaml`` of an occupancy grid, whose pixels the positions are.
        author: of the revision.
        dry_run: only report.
        placing: how the frame is laid out.

    Raises:
        InputError: the file cannot be read, names no node of the map, or too few of them.
        MapError: the map cannot be read or written.
    """
    with Map.open(path, writes=not dry_run) as store:
        given, geographic = _given(store, source, grid, topic)
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
        frame = store.frame
        before = {one.node: one.map_from_node for one in frame.placements()}
        poses = anchor(store.graph, before, _anchored(store, anchors), placing)
        after = MapFrame(store.graph, poses, origin)
        residuals = _residuals(after, anchors)
        about = {"author": author, **_about(source, anchors)}
        revision = None if dry_run else _write(store, anchors, after, about, placing)
        places = {one.node: one.map_from_node for one in after.placements()}
        moved = moves(before, places, store.goals.values())
    outliers = tuple(
        str(one.node) for one in anchors if residuals[str(one.node)] > _OUTLIER_SIGMAS * one.sigma_m
    )
    return AnchorReport(revision, len(anchors), len(given) - len(known), residuals, outliers, moved)


def _given(
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
    far_m = np.linalg.norm(positions - positions[0], axis=1).max()
    if not far_m >= _LEAST_APART_M:
        raise InputError(
            f"{source}: its anchors lie within {far_m:.1f} m; at least two must be "
            f"{_LEAST_APART_M:.0f} m apart to determine a direction"
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


def _about(source: Path, anchors: list[Anchor]) -> dict[str, Any]:
    about = {"anchor": {"source": source.name, "anchors": len(anchors)}}
    return {"message": f"anchor {counted(len(anchors), 'node')}", "configuration": about}


def _write(
    store: Map,
    anchors: list[Anchor],
    frame: MapFrame,
    about: dict[str, Any],
    placing: PlacingConfig,
) -> int:
    origin = frame.origin
    with store.begin_revision(**about) as writer:
        for one in anchors:
            writer.add_mark(one)
        for placement in changed(store.placements, store.graph, frame.poses, placing.same_m):
            writer.add_mark(placement)
        if origin is not None:
            body = {"latitude_deg": origin[0], "longitude_deg": origin[1]}
            writer.put_statistic(ORIGIN, body)
        elif store.frame.origin is not None:
            writer.put_statistic(ORIGIN, {})
        return writer.commit(placing).number
