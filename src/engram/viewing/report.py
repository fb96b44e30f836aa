"""Reports: a localised drive, a map or a drive as one page that people read first."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from uuid import UUID

import numpy as np

from engram import __version__
from engram.counts import counted
from engram.doctor.table import Diagnosis, Finding, Severity, measure_text
from engram.errors import EngramError
from engram.frontend.frame import StereoPair
from engram.graph.model import NodeId
from engram.localiser.localisation import Localisation, LocalisationStatus
from engram.maps.map import Map
from engram.robot.inspecting import describe_map, list_sessions
from engram.robot.results import DriveResult, DriveSummary
from engram.robot.robot import LastFrame
from engram.viewing.drawings import (
    BY_ODOMETRY,
    NOWHERE,
    UNMEASURED,
    Course,
    MapParts,
    as_svg,
    draw_course,
    draw_parts,
    draw_strip,
    parts_of,
)
from engram.viewing.matches import MatchShower, ShownMatch
from engram.viewing.moments import drive_text
from engram.viewing.page import (
    Page,
    as_jpeg,
    commands,
    drawing,
    figures,
    heading,
    paragraph,
    photograph,
    table,
)
from engram.viewing.pictures import side_picture
from engram.viewing.weakness import HEAD, advice_text, draw_weakness, spot_rows, verdict
from engram.weak_spots import WeakSpots, WeakSpotsConfig, find_weak_spots

_LOCALISED = (
    "Localised: the frame matched a node, a saved frame of the map, and the camera's pose in it is "
    "known. By odometry alone: carried on from the last match. Lost: too far from it, so places "
    "that look alike are tried all over the map. Confidence: the higher, the surer."
)
_EXAMINED = (
    "engram doctor checks the camera, its calibration, the time stamps and odometry, and nothing "
    "else."
)
# Pictures of each kind, and the distance between the frames that they show, metres.
_PICTURES, _APART_M = 3, 8.0
# Revisions and drives that a page lists.
_LISTED = 40
_NO_STATUS = {LocalisationStatus.LOST, LocalisationStatus.DEAD_RECKONING}
# What a drawing calls frames that no node matched.
_UNMATCHED = {
    LocalisationStatus.DEAD_RECKONING: BY_ODOMETRY,
    LocalisationStatus.LOST: NOWHERE,
    LocalisationStatus.NO_ODOMETRY: UNMEASURED,
}


@dataclass(frozen=True, slots=True)
class _Kept:
    """A match worth showing, and how much so."""

    score: float
    shown: ShownMatch


@dataclass(slots=True)
class _Shelf:
    """The few matches of the highest scores that lie apart from each other."""

    kept: list[_Kept] = field(default_factory=list)

    def has_room(self, score: float, at_m: float) -> bool:
        """Whether a match of this score would be kept."""
        near = [one.score for one in self.kept if abs(one.shown.at_m - at_m) < _APART_M]
        if near:
            return score > max(near)
        return len(self.kept) < _PICTURES or score > min(one.score for one in self.kept)

    def put(self, score: float, shown: ShownMatch) -> None:
        """Keeps a match, in place of those near it and beyond the last."""
        apart = [one for one in self.kept if abs(one.shown.at_m - shown.at_m) >= _APART_M]
        apart.append(_Kept(score, shown))
        self.kept = sorted(apart, key=lambda one: -one.score)[:_PICTURES]


class Showcase:
    """The best, the weakest and the failed matches of a drive, chosen while it is driven."""

    def __init__(self, shower: MatchShower) -> None:
        self._shower = shower
        self.best, self.weakest, self.failed = _Shelf(), _Shelf(), _Shelf()

    def see(self, seen: LastFrame, found: Localisation, frame: int, at_m: float) -> None:
        """Keeps the frame just localised, if it is one of those."""
        ranked: list[tuple[_Shelf, float]] = []
        if found.localised:
            ranked = [(self.best, float(found.inliers)), (self.weakest, -found.confidence)]
        elif found.status in _NO_STATUS and found.attempts:
            ranked = [(self.failed, found.open_loop_m)]
        wanted = [(shelf, score) for shelf, score in ranked if shelf.has_room(score, at_m)]
        shown = self._shower.show(seen, found, frame, at_m) if wanted else None
        if shown is not None:
            for shelf, score in wanted:
                shelf.put(score, shown)

    def stamps_ns(self) -> set[int]:
        """Of all images that `section` shows, ns."""
        shelves = self.best, self.weakest, self.failed
        return {one for shelf in shelves for kept in shelf.kept for one in kept.shown.stamps_ns}

    def section(self) -> list[str]:
        """The part of a page that shows them, while the map is open."""
        parts = [heading("Matches")]
        shelves = (
            ("Best: most inliers", self.best),
            ("Weakest: accepted with the least confidence", self.weakest),
            ("Refused: farthest from a match, each with its best attempt", self.failed),
        )
        listed = set[int]()
        for title, shelf in shelves:
            kept = [one for one in shelf.kept if one.shown.frame not in listed]
            listed |= {one.shown.frame for one in kept}
            if kept:
                parts.append(heading(title, 3))
            for one in sorted(kept, key=lambda one: one.shown.frame):
                place = f"frame {one.shown.frame}, {one.shown.at_m:.0f} m into the drive"
                details = f"{place}; {one.shown.details}"
                parts.append(photograph(as_jpeg(one.shown.draw()), one.shown.caption, details))
        if len(parts) == 1:
            parts.append(paragraph("No picture: the frames have no images, or none was attempted."))
        else:
            points = (
                "Points of one colour are one landmark in both, an inlier: it agrees with the "
                "pose. Lines join a few of them. Ahead, behind, right, left: where the robot is, "
                f"seen from the node. Of frames within {_APART_M:.0f} m only one is shown."
            )
            parts.insert(1, paragraph(points, "muted"))
        return parts


def drive_page(
    result: DriveResult, opened: Map | None, showcase: Showcase | None, next_commands: Sequence[str]
) -> Page:
    """The page of a localised drive.

    Args:
        result: what `engram localise --json` prints.
        opened: its map; None if it is not at hand.
        showcase: its matches; None without.
        next_commands: what reproduces it and leads on.
    """
    summary, course = result.summary, course_of(result, opened)
    sections = [figures(_drive_figures(summary))]
    about = (
        "Where the drive was localised over its distance: "
        f"{summary.share_localised:.0%} of the frames, longest stretch between matches "
        f"{summary.longest_gap_m:.1f} m"
    )
    parts = None if opened is None else parts_of(opened, title=Path(opened.location).name)
    strip = draw_strip(course, {} if parts is None else parts.colours)
    sections += [heading("The drive"), drawing(as_svg(strip, about), _LOCALISED)]
    if opened is not None and parts is not None:
        sections += _map_sections(opened, parts, course)
    if showcase is not None:
        sections += showcase.section()
    alarms = [one for one in summary.findings if one.severity is not Severity.NOTE]
    sections += finding_section(alarms)
    sections += [heading("Commands"), commands(next_commands)]
    return Page(
        f"{result.drive or 'A drive'} in {result.map or 'a map'}", _verdict(summary), sections
    )


def course_of(result: DriveResult, opened: Map | None) -> Course:
    """What the robot made of the drive's frames, with names from the map."""
    names = [_UNMATCHED.get(one.status) or _drive_of(one.node, opened) for one in result.frames]
    poses = [one.pose() for one in result.frames]
    nowhere = np.full(2, np.nan)
    return Course(
        result.driven_m(),
        names,
        np.array([np.nan if one.confidence is None else one.confidence for one in result.frames]),
        np.array([one.status is LocalisationStatus.LOCALISED for one in result.frames], bool),
        np.array([nowhere if pose is None else pose.translation[:2] for pose in poses]).reshape(
            -1, 2
        ),
    )


