"""Two robots map a hamlet and hand in; another drive and a third robot use what they share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from engram.counts import counted
from engram.errors import InputError
from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.merge.merging import merge
from engram.geometry.se3 import SE3
from engram.localiser.localisation import Localisation
from engram.maps.map import open_map
from engram.monitor import QUIET, Monitor
from engram.robot.localisers import session_of_drive
from engram.robot.mapping import MapReport, map_drive
from engram.robot.results import DriveResult, ResultRecords
from engram.robot.robot import DisplayPose
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_on, summarise
from engram.sequences.opening import open_drive
from engram.viewing.matches import MatchShower, shows
from engram.viewing.page import Page, as_jpeg, commands, heading, paragraph, photograph, table
from engram.viewing.pictures import Image
from engram.viewing.report import Showcase, drive_page, made_by, typed
from engram_lab.accuracy import is_false
from engram_lab.town.camera_model import CLEAN
from engram_lab.town.campaigns import Campaign, campaign_named
from engram_lab.town.session import SimulatedDrive
from engram_lab.town.simulating import simulate

# The drives that are mapped, and the later ones: the last robot has never been here.
_MAPPED, _NIGHT, _NEWCOMER = (0, 1, 2, 3), 4, 5
# What people call the maps in which the later drives are localised.
_OWN, _FLEET, _SENT = "its own map", "the fleet's map", "its download"
# The policies are compared at night, which is harder, in the fleet's map: with the attempts that
# run at once, and with as many again.
_POLICIES, _ROUNDS = ("recall", "distance"), (1, 2)
# The scout's mission on Thursday morning, and the share of the fleet's map that it downloads.
_DEPARTS_H, _SHARE_PERCENT = 9.0, 30.0
# Between frames, half as many as the hamlet has: rendering is most of what the demo costs.
_SPACING_M = 1.4
# The route begins in mid-bend, where no earlier motion tells odometry of the turn.
_BEGINS_M = 4.0
# The place that is shown in every condition, as a share of the drive.
_SHOWN_AT = 0.35
INTRODUCTION = (
    "wildcat, courier and scout are simulated robots in a hamlet, each with its own stereo "
    "cameras. They are given no position: they find it by appearance and carry it on by odometry. "
    "wildcat and courier map their drives, and the fleet's map is merged from their maps. Then "
    "courier, which mapped one afternoon, drives at night, and scout, here for the first time, by "
    "day. The fleet's map has a night already: wildcat's of Tuesday."
)
MEANING = (
    "Localised: the frame matched a node, a frame kept in the map, well enough to measure its pose "
    "from there. gap: the longest distance between two matches. inliers: landmarks that agree with "
    "that pose, their median; error: of its position relative to the node, by the simulator's "
    "truth, its median. false: a match more than 1 m or 5° off. Frames are 1.4 m apart to save "
    "time: engram doctor warns of so few a second."
)
LIMITS = (
    "This is a simulation. On real images: KITTI 06, its first 5 s, every other frame mapped and "
    "the rest localised (an easy test): 100 %, median error 1.05 cm; EuRoC V1_01, 85 revisits of a "
    "room: 97.6 % within 0.25 m. Rain, snow and what fails: docs/evidence.md."
)
_LANDMARKS_ONLY = (
    "ms a frame: on this machine, from the log's landmarks. From images: README.md, What a robot "
    "needs."
)
OWN_DRIVES = (
    "Your own drives, ROS bags or folders of stereo images (docs/data.md; on a robot: "
    "docs/live.md, docs/ros.md; a fleet: docs/fleet-tutorial.md):"
)
OWN_COMMANDS = (
    "engram doctor DRIVE",
    "engram map town.engram DRIVE",
    "engram localise town.engram ANOTHER_DRIVE --report page.html",
)


def demo_campaign() -> Campaign:
    """The hamlet's drives, sparser and from behind its first bend.

    A second night takes the place of the rain, and scout drives last.
    """
    hamlet = campaign_named("hamlet")
    first_night = hamlet.sessions[3]
    later = first_night.start + timedelta(days=1, minutes=15)
    second = replace(hamlet.sessions[4], start=later, weather=first_night.weather, lens=CLEAN)
    last = replace(hamlet.sessions[5], robot="scout")
    sessions = (*hamlet.sessions[:4], second, last)
    return replace(
        hamlet,
        name="demo",
        home="demo",
        sessions=tuple(replace(one, night_in_name=True) for one in sessions),
        spacing_m=_SPACING_M,
        begins_m=_BEGINS_M,
        town_in_names=False,
    )


@dataclass(frozen=True, slots=True)
class Judged:
    """The matches of a drive, against the simulator's truth.

    Attributes:
        error_m: of each match, between the true and the measured position in the matched node.
        false: those more than 1 m or 5° off.
    """

    error_m: tuple[float, ...]
    false: int

    @staticmethod
    def of(results: Iterable[Localisation], world_from_cam: Mapping[int, SE3]) -> Judged:
        """Judges the results of a drive by the true poses of all drives' frames, by stamp."""
        errors = []
        for one in results:
            if one.node_stamp_ns is not None and one.node_from_live is not None:
                node = world_from_cam[one.node_stamp_ns]
                off = one.node_from_live.inverse() @ node.inverse() @ world_from_cam[one.stamp_ns]
                errors.append((off.distance_m, off.angle_rad))
        return Judged(
            tuple(error_m for error_m, _ in errors), sum(is_false(*one) for one in errors)
        )

    def __add__(self, other: Judged) -> Judged:
        return Judged(self.error_m + other.error_m, self.false + other.false)

    @property
    def median_cm(self) -> str:
        """The median error in words, centimetres."""
        return f"{100 * float(np.median(self.error_m)):.1f}" if self.error_m else "–"

    def text(self) -> str:
        """For people."""
        return (
            f"median error {self.median_cm} cm, {self.false} of {len(self.error_m)} matches false"
        )


