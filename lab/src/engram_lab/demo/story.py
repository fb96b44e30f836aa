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

from engram.counts import counted
from engram.errors import InputError
from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.merge.merging import merge
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
from engram.viewing.page import Page, as_jpeg, heading, paragraph, photograph, table
from engram.viewing.pictures import Image
from engram.viewing.report import Showcase, drive_page, made_by
from engram_lab.town.camera_model import CLEAN
from engram_lab.town.campaigns import Campaign, campaign_named
from engram_lab.town.session import SimulatedDrive
from engram_lab.town.simulating import simulate

# Who maps which drives. The last robot has never been here.
_MAPPED = {"wildcat": (0, 2, 3), "courier": (1,)}
_LATER = {"courier": 4, "scout": 5}
# How people know the maps in which the later drives are localised.
_OWN, _FLEET = "its own map", "the fleet's map"
_POLICIES = ("recall", "distance")
# One attempt, or one after another up to four: what counts is which experience is tried first.
_ATTEMPTS = (1, 4)
# The scout's mission on Thursday morning, and the share of the fleet's map that it downloads.
_DEPARTS_H, _SHARE_PERCENT = 9.0, 60.0
# Between frames, half as many as the hamlet has: rendering is most of what the demo costs.
_SPACING_M = 1.4
# The place that is shown in every condition, as a share of the drive.
_SHOWN_AT = 0.35
INTRODUCTION = (
    "wildcat, courier and scout are robots with stereo cameras, in a simulated hamlet. wildcat and "
    "courier each map their drives and hand in their maps. Then courier drives by night, and "
    "scout, which has never been here, by day, both with the map that the fleet shares."
)


def demo_campaign() -> Campaign:
    """The hamlet's drives at 1.4 m between frames; a second night in place of the rain."""
    hamlet = campaign_named("hamlet")
    first_night = hamlet.sessions[3]
    later = first_night.start + timedelta(days=1, minutes=15)
    second = replace(hamlet.sessions[4], start=later, weather=first_night.weather, lens=CLEAN)
    sessions = (*hamlet.sessions[:4], second, *hamlet.sessions[5:])
    return replace(hamlet, name="demo", sessions=sessions, spacing_m=_SPACING_M)


@dataclass(frozen=True, slots=True)
class MappedDrive:
    """A drive that a robot mapped.

    Attributes:
        drive: its time, weather and robot.
        new: nodes saved where nothing matched.
        weak: nodes saved where few landmarks matched.
        why: a sentence on what surprises; "" if nothing does.
    """

    drive: str
    localised: float
    new: int
    weak: int
    why: str

    @staticmethod
    def of(drive: str, mapped: MapReport, *, first: bool) -> MappedDrive:
        """What a drive added; `first` if its robot's map was empty."""
        saved = [one for one in mapped.results if one.saved is not None]
        weak = sum(one.localised for one in saved)
        share = sum(one.localised for one in mapped.results) / max(len(mapped.results), 1)
        return MappedDrive(
            drive, share, len(saved) - weak, weak, _why(share, len(saved), weak, first=first)
        )


def _why(share: float, saved: int, weak: int, *, first: bool) -> str:
    if first:
        return "the robot's map was empty: all of it is new"
    if not saved:
        return "nothing new"
    if weak > saved / 2:
        return "recognised, but weakly in this light: kept for the next drive like it"
    if share < 0.7:
        return "much of it looks unlike every drive before: an experience of its own"
    return ""