def _drive_of(node: str | None, opened: Map | None) -> str:
    if opened is not None and node is not None:
        try:
            known = NodeId(UUID(node))
        except ValueError:
            return "localised"
        if known in opened.graph:
            return drive_text(opened.sessions[opened.graph.node(opened.graph.index(known)).session])
    return "localised"


def _verdict(summary: DriveSummary) -> str:
    statuses = summary.statuses
    fates = [f"{statuses.get(status, 0)} {name}" for status, name in _UNMATCHED.items()]
    words = (
        f"{statuses.get('localised', 0)} of {counted(summary.frames, 'frame')} localised "
        f"({summary.share_localised:.1%}) over {summary.driven_m:.0f} m, {', '.join(fates)}; "
        f"longest stretch between matches {summary.longest_gap_m:.1f} m."
    )
    return words if summary.trusted else f"{words} The drive has a fatal fault: do not trust this."


def _drive_figures(summary: DriveSummary) -> list[tuple[str, str]]:
    total = summary.stages_ms.get("total", {})
    return [
        ("localised", f"{summary.share_localised:.1%}"),
        ("driven", f"{summary.driven_m:.0f} m"),
        ("longest between matches", f"{summary.longest_gap_m:.1f} m"),
        ("route > 10 m from a match", f"{summary.p_no_match_10m:.1%}"),
        ("attempts per frame", f"{summary.attempts_per_frame:.2f}"),
        *(
            (f"frames {name}", f"{summary.statuses.get(status, 0)}")
            for status, name in _UNMATCHED.items()
        ),
        ("unusable frames", f"{summary.unusable_frames}"),
        ("matches withdrawn later", f"{summary.withdrawn}"),
        ("ms a frame, median", f"{total.get('median', 0.0):.1f}"),
        ("ms a frame, 99 % below", f"{total.get('p99', 0.0):.1f}"),
    ]