@dataclass(frozen=True, slots=True)
class MappedDrive:
    """A drive that a robot mapped.

    Attributes:
        drive: its time, weather and robot.
        new: nodes saved where nothing matched.
        weak: nodes saved where few landmarks matched, of localised frames.
        why: a sentence on what surprises; "" if nothing does.
        frames: of the drive.
    """

    drive: str
    localised: float
    new: int
    weak: int
    why: str
    frames: int
    judged: Judged

    @staticmethod
    def of(drive: str, mapped: MapReport, judged: Judged, *, first: bool) -> MappedDrive:
        """What a drive added; `first` if its robot's map was empty."""
        frames = len(mapped.results)
        saved = [one for one in mapped.results if one.saved is not None]
        weak = sum(one.localised for one in saved)
        share = sum(one.localised for one in mapped.results) / max(frames, 1)
        why = _why(share, len(saved), weak, first=first)
        skipped = sum(one.saved is None and not one.localised for one in mapped.results)
        if skipped:
            why += f"; {skipped} skipped"
        return MappedDrive(drive, share, len(saved) - weak, weak, why, frames, judged)

    def row(self) -> tuple[str, ...]:
        """What people read of it."""
        localised = f"{self.localised * self.frames:.0f} of {self.frames}"
        return self.drive, localised, str(self.weak), str(self.new), self.why


def _why(share: float, saved: int, weak: int, *, first: bool) -> str:
    if first:
        return "map was empty"
    if not saved:
        return "nothing new"
    if weak > saved / 2:
        return "recognised, but weakly"
    if share < 0.7:
        return "much of it unlike before"
    return "most of it known"


@dataclass(frozen=True, slots=True)
class LaterDrive:
    """A later drive, localised in a map.

    Attributes:
        attempts: the most for a frame.
        inliers, node_m: of its matches, medians: landmarks, and distance from robot to node, m.
        matched: number of matches with each mapped drive that has any.
    """

    drive: str
    map: str
    policy: str
    attempts: int
    summary: dict[str, Any]
    judged: Judged
    inliers: float
    node_m: float
    matched: dict[str, int]

    def figures(self, *, node: bool = False) -> tuple[str, ...]:
        """What people read of it; `node`: with the distance of the nodes."""
        return (
            f"{self.summary['share_localised']:.0%}",
            f"{self.summary['longest_gap_m']:.1f}",
            f"{self.inliers:.0f}",
            *([f"{self.node_m:.1f}"] if node else []),
            self.judged.median_cm,
        )


