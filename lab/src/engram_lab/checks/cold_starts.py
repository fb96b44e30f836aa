"""Cold starts anywhere: how often a robot that was just switched on finds itself in a large map.

Four folds of a rendered campaign are mapped, in the order of time. On the drives of the fifth a new
robot is switched on again and again, all along the drive, and driven on for up to 10 m until
it is found. Where it was found is judged by the simulator's truth; where it was not, all nodes that
stand near by truth are matched with every frame of those 10 m, which tells whether it could have
been found at all (exhaustive matching). A sample of frames is matched with every node of the map,
to show that nothing is to be found further away.

    engram lab simulate village
    python -m engram_lab.checks.cold_starts CAMPAIGN_FOLDER OUT --fold 0

OUT keeps the map, one CSV row per start and the summary. The same command goes on where it stopped.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.cli.progress import progress
from engram.frontend import FrameStatus
from engram.geometry import SE3
from engram.graph.basin import MatchBasin
from engram.graph.model import SessionId, node_id
from engram.localiser import (
    AcceptanceConfig,
    Budget,
    FrameMatcher,
    Localiser,
    LocaliserConfig,
    Relocaliser,
)
from engram.maps import Map, open_map
from engram.monitor import Advancing
from engram.odometry import GapFiller, OdometryStatus, OdometryStep
from engram.ranking import POLICIES
from engram.robot import RobotOptions, Settings, map_drive, open_drive
from engram.robot.localisers import relocaliser_in
from engram.robot.session import session_of_drive
from engram.sequences import LoggedFrame
from engram.sequences.trajectories import read_truth
from engram_lab.programs import command_line

FOLDS = 5
WITHIN_M = 10.0
# An answer further from the truth is a wrong place. Source: the table.
WRONG_M = 5.0
# A match is believed this far from its node, and right up to WRONG_M off: all that exhaustive
# matching could rightly find stands within the sum.
REACH_M = AcceptanceConfig().reach_m
NEAR_M = REACH_M + WRONG_M
# What exhaustive matching finds: it does not depend on how strict a robot is with itself.
FINDABLE_INLIERS = 40
LARGEST_TURN_RAD = float(np.deg2rad(90.0))
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
        """Whether a wrong place was believed."""
        return self.status == "found" and not self.error_m <= WRONG_M


@dataclass(frozen=True, slots=True, eq=False)
class Town:
    """A map and where its nodes truly stand.

    Attributes:
        opened: the map.
        world_from_node: truth of each node, by dense index.
        centres: (N, 3) float64, camera centres in the world, metres.
        axes: (N, 3) float64, viewing directions in the world.
    """

    opened: Map
    world_from_node: Sequence[SE3]
    centres: NDArray[np.float64]
    axes: NDArray[np.float64]

    @staticmethod
    def of(opened: Map, logs: Sequence[Path]) -> Town:
        """The truth of a map that was made from these logs."""
        truths = {session_of_drive(open_drive(log)).id: read_truth(log) for log in logs}
        poses = []
        for node in opened.graph.nodes:
            truth = truths[node.session]
            pose = None if truth is None else truth.at(node.stamp_ns)
            if pose is None:
                raise SystemExit(f"node {node.id}: its frame log has no truth beside it")
            poses.append(pose)
        return Town(
            opened,
            poses,
            np.array([pose.translation for pose in poses]).reshape(-1, 3),
            np.array([pose.rotation[:, 2] for pose in poses]).reshape(-1, 3),
        )

    def near(self, world_from_live: SE3) -> NDArray[np.intp]:
        """Nodes that the live camera could rightly be matched with, nearest first."""
        distance_m = np.linalg.norm(self.centres - world_from_live.translation, axis=1)
        facing = self.axes @ world_from_live.rotation[:, 2] > np.cos(LARGEST_TURN_RAD)
        rows = np.flatnonzero((distance_m < NEAR_M) & facing)
        return rows[np.argsort(distance_m[rows], kind="stable")]


class LiveDrive:
    """A held-out drive: its frames, the truth, and which of them could be found at all."""

    def __init__(self, log: Path, town: Town, config: LocaliserConfig) -> None:
        sequence = open_drive(log)
        truth = read_truth(log)
        if truth is None:
            raise SystemExit(f"{log} has no truth beside it")
        self.name = log.stem
        self.camera = sequence.camera
        self.session: SessionId = session_of_drive(sequence).id
        self.frames = [entry for entry in sequence if isinstance(entry, LoggedFrame)]
        self.truth = [truth.at(entry.frame.stamp_ns) for entry in self.frames]
        self._town = town
        self._matcher = FrameMatcher(town.opened.frames, config.matcher)
        self._findable: dict[int, bool] = {}

    def findable(self, at: int) -> bool:
        """Whether matching with all nodes that stand near finds this frame."""
        if at not in self._findable:
            pose = self.truth[at]
            assert pose is not None
            self._findable[at] = self.found_among(at, self._town.near(pose))
        return self._findable[at]

    def found_among(self, at: int, nodes: NDArray[np.intp]) -> bool:
        """Whether matching with any of these nodes finds this frame, rightly."""
        live = self.frames[at].frame
        if live.status is not FrameStatus.OK:
            return False
        graph = self._town.opened.graph
        live_id = node_id(self.session, live.stamp_ns)
        for index in nodes:
            node = graph.node(int(index)).id
            match = self._matcher.match(live, live_id, node, None)
            pose = match.reference_from_live
            if pose is None or match.inliers < FINDABLE_INLIERS or pose.distance_m > REACH_M:
                continue
            if self.error_m(at, int(index), pose) <= WRONG_M:
                return True
        return False

    def error_m(self, at: int, node: int, node_from_live: SE3) -> float:
        """Distance between a measured and the true position."""
        pose = self.truth[at]
        assert pose is not None
        measured = self._town.world_from_node[node] @ node_from_live
        return float(np.linalg.norm(measured.translation - pose.translation))


def fold_of(count: int, fold: int, seed: int) -> list[int]:
    """The held-out sessions of one of `FOLDS` folds, sizes within one (SPEC §8)."""
    order = np.random.default_rng(seed).permutation(count)
    return sorted(int(number) for number in order[fold::FOLDS])


def make_map(path: Path, logs: Sequence[Path], settings: Settings) -> None:
    """Maps the drives that the map does not hold yet."""
    for number, log in enumerate(logs):
        sequence = open_drive(log)
        with progress(f"map {number + 1} of {len(logs)}", len(sequence)) as advance:
            report = map_drive(path, sequence, settings, MAPPING, Advancing(advance))
        if report.interrupted:
            raise SystemExit(130)


def cold_start(
    town: Town, drive: LiveDrive, first: int, relocaliser: Relocaliser, budget: Budget
) -> Start:
    """Switches a robot on at one frame and drives until it is found, 10 m at most."""
    relocaliser.forget()
    opened = town.opened
    attempts, driven_m, at = 0, 0.0, first
    with Localiser(
        opened.graph,
        opened.path_memory,
        opened.frames,
        policy=POLICIES["path-near"](),
        budget=budget,
        relocaliser=relocaliser,
        basin=MatchBasin.of(drive.camera.fx, opened.basin_counts),
        live=drive.session,
    ) as localiser:
        gaps = GapFiller()
        for at in range(first, len(drive.frames)):
            odometry = drive.frames[at].odometry
            if at == first:
                odometry = OdometryStep(OdometryStatus.FIRST)
            live = drive.frames[at].frame
            localiser.move(gaps.motion(odometry, live.stamp_ns))
            found = localiser.localise(live)
            attempts += found.attempts
            driven_m = localiser.driven_m
            if found.node is not None and found.node_from_live is not None:
                node = opened.graph.index(found.node)
                error_m = drive.error_m(at, node, found.node_from_live)
                return Start(
                    drive.name, first, "found", at - first + 1, driven_m, attempts,
                    found.inliers, error_m,
                )  # fmt: skip
            if driven_m >= WITHIN_M:
                break
    possible = any(drive.findable(frame) for frame in range(first, at + 1))
    status = "possible" if possible else "impossible"
    return Start(drive.name, first, status, at - first + 1, driven_m, attempts, 0, float("nan"))


def starts_of(drive: LiveDrive, count: int) -> list[int]:
    """So many first frames, evenly spread, each with 10 m to drive behind it; all if fewer."""
    steps = [entry.odometry.prev_from_curr for entry in drive.frames]
    lengths = [0.0 if step_ is None else step_.distance_m for step_ in steps]
    left_m = np.cumsum(lengths[::-1])[::-1]
    able = np.flatnonzero(left_m >= WITHIN_M)
    rows = np.linspace(0, len(able) - 1, min(count, len(able))).round().astype(int)
    return [int(at) for at in able[rows]]


def summarise(starts: Sequence[Start], sampled: Sequence[tuple[bool, bool]]) -> str:
    """The table of the issue in words; needs at least one start.

    Args:
        starts: all of them.
        sampled: of sampled frames, whether matching near nodes and matching all nodes found them.
    """
    found = [one for one in starts if one.status == "found"]
    right = [one for one in found if not one.wrong]
    possible = len(right) + sum(one.status == "possible" for one in starts)
    at_once = sum(one.frames == 1 for one in right)
    wrong = len(found) - len(right)
    lines = [
        f"{len(starts)} cold starts, {possible} can be found within {WITHIN_M:.0f} m",
        f"found within {WITHIN_M:.0f} m: {_share(len(right), possible)} of those (must 90 %, "
        "aim 98 %)",
        f"found at the first frame: {_share(at_once, possible)}",
        f"wrong place believed (> {WRONG_M:.0f} m): {_share(wrong, len(starts))} (must < 0.1 %)",
    ]
    if right:
        errors = np.array([one.error_m for one in right])
        tries = np.array([one.attempts for one in right])
        lines.append(
            f"of the right ones: error {np.median(errors):.2f} m median, "
            f"{np.percentile(errors, 99):.2f} m p99; {np.median(tries):.0f} attempts median, "
            f"{np.percentile(tries, 90):.0f} p90"
        )
    for name in sorted({one.session for one in starts}):
        own = [one for one in starts if one.session == name]
        own_right = sum(one.status == "found" and not one.wrong for one in own)
        own_possible = own_right + sum(one.status == "possible" for one in own)
        lines.append(f"  {name}: {_share(own_right, own_possible)}, {len(own)} starts")
    if sampled:
        near, everywhere = np.array(sampled).sum(axis=0)
        lines.append(
            f"exhaustive matching of {len(sampled)} sampled frames: {near} found among the nodes "
            f"near by truth, {everywhere} among all nodes"
        )
    return "\n".join(lines)


def _share(part: int, whole: int) -> str:
    return f"{part} of {whole} ({100 * part / whole:.2f} %)" if whole else f"{part} of 0"


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
    town: Town,
    drives: Iterator[LiveDrive],
    file: Path,
    count: int,
    relocaliser: Relocaliser,
    budget: Budget,
) -> list[Start]:
    """All starts that the file does not hold yet; appends each as soon as it is done."""
    starts = read_starts(file)
    done = {(one.session, one.frame) for one in starts}
    names = [field.name for field in fields(Start)]
    with file.open("w", newline="") as rows:
        writer = csv.DictWriter(rows, names)
        writer.writeheader()
        writer.writerows(asdict(one) for one in starts)
        for drive in drives:
            firsts = starts_of(drive, count)
            with progress(drive.name, len(firsts)) as advance:
                for first in firsts:
                    if (drive.name, first) not in done:
                        starts.append(cold_start(town, drive, first, relocaliser, budget))
                        writer.writerow(asdict(starts[-1]))
                        rows.flush()
                    advance("")
    return starts


def sample_exhaustively(
    town: Town, drives: Iterator[LiveDrive], count: int
) -> list[tuple[bool, bool]]:
    """Of some frames of each drive, whether near nodes, and whether any node at all, find them."""
    everything = np.arange(len(town.opened.graph))
    return [
        (drive.findable(at), drive.found_among(at, everything))
        for drive in drives
        for at in np.linspace(0, len(drive.frames) - 1, count).astype(int).tolist()
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command_line(__doc__)
    parser.add_argument("campaign", type=Path, help="folder of frame logs with truth")
    parser.add_argument("out", type=Path, help="folder for the map and the results")
    parser.add_argument("--fold", type=int, default=0, choices=range(FOLDS))
    parser.add_argument("--seed", type=int, default=0, help="of the folds")
    parser.add_argument("--starts", type=int, default=640, help="of each drive, evenly spread")
    parser.add_argument("--relocaliser", default="fabmap")
    parser.add_argument("--lanes", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=Budget().lost_rounds)
    parser.add_argument("--sample", type=int, default=2, help="frames a drive matched with all")
    asked = parser.parse_args(arguments)

    logs = sorted(asked.campaign.glob("*.framelog"))
    if len(logs) < FOLDS:
        raise SystemExit(f"{asked.campaign} has {len(logs)} frame logs, needs at least {FOLDS}")
    held_out = fold_of(len(logs), asked.fold, asked.seed)
    mapped = [log for number, log in enumerate(logs) if number not in held_out]
    asked.out.mkdir(parents=True, exist_ok=True)
    name = f"fold{asked.fold}-seed{asked.seed}"
    settings = Settings()
    path = asked.out / f"{name}.engram"
    make_map(path, mapped, settings)
    with ExitStack() as stack:
        opened = stack.enter_context(open_map(path))
        settings = settings.for_descriptor(opened.descriptor)
        town = Town.of(opened, mapped)

        def drives() -> Iterator[LiveDrive]:
            return (LiveDrive(logs[number], town, settings.localiser) for number in held_out)

        relocaliser = relocaliser_in(opened, asked.relocaliser, settings.frontend.descriptor)
        file = asked.out / f"{name}-{asked.relocaliser}.csv"
        budget = Budget(asked.lanes, lost_rounds=asked.rounds)
        starts = run_starts(town, drives(), file, asked.starts, relocaliser, budget)
        sampled = sample_exhaustively(town, drives(), asked.sample)
    about = f"map of {len(mapped)} sessions, {len(town.world_from_node)} nodes; {asked.relocaliser}"
    text = f"{about}\n{summarise(starts, sampled)}\n"
    file.with_suffix(".txt").write_text(text)
    print(text, end="")


if __name__ == "__main__":
    main()