def _map_sections(opened: Map, parts: MapParts, course: Course) -> list[str]:
    about = f"The map from above, {counted(parts.nodes, 'node')}, and where the drive was localised"
    shown = drawing(
        as_svg(draw_course(parts, course), about),
        parts.caption(
            "As the map estimates it. Points: the drive, where it is localised at the matched "
            "nodes, else by odometry. Lines: the map's drives"
        ),
    )
    served = Counter(course.names)
    rows = [
        (drive_text(session), opened.session_sizes()[session.id][0], served[drive_text(session)])
        for session in opened.sessions.values()
    ]
    rows.sort(key=lambda row: -row[2])
    caption = f"Drives of the map, and the frames that matched their nodes{_more(len(rows))}"
    head = ("drive", "nodes", "frames matched")
    return [heading("The map"), shown, table(head, rows[:_LISTED], caption)]


def _more(rows: int) -> str:
    return f" (the first {_LISTED} of {rows})" if rows > _LISTED else ""


def finding_section(findings: Sequence[Finding]) -> list[str]:
    """What the doctor found."""
    rows = [
        (
            one.severity,
            one.code,
            f"{one.message} ({measure_text(one.value, one.limit, one.unit)})",
            one.cure,
        )
        for one in findings
    ]
    parts = [heading("The doctor"), paragraph(_EXAMINED, "muted")]
    if not rows:
        return [*parts, paragraph("It found nothing wrong.")]
    return [*parts, table(("severity", "finding", "what", "cure"), rows, "Findings, worst first")]