def _median(values: Iterable[float]) -> float:
    every = list(values)
    return float(np.median(every)) if every else 0.0


@dataclass(frozen=True, slots=True)
class DemoTable:
    """A table of the demo, as text."""

    title: str
    about: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


@dataclass(slots=True)
class DemoReport:
    """What the demo did.

    Attributes:
        page: the report, an HTML page.
        taken, covered: of each robot, nodes that the fleet's map took, and that it had already.
        downloaded: share of the fleet's map in bytes.
        downloaded_bytes, of_bytes: the same, and the whole.
        sent: of each drive, nodes that were downloaded, and all in the fleet's map.
    """

    out: Path
    page: Path
    mapped: list[MappedDrive] = field(default_factory=list)
    taken: dict[str, int] = field(default_factory=dict)
    covered: dict[str, int] = field(default_factory=dict)
    downloaded: float = 0.0
    downloaded_bytes: int = 0
    of_bytes: int = 0
    sent: dict[str, tuple[int, int]] = field(default_factory=dict)
    shared: list[LaterDrive] = field(default_factory=list)
    ranked: list[LaterDrive] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """What ``demo --json`` prints."""
        return dict(msgspec.to_builtins(self, enc_hook=str))

    def sharing(self) -> str:
        """What the fleet's map took of each robot, and what scout downloads of it, in words."""
        took = " and ".join(
            f"{taken} of {robot}'s {taken + self.covered[robot]}"
            for robot, taken in self.taken.items()
        )
        sent = ", ".join(
            f"{some} of {every} from {drive}" for drive, (some, every) in self.sent.items()
        )
        return (
            "Merging finds matches between the maps, which tie them together. The fleet's map "
            f"takes {took} nodes; the others matched what it has. scout downloads "
            f"{self.downloaded_bytes / 1e6:.1f} of {self.of_bytes / 1e6:.1f} MB of it: the nodes "
            f"expected to prevent most failures per byte on a drive at {_DEPARTS_H:.0f} o'clock. "
            f"Weather may bring the light of other hours, so some are of these: "
            f"{sent}.{self._used()}"
        )

    def _used(self) -> str:
        """Which of the downloaded drives scout matches, in words; "" if all."""
        matched = [one.matched for one in self.shared if one.map == _SENT]
        used = [drive for drive in self.sent if any(drive in one for one in matched)]
        if not used or len(used) == len(self.sent):
            return ""
        return f" scout matches only those from {' and '.join(used)}."

    def accuracy(self) -> str:
        """How right all matches are, in words."""
        mapped = [one.judged for one in self.mapped]
        once = mapped + [one.judged for one in self.shared if one.map == _FLEET]
        # The default policy's run is also one of those shared.
        runs = mapped + [
            one.judged for one in {id(a): a for a in self.shared + self.ranked}.values()
        ]
        return (
            f"Each drive once, as mapped or in the fleet's map: {sum(once, Judged((), 0)).text()}. "
            f"False matches of all runs above: {sum(one.false for one in runs)}."
        )

    def tables(self) -> list[DemoTable]:
        """What people read of it."""
        budget = RobotOptions().budget
        last = f"{self.ranked[-1].drive}, in {self.ranked[-1].map}" if self.ranked else ""
        figures, inliers, error = ("localised", "gap m"), "inliers", "error cm"
        return [
            DemoTable(
                "Each robot maps what its map lacks",
                "A frame that matches nothing becomes a new node. One with few inliers is "
                "localised, and becomes a weak node, too. One less than 1 m from the last node, by "
                "odometry, is skipped.",
                ("drive", "localised", "weak", "new", "why"),
                [one.row() for one in self.mapped],
            ),
            DemoTable(
                "Then they share",
                f"{self.sharing()} A frame is tried with up to {budget.attempts} nodes, "
                f"{budget.lanes} at a time, or {budget.lost_attempts} if the robot is lost. At "
                "night few landmarks match a map of days, and how many varies: wildcat on Tuesday, "
                "and courier in its own map, are lost until a node happens to match.",
                ("drive", "map", *figures, inliers, error),
                [(one.drive, one.map.removesuffix(" map"), *one.figures()) for one in self.shared],
            ),
            DemoTable(
                "Which node to try first",
                f"{last}: attempts allowed for a frame ({budget.lost_attempts} while lost) and "
                "made, on average over all frames. distance tries the nearest node first; recall, "
                "the default, the one that it expects to match best, by this and past drives. "
                "recall misses less, but its nodes are farther away (node m, median), so its error "
                "is larger. Where centimetres count more than gaps: --ranking distance.",
                ("policy", "allowed", "made", *figures, inliers, "node m", error),
                [
                    (
                        one.policy,
                        str(one.attempts),
                        f"{one.summary['attempts_per_frame']:.2f}",
                        *one.figures(node=True),
                    )
                    for one in self.ranked
                ],
            ),
        ]


