"""Takes wrong edges out of a map: a preview, or a revision that can be reverted."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.config import to_dict
from engram.counts import counted
from engram.errors import InputError, MapCorruptError
from engram.frontend.features import feature_kind
from engram.frontend.frontend import as_live
from engram.frontend.matching import match_frames, pair_seed
from engram.graph.model import NodeId, Removal
from engram.graph.placing import DEFAULT_CONFIG as PLACING
from engram.graph.placing import PlacingConfig
from engram.maps.frame_reader import FrameReader
from engram.maps.map import Map
from engram.maps.map_frame import Moves, moves
from engram.monitor import QUIET, Monitor
from engram.repair.finding import Finding, Findings, RepairConfig, find_wrong_edges, part_labels
from engram.viewing.pictures import match_picture, with_caption

# Rows of pixels of a picture; stored thumbnails are small.
_HEIGHT_PX = 360


def write_pictures(frames: FrameReader, findings: Findings, folder: Path) -> int:
    """Writes one picture of each edge whose nodes have thumbnails; returns their number."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be created: {error.strerror}") from error
    written = 0
    for number, finding in enumerate((*findings.wrong, *findings.doubtful), start=1):
        sides = [frames.thumbnail(node) for node in (finding.edge.a, finding.edge.b)]
        if sides[0] is None or sides[1] is None:
            continue
        path = (
            folder
            / f"{number:03d}_{finding.why}_{str(finding.edge.a)[:8]}_{str(finding.edge.b)[:8]}.png"
        )
        if not cv2.imwrite(str(path), _picture(frames, finding, sides[0], sides[1])):
            raise InputError(f"{path}: the picture cannot be written; is the disk full?")
        written += 1
    return written


def _picture(
    frames: FrameReader, finding: Finding, a: NDArray[np.uint8], b: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    scale = _HEIGHT_PX / b.shape[0]
    enlarged = cv2.resize(b, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    size = (enlarged.shape[1], enlarged.shape[0])
    pixels_a, pixels_b = _inliers(frames, finding.edge.a, finding.edge.b)
    live_pixels = (pixels_b * size).astype(np.float32)
    picture = match_picture(
        a, enlarged.astype(np.uint8), pixels_a, live_pixels, ("one node", "the other")
    )
    return with_caption(picture, finding.text())


def _inliers(
    frames: FrameReader, a: NodeId, b: NodeId
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(K, 2) each: where the two nodes match, as fractions of their images."""
    nothing = np.zeros((0, 2), np.float32)
    try:
        reference, live = frames.frame(a), as_live(frames.frame(b))
    except MapCorruptError:
        return nothing, nothing
    matcher = feature_kind(live.descriptor).matcher
    match = match_frames(reference, live, matcher, pair_seed(b, a))
    return tuple(  # type: ignore[return-value]
        (frame.landmarks.pixels[rows] / (frame.camera.width, frame.camera.height)).astype(
            np.float32
        )
        for frame, rows in ((reference, match.reference_rows), (live, match.live_rows))
    )


# Edges that the text lists; JSON has all.
_SHOWN = 40


@dataclass(frozen=True, slots=True, eq=False)
class GeometryReport:
    """What ``engram check --geometry`` found, and did.

    Attributes:
        components: number of components without the wrong edges, and with them.
        revision: of the repair; None for a preview.
        moved: what the repair moved in the map frame; None for a preview.
    """

    findings: Findings
    components: tuple[int, int]
    revision: int | None = None
    moved: Moves | None = None
    pictures: int = 0

    def to_dict(self) -> dict[str, Any]:
        """What ``check --geometry --json`` prints."""
        findings = self.findings
        return {
            "wrong": [finding.to_dict() for finding in findings.wrong],
            "doubtful": [finding.to_dict() for finding in findings.doubtful],
            "examined": findings.examined,
            "of_edges": findings.of_edges,
            "components": {"without": self.components[0], "with": self.components[1]},
            "revision": self.revision,
            "moved": None if self.moved is None else self.moved.to_dict(),
            "pictures": self.pictures,
        }

    def text(self) -> str:
        """In words."""
        findings, lines = self.findings, []
        lines += [finding.text() for finding in findings.wrong[:_SHOWN]]
        if len(findings.wrong) > _SHOWN:
            lines.append(f"… and {len(findings.wrong) - _SHOWN} more; --json lists all")
        lines += [f"doubtful: {finding.text()}" for finding in findings.doubtful[:_SHOWN]]
        lines.append(
            f"{len(findings.wrong)} wrong and {len(findings.doubtful)} doubtful of "
            f"{counted(findings.of_edges, 'edge')}, {findings.examined} looked at twice"
        )
        if findings.wrong and self.components[0] != self.components[1]:
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
        placing: how nodes that the wrong edges had misplaced are laid out again.
        author: commits a revision of this author in which the wrong edges no longer count; None
            changes nothing.
        pictures: folder for a picture of both sides of each edge; None for none.
    """
    config = config or RepairConfig()
    with Map.open(path) as store:
        findings = find_wrong_edges(
            store.graph, store.path_memory, store.frames, config, monitor=monitor
        )
        written = 0 if pictures is None else write_pictures(store.frames, findings, pictures)
        components = _components(store, findings)
        if author is None or not findings.wrong:
            return GeometryReport(findings, components, pictures=written)
        revision, moved = remove_edges(store, findings.wrong, config, author, placing)
    return GeometryReport(findings, components, revision, moved, written)


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
            for finding in wrong:
                edge = finding.edge
                writer.add_mark(
                    Removal(edge.a, edge.b, edge.kind, edge.a_from_b, finding.text(), now_ns)
                )
            revision = writer.commit(placing)
        store.forget()
        return revision.number, moves(before, store.placements, goals)


def _components(store: Map, findings: Findings) -> tuple[int, int]:
    graph = store.graph
    kept = np.ones(len(graph.edges), np.bool_)
    kept[[finding.row for finding in findings.wrong]] = False
    every = (part_labels(graph.edge_ends[rows], len(graph)) for rows in (kept, slice(None)))
    without, whole = (len(np.unique(labels)) for labels in every)
    return without, whole
