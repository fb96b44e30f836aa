"""Cold starts anywhere: how often a robot that was just switched on finds itself in a large map.

    engram lab simulate village
    python -m engram_lab.checks.cold_starts village OUT --fold 0

Four folds of a rendered campaign are mapped. On the drives of the fifth a new robot is switched on
again and again, and driven on for up to 10 m until it is found. Truth judges where it was found;
where it was not, all nodes that truly stand near are matched with every frame of those 10 m, which
tells whether it could have been found at all. A sample of frames is matched with every node of the
map, to show that nothing is to be found further away.

OUT keeps the map, one CSV row per start and the summary. The same command resumes it.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from engram.cli.screen import Bars
from engram.frontend.frame import FrameStatus
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId, node_id
from engram.localiser.acceptance import AcceptanceConfig
from engram.localiser.attempts import FrameMatcher
from engram.localiser.localisation import Budget
from engram.localiser.relocalisation import Relocaliser
from engram.maps.map import Map, open_map
from engram.monitor import Monitor
from engram.odometry.motion import GapFiller
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.localisers import localiser_in, relocaliser_in
from engram.robot.settings import RobotOptions, Settings
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.building import build_map, true_nodes
from engram_lab.studies.drives import EvaluatedDrive, TrueNodes, open_campaign, split
from engram_lab.town.simulating import campaigns_folder

FOLDS = 5
WITHIN_M = 10.0
# An answer further from the truth is a wrong place.
WRONG_M = 5.0
# A match is believed this far from its node, and right up to WRONG_M off: all that exhaustive
# matching could rightly find stands within the sum.
REACH_M = AcceptanceConfig().reach_m
NEAR_M = REACH_M + WRONG_M
# What exhaustive matching finds: it does not depend on how strict a robot is with itself.
FINDABLE_INLIERS = 40
# A generous budget, so that the map holds little twice.
MAPPING = RobotOptions(lanes=2, rounds=4)


@dataclass(frozen=True, slots=True)
class Start:
    """One robot that was switched on.

    Attributes:
        session: name of the drive.
        frame: number of the first frame.
        status: `found`; `possible` if not but exhaustive matching would have; else `impossible`.
        frames: live frames until it was found, or in those 10 m.
        driven_m: metres driven until then.
        attempts: match attempts until then.
        inliers: of the match that was believed; 0 unless found.
        error_m: distance between believed and true position; nan unless found.
    """

    session: str
    frame: int
    status: str
    frames: int
    driven_m: float
    attempts: int
    inliers: int
    error_m: float

    @property
    def wrong(self) -> bool:
        """Whether a wrong place was accepted."""
        return self.status == "found" and not self.error_m <= WRONG_M


class LiveDrive:
    """A held-out drive in a map, and which of its frames could be found at all."""

    def __init__(
        self, drive: EvaluatedDrive, opened: Map, true: TrueNodes, settings: Settings
    ) -> None:
        truth = drive.truth()
        if truth is None:
            raise SystemExit(f"{drive.path} has no truth next to it")
        self.drive, self.opened, self.settings = drive, opened, settings
        self.frames = drive.frames()
        self.truth = [truth.at(one.frame.stamp_ns) for one in self.frames]
        self._true = true
        self._matcher = FrameMatcher(opened.frames, settings.localiser.matcher)

    def findable(self, at: int) -> bool:
        """Whether matching with all nodes that stand near finds this frame."""
        pose = self.truth[at]
        return pose is not None and self.found_among(at, self._true.near(pose, NEAR_M))

    def found_among(self, at: int, nodes: set[NodeId]) -> bool:
        """Whether matching with any of these nodes finds this frame, rightly."""
        live = self.frames[at].frame
        if live.status is not FrameStatus.OK:
            return False
        live_id = node_id(self.drive.session.id, live.stamp_ns)
        for node in sorted(nodes):
            match = self._matcher.match(live, live_id, node, None)
            pose = match.reference_from_live
            if pose is None or match.inliers < FINDABLE_INLIERS or pose.distance_m > REACH_M:
                continue
            if self.error_m(at, node, pose) <= WRONG_M:
                return True
        return False

    def error_m(self, at: int, node: NodeId, node_from_live: SE3) -> float:
        """Distance between a measured and the true position."""
        world_from_live, world_from_node = self.truth[at], self._true.pose(node)
        if world_from_live is None or world_from_node is None:
            return float("nan")
        measured = world_from_node @ node_from_live
        return float(np.linalg.norm(measured.translation - world_from_live.translation))

    def starts(self, count: int) -> list[int]:
        """So many first frames, evenly spread, each with 10 m to drive behind it; all if fewer."""
        steps = [one.odometry.prev_from_curr for one in self.frames]
        lengths = [0.0 if step is None else step.distance_m for step in steps]
        able = np.flatnonzero(np.cumsum(lengths[::-1])[::-1] >= WITHIN_M)
        rows = np.linspace(0, len(able) - 1, min(count, len(able))).round().astype(int)
        return [int(at) for at in able[rows]]


def cold_start(live: LiveDrive, first: int, relocaliser: Relocaliser, budget: Budget) -> Start:
    """Switches a robot on at one frame and drives until it is found, 10 m at most."""
    relocaliser.forget()
    attempts, driven_m, at, name = 0, 0.0, first, live.drive.name
    gaps = GapFiller()
    with localiser_in(
        live.opened,
        live.drive.camera,
        live.settings,
        policy="path-near",
        budget=budget,
        relocaliser=relocaliser,
        live=live.drive.session.id,
    ) as localiser:
        for at in range(first, len(live.frames)):
            frame, odometry = live.frames[at].frame, live.frames[at].odometry
            if at == first:
                odometry = OdometryStep(OdometryStatus.FIRST)
            localiser.move(gaps.motion(odometry, frame.stamp_ns, landmarks=len(frame.landmarks)))
            found = localiser.localise(frame)
            attempts, driven_m = attempts + found.attempts, localiser.driven_m
            if found.node is not None and found.node_from_live is not None:
                error_m = live.error_m(at, found.node, found.node_from_live)
                return Start(
                    name, first, "found", at - first + 1, driven_m, attempts, found.inliers, error_m
                )
            if driven_m >= WITHIN_M:
                break
    possible = any(live.findable(frame) for frame in range(first, at + 1))
    status = "possible" if possible else "impossible"
    return Start(name, first, status, at - first + 1, driven_m, attempts, 0, float("nan"))


def summarise(starts: Sequence[Start], sampled: Sequence[tuple[bool, bool]]) -> Iterator[Figure]:
    """Of all starts, how many were found; of sampled frames, what exhaustive matching finds."""
    right = [one for one in starts if one.status == "found" and not one.wrong]
    possible = len(right) + sum(one.status == "possible" for one in starts)
    yield Figure("cold starts", len(starts))
    yield Figure(f"of which can be found within {WITHIN_M:.0f} m", possible)
    at_once = sum(one.frames == 1 for one in right)
    for what, part, whole in (
        (f"found within {WITHIN_M:.0f} m", len(right), possible),
        ("found at the first frame", at_once, possible),
        (
            f"wrong place believed (> {WRONG_M:.0f} m)",
            sum(one.wrong for one in starts),
            len(starts),
        ),
    ):
        yield Figure(what, 100 * part / whole if whole else float("nan"), "%")
    if right:
        errors, tries = ([getattr(x, n) for x in right] for n in ("error_m", "attempts"))
        yield Figure("error, median", float(np.median(errors)), "m")
        yield Figure("error, 99th percentile", float(np.percentile(errors, 99)), "m")
        yield Figure("attempts, median", float(np.median(tries)))
    if sampled:
        near, everywhere = np.array(sampled).sum(axis=0)
        yield Figure("sampled frames found among the nodes near by truth", float(near))
        yield Figure("sampled frames found among all nodes", float(everywhere))


def read_starts(file: Path) -> list[Start]:
    """The rows of an earlier run; none if there is no such file."""
    if not file.exists():
        return []
    kinds = {"session": str, "status": str, "driven_m": float, "error_m": float}
    with file.open(newline="") as rows:
        return [
            Start(**{key: kinds.get(key, int)(value) for key, value in row.items()})
            for row in csv.DictReader(rows)
            if None not in row.values()  # the last row of a killed run
        ]


def run_starts(
    drives: Sequence[LiveDrive],
    file: Path,
    count: int,
    relocaliser: Relocaliser,
    budget: Budget,
    monitor: Monitor,
) -> list[Start]:
    """All starts that the file does not hold yet; appends each as soon as it is done."""
    starts = read_starts(file)
    done = {(one.session, one.frame) for one in starts}
    with file.open("w", newline="") as rows:
        writer = csv.DictWriter(rows, [field.name for field in fields(Start)])
        writer.writeheader()
        writer.writerows(asdict(one) for one in starts)
        for live in drives:
            firsts = live.starts(count)
            with monitor.stage(live.drive.name, len(firsts)) as part:
                for first in firsts:
                    if (live.drive.name, first) not in done:
                        starts.append(cold_start(live, first, relocaliser, budget))
                        writer.writerow(asdict(starts[-1]))
                        rows.flush()
                    part.advance()
    return starts


def measure(drives: Sequence[EvaluatedDrive], asked: argparse.Namespace, monitor: Monitor) -> None:
    """Maps four folds, starts robots in the fifth, and reports."""
    fold = split(len(drives), FOLDS)[asked.fold]
    mapped = [drives[number] for number in fold.training]
    settings = Settings().for_descriptor(drives[0].descriptor)
    asked.out.mkdir(parents=True, exist_ok=True)
    built = build_map(asked.out / f"fold{asked.fold}.engram", mapped, settings, MAPPING)
    with open_map(built.path) as opened:
        true = true_nodes(opened, mapped)
        held_out = [LiveDrive(drives[one], opened, true, settings) for one in fold.held_out]
        relocaliser = relocaliser_in(opened, asked.relocaliser, settings.frontend.descriptor)
        file = asked.out / f"fold{asked.fold}-{asked.relocaliser}.csv"
        budget = Budget(asked.lanes, lost_rounds=asked.rounds)
        starts = run_starts(held_out, file, asked.starts, relocaliser, budget, monitor)
        every = {node.id for node in opened.graph.nodes}
        sampled = [
            (live.findable(at), live.found_among(at, every))
            for live in held_out
            for at in np.linspace(0, len(live.frames) - 1, asked.sample).astype(int).tolist()
        ]
        title = f"{len(mapped)} sessions, {len(every)} nodes; {asked.relocaliser}"
    report(summarise(starts, sampled), asked.json, title)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("campaign", help="a rendered campaign, NAME or NAME@SEED")
    parser.add_argument("out", type=Path, help="folder for the map and the results")
    parser.add_argument("--campaigns", type=Path, default=campaigns_folder())
    parser.add_argument("--fold", type=int, default=0, choices=range(FOLDS))
    parser.add_argument("--starts", type=int, default=640, help="of each drive, evenly spread")
    parser.add_argument("--relocaliser", default="fabmap")
    parser.add_argument("--lanes", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=Budget().lost_rounds)
    parser.add_argument("--sample", type=int, default=2, help="frames a drive matched with all")
    asked = parser.parse_args()
    measure(open_campaign(asked.campaign, asked.campaigns).drives, asked, Bars())


if __name__ == "__main__":
    main()