def map_page(path: Path, next_commands: Sequence[str], weak: WeakSpotsConfig | None = None) -> Page:
    """The page of a map.

    Args:
        weak: how its weak spots are found; None for the defaults.
    """
    facts, sessions = describe_map(path), list_sessions(path)
    with Map.open(path) as opened:
        parts = parts_of(opened, title=f"{path.name}, revision {opened.revision}")
        history = [
            (one.number, f"{datetime.fromtimestamp(one.committed_ns / 1e9, UTC):%Y-%m-%d %H:%M}",
             one.author, one.message)
            for one in reversed(opened.log()[-_LISTED:])
        ]  # fmt: skip
        named = {str(one.id): drive_text(one) for one in opened.sessions.values()}
        weakness = _weak_section(find_weak_spots(opened, weak), opened)
    about = f"{path.name} from above: {counted(parts.nodes, 'node')} by drive"
    rows = [
        (named[one["session"]], one["nodes"], one["path_entries"], one["session"][:8])
        for one in sessions
    ]
    verdict = (
        f"{counted(facts['nodes'], 'node')} of {counted(facts['sessions'], 'drive')} by "
        f"{counted(len(facts['robots']), 'robot')}, {facts['mapped_m']:.0f} m mapped; "
    )
    verdict += _parts_verdict(parts.above.pieces())
    tiles = [
        ("nodes", f"{facts['nodes']}"),
        ("experiences", f"{facts['experiences']}"),
        ("mapped", f"{facts['mapped_m']:.0f} m"),
        ("parts", f"{facts['components']}"),
        ("match attempts", f"{facts['attempts']}"),
        ("size", f"{facts['size_bytes'] / 1e6:.1f} MB"),
        ("features", str(facts["descriptor"])),
        ("revision", f"{facts['revision']}"),
    ]
    head = ("drive", "nodes", "path entries", "session")
    sections = [
        figures(tiles),
        heading("From above"),
        drawing(as_svg(draw_parts(parts.panels), about), parts.caption("Colours: drives")),
        *weakness,
        heading("Drives"),
        table(head, rows[:_LISTED], f"Drives in order of arrival{_more(len(rows))}"),
        heading("History"),
        table(("revision", "UTC", "by", "reason"), history, "Newest revisions first"),
        heading("Commands"),
        commands(next_commands),
    ]
    return Page(path.name, verdict, sections)


def _parts_verdict(pieces: Sequence[int]) -> str:
    """What holds a map together, by the unconnected pieces of each of its parts."""
    if list(pieces) == [1]:
        return "one connected part."
    held = [f"anchors hold {count} unconnected pieces together" for count in pieces if count > 1]
    if len(pieces) != 1:
        parts = counted(len(pieces), "part")
        held.append(f"{parts} whose places relative to each other are unknown")
    return f"{'; '.join(held)}."


def _weak_section(found: WeakSpots, opened: Map) -> list[str]:
    """Where the next drives will hardly be localised; nothing of an empty map."""
    if found.advice is None:
        return []
    about = f"{Path(opened.location).name} from above, by the share that drives will probably miss"
    rows = spot_rows(found, opened)
    caption = f"Weak spots, the weakest first{_more(len(rows))}"
    table_of_spots = [table(HEAD, rows[:_LISTED], caption)] if rows else []
    drawn = drawing(as_svg(draw_weakness(found, opened), about), f"{verdict(found)}.")
    advice = paragraph(f"{advice_text(found.advice, opened)}.")
    return [heading("Weak spots"), drawn, advice, *table_of_spots]


def examined_page(
    name: str, diagnosis: Diagnosis, pairs: Sequence[StereoPair], next_commands: Sequence[str]
) -> Page:
    """The page of a drive that the doctor examined, with a few of its pairs."""
    fatal = len(diagnosis.fatal)
    alarms = [one for one in diagnosis.findings if one.severity is not Severity.NOTE]
    verdict = f"{counted(diagnosis.frames, 'frame')} examined: " + (
        f"{counted(len(alarms), 'finding')}, {fatal} fatal." if alarms else "nothing wrong."
    )
    sections = finding_section(diagnosis.findings)
    if diagnosis.untold:
        rows = list(diagnosis.untold.items())
        sections.append(table(("not checked", "what it would need"), rows, "Checks not made"))
    if pairs:
        sections += [heading("Stereo pairs")]
    for number, pair in enumerate(pairs, start=1):
        caption = f"Pair {number} of {len(pairs)}: left image above, right image below"
        details = "Lines join what both sides show: upright and green where sound, red where not."
        sections.append(photograph(as_jpeg(side_picture(pair)), caption, details))
    sections += [heading("Commands"), commands(next_commands)]
    return Page(name, verdict, sections)


def made_by() -> str:
    """The last line of a page."""
    return f"Made by Engram {__version__}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC."


def typed(*words: object) -> str:
    """A command as one types it."""
    return shlex.join(str(word) for word in words)


def map_at_hand(path: str) -> Map | None:
    """The map of a result, open; None if it is not where the result says."""
    try:
        return Map.open(Path(path)) if path else None
    except EngramError:
        return None
