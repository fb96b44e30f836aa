"""Two robots map a hamlet and hand in; another drive and a third robot use what they share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError
from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.merge.merging import merge
from engram.geometry.se3 import SE3
from engram.localiser.localisation import Budget, Localisation
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

# Who maps which drives. The last robot has never been here.
_MAPPED = {"wildcat": (0, 2, 3), "courier": (1,)}
_LATER = {"courier": 4, "scout": 5}
# What people call the maps in which the later drives are localised.
_OWN, _FLEET, _SENT = "its own map", "the fleet's map", "its download"
_POLICIES = ("recall", "distance")
# Whose later drive the policies are compared on, in the fleet's map: the night is harder.
_RANKED = "courier"
# One attempt, or one after another up to four: what counts is which experience is tried first.
_ATTEMPTS = (1, 4)
# The scout's mission on Thursday morning, and the share of the fleet's map that it downloads.
_DEPARTS_H, _SHARE_PERCENT = 9.0, 60.0
# Between frames, half as many as the hamlet has: rendering is most of what the demo costs.
_SPACING_M = 1.4
# The route begins in mid-bend, where no earlier motion tells odometry of the turn.
_BEGINS_M = 4.0
# The place that is shown in every condition, as a share of the drive.
_SHOWN_AT = 0.35
INTRODUCTION = (
    "wildcat, courier and scout are simulated robots with stereo cameras, in a hamlet. Nobody "
    "gives them a position: they find it by appearance, and drive on by odometry from their "
    "images. wildcat and courier map their drives and hand in their maps. Then courier, which "
    "mapped one afternoon, drives by night, and scout, here for the first time, by day, both with "
    "the map that the fleet shares. It has wildcat's night."
)
MEANING = (
    "Localised: the frame matched a node, a frame kept in the map, well enough to measure its pose "
    "from there and to steer by it. gap: the longest way between two matches. error: the median, "
    "by the simulator's truth. false: fixes more than 1 m or 5° off. Frames are 1.4 m apart to "
    "save time; the doctor, who looks for faults of drives, warns of that."
)
LIMITS = (
    "This is a simulation; of real images only short drives of KITTI and EuRoC were tried. "
    "Figures, rain and snow, and what fails: docs/evidence.md."
)
OWN_DRIVES = "Your own drive, a ROS bag or a folder of stereo images (docs/data.md):"
OWN_COMMANDS = ("engram doctor DRIVE", "engram map town.engram DRIVE")


def demo_campaign() -> Campaign:
    """The hamlet's drives, sparser and from behind its first bend; a second night for the rain."""
    hamlet = campaign_named("hamlet")
    first_night = hamlet.sessions[3]
    later = first_night.start + timedelta(days=1, minutes=15)
    second = replace(hamlet.sessions[4], start=later, weather=first_night.weather, lens=CLEAN)
    sessions = (*hamlet.sessions[:4], second, *hamlet.sessions[5:])
    return replace(hamlet, name="demo", sessions=sessions, spacing_m=_SPACING_M, begins_m=_BEGINS_M)


@dataclass(frozen=True, slots=True)
class Judged:
    """The fixes of a drive, against the simulator's truth.

    Attributes:
        error_m: of each fix, between the true and the measured position in the matched node.
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
        return f"median error {self.median_cm} cm, {self.false} of {len(self.error_m)} fixes false"


@dataclass(frozen=True, slots=True)
class MappedDrive:
    """A drive that a robot mapped.

    Attributes:
        drive: its time, weather and robot.
        new: nodes saved where nothing matched.
        weak: nodes saved where few landmarks matched.
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
        return MappedDrive(drive, share, len(saved) - weak, weak, why, frames, judged)

    def row(self) -> tuple[str, ...]:
        """What people read of it."""
        localised = f"{self.localised * self.frames:.0f} of {self.frames}"
        return self.drive, localised, str(self.new), str(self.weak), self.why


