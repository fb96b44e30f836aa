"""The result of a merge: nodes taken and omitted per segment, and why a run did not localise."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from engram.config import plain
from engram.counts import counted
from engram.graph.model import Session
from engram.maps.map import Map, open_map
from engram.maps.map_frame import Moves
from engram.viewing.drawings import Panel, Track, draw_from_above, save

# Drives listed in the text; JSON has all, segment by segment.
_SHOWN_DRIVES = 12


class Seed(StrEnum):
    """How the replay of a segment got its start position."""

    NEIGHBOUR = "neighbour"
    GAP = "gap"
    PLACE = "place"
    NONE = "none"


class Reason(StrEnum):
    """Why a frame of the replay was taken."""

    UNUSABLE_FRAME = "unusable_frame"
    NOTHING_NEAR = "nothing_near"
    NO_PLACE = "no_place"
    NO_MATCH = "no_match"
    WEAK_MATCH = "weak_match"
    WHOLE_SEGMENT = "whole_segment"


_WORDS = {
    Reason.UNUSABLE_FRAME: "unusable frames",
    Reason.NOTHING_NEAR: "no known node nearby",
    Reason.NO_PLACE: "no similar place in the map",
    Reason.NO_MATCH: "nearby nodes do not match",
    Reason.WEAK_MATCH: "weak matches",
    Reason.WHOLE_SEGMENT: "segments that do not localise as a whole",
}


@dataclass(frozen=True, slots=True)
class RunReport:
    """Consecutive nodes of a segment that were taken.

    Attributes:
        reason: the most frequent reason; of equals the first in `Reason`.
    """

    first_stamp_ns: int
    nodes: int
    length_m: float
    reason: Reason


@dataclass(frozen=True, slots=True)
class KeptNode:
    """The outcome of one node in a replay.

    Attributes:
        moved_m: odometry distance since the node before it.
        reason: why it was taken; None if it was omitted.
    """

    stamp_ns: int
    moved_m: float
    reason: Reason | None


@dataclass(frozen=True, slots=True)
class SegmentReport:
    """The outcome of one segment.

    Attributes:
        seed: how the replay got its start position.
    """

    session: str
    robot: str
    first_stamp_ns: int
    seed: Seed = Seed.NONE
    taken: int = 0
    omitted: int = 0
    runs: Sequence[RunReport] = ()

    @staticmethod
    def of(session: Session, seed: Seed, nodes: Sequence[KeptNode]) -> SegmentReport:
        """Counts the nodes of a segment, in the order of time; one that matches places it."""
        if seed is Seed.NONE and any(node.reason in {None, Reason.WEAK_MATCH} for node in nodes):
            seed = Seed.PLACE
        runs = []
        for _, group in groupby(nodes, key=lambda node: node.reason is None):
            run = list(group)
            reasons = Counter(node.reason for node in run if node.reason is not None)
            if reasons:
                length_m = sum(node.moved_m for node in run[1:])
                reason = max(Reason, key=reasons.__getitem__)
                runs.append(RunReport(run[0].stamp_ns, len(run), length_m, reason))
        taken = sum(run.nodes for run in runs)
        return SegmentReport(
            str(session.id),
            session.robot,
            nodes[0].stamp_ns,
            seed,
            taken,
            len(nodes) - taken,
            runs,
        )


_SEED_WORDS = {
    Seed.GAP: "found behind a gap",
    Seed.PLACE: "found by place recognition",
    Seed.NONE: "not found",
}


def _drive_text(segments: Sequence[SegmentReport]) -> str:
    """One line for all segments of a drive: lost odometry can leave hundreds of single nodes."""
    first = segments[0]
    taken, omitted = (
        sum(segment.taken for segment in segments),
        sum(segment.omitted for segment in segments),
    )
    line = f"  {first.robot} {first.session[:8]}: {taken} added, {omitted} already covered"
    if len(segments) > 1:
        line += f", in {len(segments)} segments"
    seeds = Counter(segment.seed for segment in segments)
    for seed, words in _SEED_WORDS.items():
        if seeds[seed]:
            line += f", {words}" if len(segments) == 1 else f", {seeds[seed]} {words}"
    reasons = Counter[Reason]()
    for segment in segments:
        for run in segment.runs:
            reasons[run.reason] += run.nodes
    parts = [f"{_WORDS[reason]} ({count})" for reason, count in reasons.most_common()]
    return f"{line}: {'; '.join(parts)}" if parts else line


@dataclass(frozen=True, slots=True)
class HeldOutFigures:
    """How held-out drives localise in a map.

    Attributes:
        route_not_localised: share of their route without a match.
        longest_gap_m: longest stretch without a match, metres.
        estimator: key of `engram.measures.FORMULAS`, what P is taken over.
        p_no_match: P(no match within x metres), by x.
    """

    route_not_localised: float
    longest_gap_m: float
    estimator: str
    p_no_match: Mapping[int, float]


@dataclass(frozen=True, slots=True)
class HeldOutReport:
    """The figures of a gate for a merge that it accepted."""

    drives: Sequence[str]
    before: HeldOutFigures
    after: HeldOutFigures

    def text(self) -> str:
        """The report as one line of text."""
        was, now = self.before, self.after
        curve = ", ".join(
            f"P(no match within {within_m} m, {now.estimator}) {was.p_no_match[within_m]:.2%} → "
            f"{p:.2%}"
            for within_m, p in now.p_no_match.items()
        )
        return (
            f"held out {', '.join(self.drives)}: route not localised "
            f"{was.route_not_localised:.2%} → {now.route_not_localised:.2%}, longest gap "
            f"{was.longest_gap_m:.1f} → {now.longest_gap_m:.1f} m, {curve}"
        )


@dataclass(slots=True)
class MergeReport:
    """The result of merging one robot's map.

    Attributes:
        robots: names of the robots whose drives it holds.
        revision: number of the new revision; None if nothing changed, and in a dry run.
        changed: whether the fleet map changed, or in a dry run would have.
        dry_run: whether the fleet map was left unchanged on purpose.
        interrupted: whether it was stopped; the fleet map is then unchanged by it.
        content_hash: of the fleet map afterwards; in a dry run, of the map that would result.
        known, known_omissions: nodes that the fleet map had, or had omitted before.
        forgotten: nodes left out, since the fleet map has forgotten them or their drives.
        attempts: number of remembered attempts new to the fleet map.
        match_attempts: match attempts of the replay: the cost of the merge.
        proposed_attempts: those at nodes proposed by place recognition; each costs a quarter.
        lookups: frames of the replay for which the relocaliser ran.
        components: connected components of the fleet map afterwards.
        moved: what moved in the map frame; None if the map is unchanged.
        wrong_edges: wrong edges of the result; None if they were not looked for.
        segments: one report each, in the order of replay.
    """

    source: str
    source_hash: str
    robots: Sequence[str]
    revision: int | None = None
    changed: bool = False
    dry_run: bool = False
    interrupted: bool = False
    content_hash: str = ""
    sessions: int = 0
    known: int = 0
    known_omissions: int = 0
    forgotten: int = 0
    taken: int = 0
    omitted: int = 0
    edges: int = 0
    path_entries: int = 0
    attempts: int = 0
    match_attempts: int = 0
    proposed_attempts: int = 0
    lookups: int = 0
    seconds: float = 0.0
    components: int = 0
    held_out: HeldOutReport | None = None
    moved: Moves | None = None
    wrong_edges: list[dict[str, Any]] | None = None
    segments: list[SegmentReport] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @staticmethod
    def of(robot: Map) -> MergeReport:
        """An empty report for a map."""
        robots = sorted({session.robot for session in robot.sessions.values()})
        return MergeReport(robot.location, robot.content_hash(), robots)

    def to_dict(self) -> dict[str, Any]:
        """What ``merge --json`` prints for this map."""
        moved = None if self.moved is None else self.moved.to_dict()
        return {**plain(self), "moved": moved}

    def text(self) -> str:
        """The report as text."""
        lines = [f"{self.source} ({', '.join(self.robots) or 'no drives'}): {self._outcome()}"]
        if self.changed and not self.interrupted:
            lines.append(
                f"  {counted(self.taken, 'node')} added, {self.omitted} already covered; from "
                f"earlier merges {self.known} known, {self.known_omissions} covered; "
                f"{counted(self.sessions, 'new session')}, "
                f"{counted(self.path_entries, 'path entry')}, "
                f"{counted(self.attempts, 'attempt')} carried over"
            )
            drives = self._drives()
            lines += [_drive_text(drive) for drive in drives[:_SHOWN_DRIVES]]
            if len(drives) > _SHOWN_DRIVES:
                lines.append(f"  … and {counted(len(drives) - _SHOWN_DRIVES, 'more drive')}")
        if self.forgotten:
            lines.append(
                f"  left out, as forgotten by the fleet: {counted(self.forgotten, 'node')}"
            )
        if self.held_out is not None:
            lines.append(f"  {self.held_out.text()}")
        if self.wrong_edges is not None:
            wrong = counted(len(self.wrong_edges), "wrong edge")
            lines.append(f"  {wrong}; engram check --geometry lists what is wrong")
        if self.moved:
            lines += [f"  {line}" for line in self.moved.text().splitlines()]
        lines += [f"  note: {note}" for note in self.notes]
        return "\n".join(lines)

    def _drives(self) -> list[list[SegmentReport]]:
        drives: dict[str, list[SegmentReport]] = {}
        for segment in self.segments:
            drives.setdefault(segment.session, []).append(segment)
        return list(drives.values())

    def _outcome(self) -> str:
        if self.interrupted:
            return "interrupted: the fleet map is unchanged; run the same command again"
        if not self.changed:
            return "nothing new"
        made = "dry run" if self.dry_run else f"revision {self.revision}"
        return f"{made}, content {self.content_hash}, {counted(self.components, 'component')}"


def picture_before_and_after(centre: Path, before: int, path: Path) -> None:
    """Draws the nodes of the fleet map by robot, as of a revision and now."""
    panels = []
    for at in (before, None):
        with open_map(centre, at) as opened:
            words = f"{counted(len(opened.graph), 'node')}, revision {opened.revision}"
            title = f"{'before' if at is not None else 'after'}: {words}"
            panels.append(Panel(title, _tracks(opened)))
    save(draw_from_above(panels), path)


def _tracks(opened: Map) -> list[Track]:
    places_m = opened.layout().positions[:, :2]
    robots = np.array([opened.sessions[node.session].robot for node in opened.graph.nodes], object)
    return [
        Track(f"{robot} ({int((robots == robot).sum())})", places_m[robots == robot])
        for robot in sorted(set(robots.tolist()))
    ]