@dataclass(frozen=True, slots=True)
class LaterDrive:
    """A later drive, localised in a map."""

    drive: str
    map: str
    policy: str
    attempts: int
    summary: dict[str, Any]


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
    """

    out: Path
    page: Path
    mapped: list[MappedDrive] = field(default_factory=list)
    taken: dict[str, int] = field(default_factory=dict)
    covered: dict[str, int] = field(default_factory=dict)
    downloaded: float = 0.0
    shared: list[LaterDrive] = field(default_factory=list)
    ranked: list[LaterDrive] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """What ``demo --json`` prints."""
        return dict(msgspec.to_builtins(self, enc_hook=str))

    def sharing(self) -> str:
        """What the fleet's map took of each robot, in words."""
        robots = [
            f"{robot} handed in {counted(taken + self.covered[robot], 'node')}, of which "
            f"{self.covered[robot]} were covered already"
            for robot, taken in self.taken.items()
        ]
        return f"{'; '.join(robots)}. scout downloads {self.downloaded:.0%} of the fleet's bytes."

    def tables(self) -> list[DemoTable]:
        """What people read of it."""
        grown = [
            (one.drive, f"{one.localised:.0%}", str(one.new), str(one.weak), one.why)
            for one in self.mapped
        ]
        shared = [(one.drive, one.map, *_figures(one.summary)) for one in self.shared]
        ranked = [
            (
                one.policy,
                str(one.attempts),
                f"{one.summary['attempts_per_frame']:.2f}",
                *_figures(one.summary),
            )
            for one in self.ranked
        ]
        last = self.ranked[-1].drive if self.ranked else ""
        return [
            DemoTable(
                "Each robot's map grows where a place is new to it, or matches weakly",
                "Nodes saved: new, where nothing matched; weak, where few landmarks did.",
                ("drive", "localised", "new", "weak", "why"),
                grown,
            ),
            DemoTable(
                "Then they share",
                "The same drives with either map, four attempts a frame.",
                ("drive", "with", "localised", "longest gap, m"),
                shared,
            ),
            DemoTable(
                "Which node to try first",
                f"{last}, by policy and attempts allowed for a frame.",
                ("policy", "allowed", "made a frame", "localised", "longest gap, m"),
                ranked,
            ),
        ]


def _figures(summary: Mapping[str, Any]) -> tuple[str, str]:
    return f"{summary['share_localised']:.0%}", f"{summary['longest_gap_m']:.1f}"


class Rendered:
    """The whole images of simulated drives, rendered on request."""

    def __init__(self, drives: Sequence[SimulatedDrive]) -> None:
        self._at = {
            drive.stamp_ns(frame): (drive, frame) for drive in drives for frame in range(len(drive))
        }
        self._kept: dict[int, Image] = {}

    def prepare(self, stamps_ns: Iterable[int]) -> None:
        """Renders images drive by drive: the town is built again wherever the drive changes."""
        for stamp_ns in sorted(stamps_ns):
            self._image(stamp_ns)

    def _image(self, stamp_ns: int) -> Image | None:
        if stamp_ns not in self._kept and stamp_ns in self._at:
            drive, frame = self._at[stamp_ns]
            self._kept[stamp_ns] = next(iter(drive.frames(frame, frame + 1))).left
        return self._kept.get(stamp_ns)

    def find(self, stamp_ns: int, small: Image) -> Image | None:
        """See `engram.viewing.matches.Images`."""
        image = self._image(stamp_ns)
        return image if image is not None and shows(image, small) else None


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
    for robot, numbers in _MAPPED.items():
        for number in numbers:
            report.mapped.append(_map(out, robot, logs[number], drives[number], monitor))
    fleet = out / "fleet.engram"
    for merged in merge(fleet, [out / f"{robot}.engram" for robot in _MAPPED], monitor=monitor):
        robot = Path(merged.source).stem
        report.taken[robot], report.covered[robot] = merged.taken, merged.omitted
    mission = DownloadOptions(
        "budget", depart_h=_DEPARTS_H, budget_percent=_SHARE_PERCENT, thumbnails=True
    )
    sent = download(fleet, out / "scout.engram", mission, monitor=monitor)
    report.downloaded = sent.size_bytes / sent.of_bytes
    sections = _localise_all(report, logs, drives, monitor)
    _page(report, drives, sections).write(report.page, made_by())
    return report


def _map(out: Path, robot: str, log: Path, drive: SimulatedDrive, monitor: Monitor) -> MappedDrive:
    map_path, sequence = out / f"{robot}.engram", open_drive(log, robot=robot)
    first, about = not map_path.exists(), _about(drive, robot)
    with monitor.stage(f"map: {about}", len(sequence)) as part:
        mapped = map_drive(map_path, sequence, Settings(), RobotOptions(), part)
    return MappedDrive.of(about, mapped, first=first)