def _why(share: float, saved: int, weak: int, *, first: bool) -> str:
    if first:
        return "its map was empty"
    if not saved:
        return "nothing new"
    if weak > saved / 2:
        return "recognised, but weakly"
    if share < 0.7:
        return "much of it unlike before"
    return "most of it known"


@dataclass(frozen=True, slots=True)
class LaterDrive:
    """A later drive, localised in a map."""

    drive: str
    map: str
    policy: str
    attempts: int
    summary: dict[str, Any]
    judged: Judged

    def figures(self) -> tuple[str, ...]:
        """What people read of it."""
        summary, judged = self.summary, self.judged
        return (
            f"{summary['share_localised']:.0%}",
            f"{summary['longest_gap_m']:.1f}",
            judged.median_cm,
            f"{judged.false}",
        )


# Heads of `LaterDrive.figures`.
_FIGURES = ("localised", "gap, m", "error, cm", "false")


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
            f"The fleet's map took {took} nodes; the others matched nodes that it had. scout loads "
            f"{self.downloaded_bytes / 1e6:.1f} of {self.of_bytes / 1e6:.1f} MB of it, the nodes "
            f"that a drive at {_DEPARTS_H:.0f} o'clock most likely needs: {sent}."
        )

    def accuracy(self) -> str:
        """How right all fixes are, in words."""
        judged = [one.judged for one in self.mapped]
        judged += [one.judged for one in (*self.shared, *self.ranked)]
        return f"In all these drives: {sum(judged, Judged((), 0)).text()}."

    def tables(self) -> list[DemoTable]:
        """What people read of it."""
        budget, lane = RobotOptions().budget, Budget(lanes=1)
        last = f"{self.ranked[-1].drive}, in {self.ranked[-1].map}" if self.ranked else ""
        return [
            DemoTable(
                "Each robot maps what its map lacks",
                "A frame that matches nothing becomes a new node, and one that matches weakly a "
                "weak one, unless odometry fails there.",
                ("drive", "localised", "new", "weak", "why"),
                [one.row() for one in self.mapped],
            ),
            DemoTable(
                "Then they share",
                f"{self.sharing()} A frame is tried with up to {budget.attempts} nodes, that of a "
                f"lost robot with up to {budget.lost_attempts}. By night in a map of days it is "
                "lost until one happens to match: wildcat on Tuesday, courier in its own map.",
                ("drive", "map", *_FIGURES),
                [(one.drive, one.map.removesuffix(" map"), *one.figures()) for one in self.shared],
            ),
            DemoTable(
                "Which node to try first",
                f"{last}, by attempts allowed for a frame, {lane.lost_attempts} while lost, and "
                "made. distance tries the nearest node first; recall, the default, the one "
                "likeliest to match: near, and matched just before or by past drives.",
                ("policy", "allowed", "made", *_FIGURES),
                [
                    (
                        one.policy,
                        str(one.attempts),
                        f"{one.summary['attempts_per_frame']:.2f}",
                        *one.figures(),
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
    in_order = sorted((number, robot) for robot, numbers in _MAPPED.items() for number in numbers)
    for number, robot in in_order:
        report.mapped.append(_map(out, robot, logs[number], drives[number], truth, monitor))
    fleet = out / "fleet.engram"
    for merged in merge(fleet, [out / f"{robot}.engram" for robot in _MAPPED], monitor=monitor):
        robot = Path(merged.source).stem
        report.taken[robot], report.covered[robot] = merged.taken, merged.omitted
    mission = DownloadOptions(
        "budget", depart_h=_DEPARTS_H, budget_percent=_SHARE_PERCENT, thumbnails=True
    )
    sent = download(fleet, out / "scout.engram", mission, monitor=monitor)
    report.downloaded = sent.size_bytes / sent.of_bytes
    report.downloaded_bytes, report.of_bytes = sent.size_bytes, sent.of_bytes
    every, some = _nodes_by_drive(fleet), _nodes_by_drive(out / "scout.engram")
    for number, _ in in_order:
        start_ns = drives[number].stamp_ns(0)
        if every.get(start_ns, 0) > 1:
            name = f"{drives[number].plan.start:%a %H:%M}"
            report.sent[name] = some.get(start_ns, 0), every[start_ns]
    sections = _localise_all(report, logs, drives, images, monitor)
    _page(report, drives, images, sections).write(report.page, made_by())
    return report


def _nodes_by_drive(map_path: Path) -> dict[int, int]:
    """Number of nodes of each drive of a map, by its start, ns."""
    with open_map(map_path) as opened:
        sizes = opened.session_sizes()
        return {session.start_ns: sizes[one][0] for one, session in opened.sessions.items()}


def _map(
    out: Path,
    robot: str,
    log: Path,
    drive: SimulatedDrive,
    truth: Mapping[int, SE3],
    monitor: Monitor,
) -> MappedDrive:
    map_path, sequence = out / f"{robot}.engram", open_drive(log, robot=robot)
    first, about = not map_path.exists(), _about(drive, robot)
    with monitor.stage(f"map: {about}", len(sequence)) as part:
        mapped = map_drive(map_path, sequence, Settings(), RobotOptions(), part)
    return MappedDrive.of(about, mapped, Judged.of(mapped.results, truth), first=first)


def _about(drive: SimulatedDrive, robot: str) -> str:
    return f"{drive.plan.words}, {robot}"


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
    maps = {
        "courier": {_OWN: out / "courier.engram", _FLEET: fleet},
        "scout": {_SENT: out / "scout.engram", _FLEET: fleet},
    }
    for robot, number in _LATER.items():
        for name, map_path in maps[robot].items():
            log = open_drive(logs[number], robot=robot)
            run = _Run(_about(drives[number], robot), name, map_path, log, images, truth)
            shown = name == (_FLEET if robot == "courier" else _SENT)
            report.shared.append(run.localise(RobotOptions(), monitor, shown=shown))
            sections += run.sections
    number = _LATER[_RANKED]
    for policy in _POLICIES:
        for most in _ATTEMPTS:
            log = open_drive(logs[number], robot=_RANKED)
            run = _Run(_about(drives[number], _RANKED), _FLEET, fleet, log, images, truth)
            options = RobotOptions(ranking=policy, lanes=1, rounds=most)
            report.ranked.append(run.localise(options, monitor, shown=False))
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
                again = ["# The log holds landmarks and odometry, no images.", self._again()]
                page = drive_page(msgspec.convert(whole, DriveResult), opened, showcase, again)
                self.sections = [
                    heading(f"{self.about}, in {self.name}"),
                    paragraph(f"{page.verdict} By the truth: {judged.text()}."),
                    *page.sections,
                ]
        return LaterDrive(self.about, self.name, policy, most, summary, judged)

    def _again(self) -> str:
        """The command that localises the drive as the demo did."""
        robot, log = self.sequence.info.robot, self.sequence.path
        return typed(
            "engram", "localise", self.map_path, log, "--robot", robot, "--report", "drive.html"
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
    robots = {number: robot for robot, number in _LATER.items()}
    robots |= {number: robot for robot, numbers in _MAPPED.items() for number in numbers}
    tiles = []
    for number, drive in enumerate(drives):
        tile = cv2.resize(images.place(drive), (512, 384))
        tile = cv2.copyMakeBorder(tile, 0, 28, 0, 0, cv2.BORDER_CONSTANT, value=(0,))
        words = _about(drive, robots[number])
        cv2.putText(
            tile, words, (8, 384 + 19), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255,), 1, cv2.LINE_AA
        )
        tiles.append(tile)
    rows = [np.hstack(tiles[i : i + 3]) for i in range(0, len(tiles), 3)]
    return np.vstack(rows)
