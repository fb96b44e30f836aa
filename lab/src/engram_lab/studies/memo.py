"""Matches of one live session that were made once and are used by every policy (method §8).

`match(live, node)` is a pure function of two frames and the matcher's configuration, so that its
results may be kept: unguided, by (live UUID, node UUID, matcher hash). Whether a match is accepted
depends on each policy's own prediction and is judged afresh.
"""

from __future__ import annotations

import os
from pathlib import Path
from time import thread_time
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from engram.frontend import Frame
from engram.frontend.matching import Match, matcher_hash
from engram.geometry import SE3
from engram.graph.model import NodeId
from engram.localiser import FrameMatcher, Matcher, Prediction, Spread
from engram.maps import Map
from engram.robot import Settings
from engram_lab.studies.drives import EvaluatedDrive
from engram_lab.studies.store import UNREADABLE

_VERSION = 1
_NO_ROWS = np.empty(0, dtype=np.int32)
_NO_MATCH = Match(None, None, 0, _NO_ROWS, _NO_ROWS)


class MatchMemo:
    """A `Matcher` that asks another one only for what it does not contain.

    What it gives back has no rows of landmarks: nobody behind the matcher looks at them.

    Args:
        matcher: makes the matches that are not known.
        path: where they are kept, NAME.npz; an unreadable file or one of another matcher counts
            as empty, since all it holds can be made again.
        matcher_hash: of the matcher's settings and version.
    """

    def __init__(self, matcher: Matcher, path: Path, matcher_hash: str) -> None:
        self._matcher = matcher
        self._path = path
        self._hash = matcher_hash
        self._frames: dict[int, dict[NodeId, Match]] = {}
        self._spreads: dict[tuple[int, NodeId], Spread] = {}
        self.made = 0
        self.seconds = 0.0
        self._read()

    @staticmethod
    def of(opened: Map, drive: EvaluatedDrive, settings: Settings, folder: Path) -> MatchMemo:
        """The memo that is kept in a folder of one drive in maps of the same nodes."""
        config = settings.localiser.matcher
        path = folder / f"memo-{drive.key}.matches.npz"
        return MatchMemo(FrameMatcher(opened.frames, config), path, matcher_hash(config))

    @property
    def known(self) -> int:
        """Pairs of frame and node whose result is stored, found or not."""
        return sum(len(matches) for matches in self._frames.values())

    def match(self, live: Frame, live_id: NodeId, node: NodeId, guide: Prediction | None) -> Match:
        """See `Matcher`; a guided match depends on its prediction and is not kept."""
        if guide is not None:
            return self._matcher.match(live, live_id, node, guide)
        known = self._frames.get(live.stamp_ns)
        if known is None:
            known = self._frames[live.stamp_ns] = {}
        match = known.get(node)
        if match is None:
            match = known[node] = self._make(live, live_id, node)
        return match

    def spread(self, live: Frame, live_id: NodeId, node: NodeId, match: Match) -> Spread:
        """See `Matcher`."""
        if match.reference_from_live is None:
            return Spread(0.0, 0.0, 0.0)
        key = (live.stamp_ns, node)
        if key not in self._spreads:
            started = thread_time()
            whole = self._matcher.match(live, live_id, node, None)
            self._spreads[key] = self._matcher.spread(live, live_id, node, whole)
            self.seconds += thread_time() - started
        return self._spreads[key]

    def prefetch(self, nodes: list[NodeId]) -> None:
        """See `Matcher`; most of them are stored."""

    def _make(self, live: Frame, live_id: NodeId, node: NodeId) -> Match:
        started = thread_time()
        match = self._matcher.match(live, live_id, node, None)
        self.made += 1
        self.seconds += thread_time() - started
        if match.reference_from_live is None:
            return _NO_MATCH
        return Match(match.reference_from_live, match.covariance, match.inliers, _NO_ROWS, _NO_ROWS)

    def save(self) -> None:
        """Writes all results, in one step: a killed run leaves the file as it was."""
        nodes = sorted({node for known in self._frames.values() for node in known})
        number = {node: k for k, node in enumerate(nodes)}
        rows = [
            (stamp_ns, number[node], match)
            for stamp_ns, known in self._frames.items()
            for node, match in known.items()
        ]
        posed = [match for _, _, match in rows if match.reference_from_live is not None]
        draft = self._path.with_name(f".{self._path.name}.{os.getpid()}.npz")
        np.savez(
            draft,
            kind=np.array([_VERSION]),
            matcher=np.array([self._hash]),
            nodes=np.frombuffer(b"".join(node.bytes for node in nodes), np.uint8).reshape(-1, 16),
            stamp_ns=np.array([row[0] for row in rows], np.int64),
            node=np.array([row[1] for row in rows], np.int32),
            inliers=np.array([row[2].inliers for row in rows], np.int32),
            pose=np.array([_pose_row(match) for match in posed], np.float64).reshape(-1, 12),
            covariance=np.array([match.covariance for match in posed]).reshape(-1, 6, 6),
        )
        draft.replace(self._path)

    def _read(self) -> None:
        if not self._path.exists():
            return
        try:
            with np.load(self._path) as kept:
                if int(kept["kind"][0]) == _VERSION and str(kept["matcher"][0]) == self._hash:
                    self._fill({name: kept[name] for name in kept.files})
        except UNREADABLE:
            self._frames = {}

    def _fill(self, kept: dict[str, NDArray[Any]]) -> None:
        nodes = [NodeId(UUID(bytes=row.tobytes())) for row in kept["nodes"]]
        poses, covariances, used = kept["pose"], kept["covariance"], 0
        rows = zip(
            kept["stamp_ns"].tolist(), kept["node"].tolist(), kept["inliers"].tolist(), strict=True
        )
        for stamp_ns, node, inliers in rows:
            match = _NO_MATCH
            if inliers > 0:
                pose = poses[used]
                transform = SE3(pose[:9].reshape(3, 3), pose[9:])
                match = Match(transform, covariances[used], inliers, _NO_ROWS, _NO_ROWS)
                used += 1
            self._frames.setdefault(stamp_ns, {})[nodes[node]] = match


def _pose_row(match: Match) -> NDArray[np.float64]:
    assert match.reference_from_live is not None
    pose = match.reference_from_live
    return np.concatenate([pose.rotation.ravel(), pose.translation])
