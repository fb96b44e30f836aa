"""Takes wrong edges out of a map: a preview, or a revision that can be reverted."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from engram.config import to_dict
from engram.counts import counted
from engram.graph.marks import Removal
from engram.graph.placing import DEFAULT_CONFIG as PLACING
from engram.graph.placing import PlacingConfig
from engram.maps import Map, Moves, moves
from engram.monitor import QUIET, Monitor
from engram.repair.config import RepairConfig
from engram.repair.finding import Finding, Findings, find_wrong_edges
from engram.repair.pictures import write_pictures
from engram.repair.suspects import part_labels

# Edges that the text lists; JSON has all.
_SHOWN = 40


@dataclass(frozen=True, slots=True, eq=False)
class GeometryReport:
    """What ``engram check --geometry`` found, and did.

    Attributes:
        findings: the edges.
        components: number of components without the wrong edges, and with them.
        revision: of the repair; None for a preview.
        moved: what the repair moved in the map frame; None for a preview.
        pictures: number of pictures written.
    """

    findings: Findings
    components: tuple[int, int]
    revision: int | None = None
    moved: Moves | None = None
    pictures: int = 0

    def to_dict(self) -> dict[str, Any]:
        """What ``check --geometry --json`` prints."""
        found = self.findings
        return {
            "wrong": [one.to_dict() for one in found.wrong],
            "doubtful": [one.to_dict() for one in found.doubtful],
            "examined": found.examined,
            "of_edges": found.of_edges,
            "components": {"without": self.components[0], "with": self.components[1]},
            "revision": self.revision,
            "moved": None if self.moved is None else self.moved.to_dict(),
            "pictures": self.pictures,
        }

    def text(self) -> str:
        """In words."""
        found, lines = self.findings, []
        lines += [one.text() for one in found.wrong[:_SHOWN]]
        if len(found.wrong) > _SHOWN:
            lines.append(f"… and {len(found.wrong) - _SHOWN} more; --json lists all")
        lines += [f"doubtful: {one.text()}" for one in found.doubtful[:_SHOWN]]
        lines.append(
            f"{len(found.wrong)} wrong and {len(found.doubtful)} doubtful of "
            f"{counted(found.of_edges, 'edge')}, {found.examined} looked at twice"
        )
        if found.wrong and self.components[0] != self.components[1]:
            parts = counted(self.components[0], "component")
            lines.append(f"without the wrong ones the map has {parts}, not {self.components[1]}")
        if self.revision is not None:
            lines.append(f"removed by revision {self.revision}")
        if self.moved:
            lines.append(self.moved.text())
        return "\n".join(lines)


def check_geometry(
    path: Path,
    config: RepairConfig | None = None,
    *,
    placing: PlacingConfig = PLACING,
    author: str | None = None,
    pictures: Path | None = None,
    monitor: Monitor = QUIET,
) -> GeometryReport:
    """Looks for wrong edges, and removes them on request.

    Args:
        path: the map.
        config: settings.
        placing: how nodes that the wrong edges had misplaced are laid out again.
        author: commits a revision of this author in which the wrong edges no longer count; None
            changes nothing.
        pictures: folder for a picture of both sides of each edge; None for none.
        monitor: receives progress, and may stop the search.

    Raises:
        MapError: the map cannot be read, or written.
        InputError: the pictures cannot be written.
    """
    config = config or RepairConfig()
    with Map.open(path) as store:
        found = find_wrong_edges(
            store.graph, store.path_memory, store.frames, config, monitor=monitor
        )
        written = 0 if pictures is None else write_pictures(store.frames, found, pictures)
        components = _components(store, found)
        if author is None or not found.wrong:
            return GeometryReport(found, components, pictures=written)
        revision, moved = remove_edges(store, found.wrong, config, author, placing)
    return GeometryReport(found, components, revision, moved, written)


def remove_edges(
    store: Map,
    wrong: tuple[Finding, ...],
    config: RepairConfig,
    author: str,
    placing: PlacingConfig = PLACING,
) -> tuple[int, Moves]:
    """Removes edges in a revision of its own.

    Returns:
        Its number, and what it moved in the map frame.
    """
    now_ns = time.time_ns()
    with store.writing():
        before, goals = store.placements, list(store.goals.values())
        about = f"remove {len(wrong)} wrong edge{'s' * (len(wrong) != 1)}"
        with store.begin_revision(
            author=author, message=about, configuration={"repair": to_dict(config)}
        ) as writer:
            for one in wrong:
                edge = one.edge
                writer.add_mark(
                    Removal(edge.a, edge.b, edge.kind, edge.a_from_b, one.text(), now_ns)
                )
            revision = writer.commit(placing)
        store.forget()
        return revision.number, moves(before, store.placements, goals)


def _components(store: Map, found: Findings) -> tuple[int, int]:
    """Number of components without the wrong edges, and with them."""
    graph = store.graph
    kept = np.ones(len(graph.edges), np.bool_)
    kept[[one.row for one in found.wrong]] = False
    every = (part_labels(graph.edge_ends[rows], len(graph)) for rows in (kept, slice(None)))
    without, whole = (len(np.unique(labels)) for labels in every)
    return without, whole