class Rendered:
    """The whole images of simulated drives, rendered on request."""

    def __init__(self, drives: Sequence[SimulatedDrive]) -> None:
        self._at = {
            drive.stamp_ns(frame): (drive, frame) for drive in drives for frame in range(len(drive))
        }
        self._kept: dict[int, Image] = {}

    def world_from_cam(self) -> dict[int, SE3]:
        """The true pose of every frame, by its stamp."""
        return {
            stamp: drive.poses[frame].world_from_cam for stamp, (drive, frame) in self._at.items()
        }

    def drives_of(self, stamps_ns: Iterable[int]) -> dict[str, int]:
        """Number of stamps of each drive that has any."""
        return dict(Counter(_begins(self._at[one][0]) for one in stamps_ns))

    def prepare(self, stamps_ns: Iterable[int]) -> None:
        """Renders images drive by drive, and the place that is shown of each of these drives.

        The town is built again wherever the drive changes.
        """
        wanted = {stamp_ns for stamp_ns in stamps_ns if stamp_ns in self._at}
        wanted |= {_place_ns(self._at[stamp_ns][0]) for stamp_ns in wanted}
        for stamp_ns in sorted(wanted):
            self._image(stamp_ns)

    def place(self, drive: SimulatedDrive) -> Image:
        """The place that is shown of every drive, (h, w) uint8."""
        image = self._image(_place_ns(drive))
        assert image is not None
        return image

    def _image(self, stamp_ns: int) -> Image | None:
        if stamp_ns not in self._kept and stamp_ns in self._at:
            drive, frame = self._at[stamp_ns]
            self._kept[stamp_ns] = next(iter(drive.frames(frame, frame + 1))).left
        return self._kept.get(stamp_ns)

    def find(self, stamp_ns: int, small: Image) -> Image | None:
        """See `engram.viewing.matches.Images`."""
        image = self._image(stamp_ns)
        return image if image is not None and shows(image, small) else None


def _place_ns(drive: SimulatedDrive) -> int:
    return drive.stamp_ns(int(_SHOWN_AT * len(drive)))