def _about(drive: SimulatedDrive, robot: str) -> str:
    plan = drive.plan
    night = ", night" if plan.start.hour >= 22 else f", {plan.weather}"
    return f"{plan.start:%a %H:%M}{night}, {robot}"


def _localise_all(
    report: DemoReport, logs: Sequence[Path], drives: Sequence[SimulatedDrive], monitor: Monitor
) -> list[str]:
    """Localises the later drives; the parts of a page about those with the fleet's map."""
    images, out, sections = Rendered(drives), report.out, list[str]()
    for robot, number in _LATER.items():
        maps = {_OWN: out / f"{robot}.engram", _FLEET: out / "fleet.engram"}
        if robot == "scout":
            maps = {_FLEET: out / "scout.engram"}
        about = _about(drives[number], robot)
        for name, map_path in maps.items():
            part = _Run(about, map_path, open_drive(logs[number], robot=robot), images)
            summary = part.localise("recall", max(_ATTEMPTS), monitor, shown=name == _FLEET)
            report.shared.append(LaterDrive(about, name, "recall", max(_ATTEMPTS), summary))
            sections += part.sections
    for policy in _POLICIES:
        for most in _ATTEMPTS:
            run = _Run(about, maps[_FLEET], open_drive(logs[number], robot=robot), images)
            summary = run.localise(policy, most, monitor, shown=False)
            report.ranked.append(LaterDrive(about, _FLEET, policy, most, summary))
    return sections


@dataclass(slots=True)
class _Run:
    """A drive in a map; `sections` of a page about it."""

    about: str
    map_path: Path
    sequence: Any
    images: Rendered
    sections: list[str] = field(default_factory=list)

    def localise(self, policy: str, most: int, monitor: Monitor, *, shown: bool) -> dict[str, Any]:
        """The summary of the drive by one policy and number of attempts."""
        options = RobotOptions(ranking=policy, lanes=1, rounds=most)
        results, at_m = list[Localisation](), 0.0
        what = f"localise: {self.about}, {policy}, {most} a frame"
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
            if shown:
                self.images.prepare(showcase.stamps_ns())
                log = self.sequence.path
                whole = {"map": self.map_path.name, "drive": self.about, "summary": summary,
                         "frames": records.frames(results)}  # fmt: skip
                again = f"engram localise {self.map_path} {log} --report drive.html"
                page = drive_page(msgspec.convert(whole, DriveResult), opened, showcase, [again])
                self.sections = [heading(self.about), paragraph(page.verdict), *page.sections]
        return summary


def _page(report: DemoReport, drives: Sequence[SimulatedDrive], sections: list[str]) -> Page:
    """The report: the story in tables, the place in all conditions, and the later drives."""
    place = photograph(
        as_jpeg(_one_place(drives)),
        "One place in the six drives",
        "Left images, in the order of time; the last two are of the later drives.",
    )
    parts = [place, paragraph(report.sharing())]
    for one in report.tables():
        parts += [heading(one.title), table(one.head, one.rows, one.about)]
    verdict = " ".join(
        f"{drive.drive}: {drive.summary['share_localised']:.0%} localised with {drive.map}."
        for drive in report.shared
    )
    return Page("Engram's demo", f"{INTRODUCTION} {verdict}", [*parts, *sections])


def _one_place(drives: Sequence[SimulatedDrive]) -> NDArray[np.uint8]:
    """The same place in each drive, with its condition below."""
    robots = {number: robot for robot, number in _LATER.items()}
    robots |= {number: robot for robot, numbers in _MAPPED.items() for number in numbers}
    tiles = []
    for number, drive in enumerate(drives):
        at = int(_SHOWN_AT * len(drive))
        pair = next(iter(drive.frames(at, at + 1)))
        tile = cv2.resize(pair.left, (512, 384))
        tile = cv2.copyMakeBorder(tile, 0, 28, 0, 0, cv2.BORDER_CONSTANT, value=(0,))
        words = _about(drive, robots[number])
        cv2.putText(
            tile, words, (8, 384 + 19), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255,), 1, cv2.LINE_AA
        )
        tiles.append(tile)
    rows = [np.hstack(tiles[i : i + 3]) for i in range(0, len(tiles), 3)]
    return np.vstack(rows)