def run_demo(out: Path, monitor: Monitor = QUIET, workers: int = 2) -> DemoReport:
    """Renders the drives, maps, merges, downloads, localises, and writes the report.

    What an earlier run has rendered is not rendered again.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made: {error.strerror}") from error
    campaign = demo_campaign()
    drives = [SimulatedDrive(campaign, i) for i in range(len(campaign.sessions))]
    report = DemoReport(out, out / "report.html")
    rendered = simulate(campaign, out / "drives", workers=workers, monitor=monitor)
    logs = [Path(file) for file in rendered.files]
    for file in out.glob("*.engram*"):
        file.unlink()
    images = Rendered(drives)
    truth = images.world_from_cam()
    for number in _MAPPED:
        report.mapped.append(_map(out, logs[number], drives[number], truth, monitor))
    fleet = out / "fleet.engram"
    robots = dict.fromkeys(drives[number].plan.robot for number in _MAPPED)
    for merged in merge(fleet, [out / f"{robot}.engram" for robot in robots], monitor=monitor):
        robot = Path(merged.source).stem
        report.taken[robot], report.covered[robot] = merged.taken, merged.omitted
    mission = DownloadOptions(
        "budget", depart_h=_DEPARTS_H, budget_percent=_SHARE_PERCENT, thumbnails=True
    )
    sent = download(fleet, out / "scout.engram", mission, monitor=monitor)
    report.downloaded = sent.size_bytes / sent.of_bytes
    report.downloaded_bytes, report.of_bytes = sent.size_bytes, sent.of_bytes
    every, some = _nodes_by_drive(fleet), _nodes_by_drive(out / "scout.engram")
    for number in _MAPPED:
        start_ns = drives[number].stamp_ns(0)
        report.sent[_begins(drives[number])] = some.get(start_ns, 0), every.get(start_ns, 0)
    sections = _localise_all(report, logs, drives, images, monitor)
    _page(report, drives, images, sections).write(report.page, made_by())
    return report


def _nodes_by_drive(map_path: Path) -> dict[int, int]:
    """Number of nodes of each drive of a map, by its start, ns."""
    with open_map(map_path) as opened:
        sizes = opened.session_sizes()
        return {session.start_ns: sizes[one][0] for one, session in opened.sessions.items()}


def _map(
    out: Path, log: Path, drive: SimulatedDrive, truth: Mapping[int, SE3], monitor: Monitor
) -> MappedDrive:
    map_path, sequence = out / f"{drive.plan.robot}.engram", open_drive(log)
    first, about = not map_path.exists(), _about(drive)
    with monitor.stage(f"map: {about}", len(sequence)) as part:
        mapped = map_drive(map_path, sequence, Settings(), RobotOptions(), part)
    return MappedDrive.of(about, mapped, Judged.of(mapped.results, truth), first=first)


def _begins(drive: SimulatedDrive) -> str:
    return f"{drive.plan.start:%a %H:%M}"


def _about(drive: SimulatedDrive) -> str:
    return f"{drive.plan.words}, {drive.plan.robot}"


def _localise_all(
    report: DemoReport,
    logs: Sequence[Path],
    drives: Sequence[SimulatedDrive],
    images: Rendered,
    monitor: Monitor,
) -> list[str]:
    """Localises the later drives; the parts of a page about those with what the fleet shares."""
    out, sections = report.out, list[str]()
    truth = images.world_from_cam()
    fleet = out / "fleet.engram"
    runs = (
        (_NIGHT, _OWN, out / "courier.engram"),
        (_NIGHT, _FLEET, fleet),
        (_NEWCOMER, _SENT, out / "scout.engram"),
        (_NEWCOMER, _FLEET, fleet),
    )
    for number, name, map_path in runs:
        log = open_drive(logs[number])
        run = _Run(_about(drives[number]), name, map_path, log, images, truth)
        shown = name == (_FLEET if number == _NIGHT else _SENT)
        report.shared.append(run.localise(RobotOptions(), monitor, shown=shown))
        sections += run.sections
    night, by_default = _about(drives[_NIGHT]), RobotOptions()
    (known,) = [one for one in report.shared if (one.drive, one.map) == (night, _FLEET)]
    for policy in _POLICIES:
        for rounds in _ROUNDS:
            options = RobotOptions(ranking=policy, rounds=rounds)
            run = _Run(night, _FLEET, fleet, open_drive(logs[_NIGHT]), images, truth)
            report.ranked.append(
                known if options == by_default else run.localise(options, monitor, shown=False)
            )
    return sections


@dataclass(slots=True)
class _Run:
    """A drive in a map; `sections` of a page about it."""

    about: str
    name: str
    map_path: Path
    sequence: Any
    images: Rendered
    truth: Mapping[int, SE3]
    sections: list[str] = field(default_factory=list)

    def localise(self, options: RobotOptions, monitor: Monitor, *, shown: bool) -> LaterDrive:
        """The drive by these options."""
        results, at_m = list[Localisation](), 0.0
        policy, most = options.ranking, options.budget.attempts
        what = f"localise: {self.about}, in {self.name}, {policy}, {most} a frame"
        with (
            open_map(self.map_path) as opened,
            robot_on(opened, self.sequence, Settings(), options) as robot,
            monitor.stage(what, len(self.sequence)) as part,
        ):
            records = ResultRecords(DisplayPose(opened.frame, robot.graph))
            session = session_of_drive(self.sequence)
            showcase = Showcase(MatchShower(opened, robot, session, self.images))
            for frame, found in enumerate(robot.drive(self.sequence, part)):
                results.append(found)
                records.see(found)
                at_m += found.motion.moved_m
                if shown and robot.last is not None:
                    showcase.see(robot.last, found, frame, at_m)
            summary = summarise(results)
            judged = Judged.of(results, self.truth)
            if shown:
                self.images.prepare(showcase.stamps_ns())
                findings = robot.diagnosis.to_dict()["findings"]
                whole = {"map": self.map_path.name, "drive": self.about,
                         "summary": {**summary, "findings": findings},
                         "frames": records.frames(results)}  # fmt: skip
                again = ["# A .framelog holds landmarks and odometry, no images.", self._again()]
                page = drive_page(msgspec.convert(whole, DriveResult), opened, showcase, again)
                self.sections = [
                    heading(f"{self.about}, in {self.name}"),
                    paragraph(f"{page.verdict} By the truth: {judged.text()}. {_start(results)}"),
                    *page.sections,
                ]
        matches = [one for one in results if one.node_from_live is not None]
        return LaterDrive(
            self.about,
            self.name,
            policy,
            most,
            summary,
            judged,
            _median(one.inliers for one in matches),
            _median(one.node_from_live.distance_m for one in matches if one.node_from_live),
            self.images.drives_of(one.node_stamp_ns for one in matches if one.node_stamp_ns),
        )

    def _again(self) -> str:
        """The command that localises the drive as the demo did."""
        return typed(
            "engram", "localise", self.map_path, self.sequence.path, "--report", "drive.html"
        )


def _start(results: Sequence[Localisation]) -> str:
    """How the robot found where it is, in words."""
    first = next((at for at, one in enumerate(results) if one.localised), None)
    if first is None:
        return f"Given no position, the robot found none. {_LANDMARKS_ONLY}"
    tried = sum(one.attempts for one in results[: first + 1])
    return (
        f"Given no position, the robot found it at frame {first}, after "
        f"{counted(tried, 'attempt')}. {_LANDMARKS_ONLY}"
    )


def _page(
    report: DemoReport, drives: Sequence[SimulatedDrive], images: Rendered, sections: list[str]
) -> Page:
    """The report: the story in tables, the place in all conditions, and the later drives."""
    place = photograph(
        as_jpeg(_one_place(drives, images)),
        "One place in the six drives",
        "Left images, in the order of time; the last two are of the later drives.",
    )
    parts = [paragraph(MEANING), place]
    for one in report.tables():
        parts += [heading(one.title), table(one.head, one.rows, one.about)]
    parts += [paragraph(report.accuracy())]
    own = [heading("Your own drives"), paragraph(OWN_DRIVES), commands(OWN_COMMANDS)]
    return Page("Engram's demo", INTRODUCTION, [*parts, *sections, *own, paragraph(LIMITS)])


def _one_place(drives: Sequence[SimulatedDrive], images: Rendered) -> NDArray[np.uint8]:
    """The same place in each drive, with its condition below."""
    tiles = []
    for drive in drives:
        tile = cv2.resize(images.place(drive), (512, 384))
        tile = cv2.copyMakeBorder(tile, 0, 28, 0, 0, cv2.BORDER_CONSTANT, value=(0,))
        words = _about(drive)
        cv2.putText(
            tile, words, (8, 384 + 19), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255,), 1, cv2.LINE_AA
        )
        tiles.append(tile)
    rows = [np.hstack(tiles[i : i + 3]) for i in range(0, len(tiles), 3)]
    return np.vstack(rows)
