"""Whether a map names the places and hours at which its next drives are not localised.

    python -m engram_lab.studies.weak_spots begbroke24h@2 --drives 24 --mapped 1 --maps maps

The first drives of a campaign are mapped, in the order of time. Later ones are localised and
remembered by robots that save no nodes (with `--mapped 0` they are mapped, too). After each drive
the map names weak spots, at most a tenth of the route and hours. Then the next drives are looked
at: how many of the frames that they did not localise lie in what was named, and how many of the
gaps, runs of such frames, begin there. The same command resumes.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.cli.settings import read_settings
from engram.graph.clock import hour_of_day
from engram.localiser.localisation import Localisation
from engram.maps.map import Map, open_map
from engram.robot.mapping import MapReport
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_on
from engram.weak_spots import HOURS, History, Places, WeakSpotsConfig, named, places_of, weakness_of
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.building import build_map, true_nodes, write_json
from engram_lab.studies.drives import EvaluatedDrive, campaign_logs, drives_of
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.simulating import campaigns_folder

# A frame is at the place of the node that is truly nearest, within this distance, m, and view.
_NEAR_M, _VIEW_COS = 10.0, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Which of the F frames of a drive were localised.

    Attributes:
        stamps_ns: (F,) int64.
        localised: (F,) bool.
    """

    stamps_ns: NDArray[np.int64]
    localised: NDArray[np.bool_]

    @staticmethod
    def of(results: Sequence[Localisation]) -> Outcome:
        """Of a drive's results."""
        return Outcome(
            np.array([one.stamp_ns for one in results], np.int64),
            np.array([one.localised for one in results], np.bool_),
        )

    def write(self, path: Path) -> None:
        """Keeps it as JSON."""
        write_json(path, [self.stamps_ns.tolist(), self.localised.tolist()])

    @staticmethod
    def read(path: Path) -> Outcome:
        """What `write` kept."""
        stamps_ns, localised = json.loads(path.read_text(encoding="utf-8"))
        return Outcome(np.array(stamps_ns, np.int64), np.array(localised, np.bool_))


@dataclass(frozen=True, slots=True)
class Driven:
    """A map, the drives in it, and the outcome of each.

    Attributes:
        drives: in the order of time.
        revisions: of the map after each drive.
    """

    path: Path
    drives: Sequence[EvaluatedDrive]
    revisions: Sequence[int]
    outcomes: Sequence[Outcome]


def drive_all(
    path: Path, drives: Sequence[EvaluatedDrive], mapped: int, settings: Settings
) -> Driven:
    """Maps the first drives, and remembers the others; resumes what was stopped.

    Args:
        mapped: how many are mapped; 0 for all.
    """
    kept = path.with_suffix("")
    kept.mkdir(parents=True, exist_ok=True)

    def look_at(drive: EvaluatedDrive, report: MapReport) -> None:
        Outcome.of(report.results).write(kept / f"{drive.name}.json")

    first = drives[: mapped or None]
    base = path.with_name(f"{path.stem}-base.engram") if mapped else path
    built = build_map(base, first, settings, RobotOptions(), look_at=look_at)
    revisions = [one.revision for one in built.sessions]
    if mapped and not path.exists():
        shutil.copyfile(base, path)
    for number, drive in enumerate(drives[len(first) :], start=1):
        with Map.open(path) as opened:
            known = drive.session.id in opened.sessions
        if not known:
            _remember(path, drive, drives, kept, settings)
        revisions.append(revisions[len(first) - 1] + number)
    return Driven(
        path, drives, revisions, [Outcome.read(kept / f"{one.name}.json") for one in drives]
    )


def _remember(
    path: Path, drive: EvaluatedDrive, drives: Sequence[EvaluatedDrive], kept: Path,
    settings: Settings,
) -> None:  # fmt: skip
    """Localises a drive that leaves its path and attempts, as one revision."""
    truth, log = drive.truth(), drive.log()
    assert truth is not None
    with closing(log), open_map(path) as opened:
        first = truth.at(int(log.stamps_ns[0]))
        start = None if first is None else true_nodes(opened, drives).start(first)
        with robot_on(opened, log, settings, RobotOptions(), remembers=True) as robot:
            if start is not None:
                robot.place_at(start)
            results = list(robot.drive(log))
            # Before the robot commits the drive: what the map has is then known to be kept.
            Outcome.of(results).write(kept / f"{drive.name}.json")


@dataclass(frozen=True, slots=True)
class Judged:
    """What was named, and what the next drives missed.

    Attributes:
        named: share of route and hours that was named.
        driven, missed, hit: frames of the next drives, those not localised, and those of them
            that lie in what was named.
        within: frames of the next drives in what was named.
        gaps, begun: runs of frames not localised, and those of them that begin in what was named.
    """

    named: float
    driven: int
    missed: int
    hit: int
    within: int
    gaps: int
    begun: int

    @staticmethod
    def all(parts: Sequence[Judged]) -> Judged:
        """All of them together, with the mean share named."""
        shares = [one.named for one in parts]
        names = ("driven", "missed", "hit", "within", "gaps", "begun")
        sums = (sum(getattr(one, name) for one in parts) for name in names)
        return Judged(sum(shares) / max(len(shares), 1), *sums)

    def text(self) -> str:
        """A line for people."""
        return (
            f"named {self.named:.1%}; driven {self.driven}, of these named "
            f"{_share(self.within, self.driven):.0%}; missed {self.missed}, of these named "
            f"{_share(self.hit, self.missed):.0%}; gaps {self.gaps}, of these named "
            f"{_share(self.begun, self.gaps):.0%}"
        )


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 0.0


def judge(driven: Driven, known: int, ahead: int, config: WeakSpotsConfig) -> Judged:
    """Names weak spots after so many drives, and counts in how many of the next ones they are."""
    with Map.open(driven.path, at=driven.revisions[known - 1]) as opened:
        places = places_of(opened, config)
        found = named(
            weakness_of(places, History.of(opened, places, config), config), places, config
        )
        counts = np.zeros(6, int)
        for number in range(known, min(known + ahead, len(driven.drives))):
            drive, outcome = driven.drives[number], driven.outcomes[number]
            place, hour = _cells(opened, places, driven.drives, drive, outcome)
            inside = (place >= 0) & found[np.maximum(place, 0), hour]
            missed = ~outcome.localised
            begins = missed & ~np.append(False, missed[:-1])
            counts += [
                int(one.sum()) for one in
                (np.ones_like(missed), missed, missed & inside, inside, begins, begins & inside)
            ]  # fmt: skip
    size = places.length_m @ found.sum(axis=1) / (HOURS * places.length_m.sum())
    return Judged(float(size), *counts.tolist())


def _cells(
    opened: Map, places: Places, drives: Sequence[EvaluatedDrive], drive: EvaluatedDrive,
    outcome: Outcome,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:  # fmt: skip
    """(F,) the true place of each frame, -1 without one, and its hour of day."""
    truth, nodes = drive.truth(), true_nodes(opened, drives)
    assert truth is not None
    known = [(at, nodes.pose(one.id)) for at, one in enumerate(opened.graph.nodes)]
    rows = np.array([at for at, pose in known if pose is not None], np.int64)
    poses = [pose for _, pose in known if pose is not None]
    points = np.array([one.translation for one in poses])
    ahead = np.array([one.rotation[:, 2] for one in poses])
    place = np.full(len(outcome.stamps_ns), -1, np.int64)
    hour = np.zeros(len(place), np.int64)
    for at, stamp_ns in enumerate(outcome.stamps_ns.tolist()):
        of_day, pose = hour_of_day(drive.session, stamp_ns), truth.at(stamp_ns)
        assert of_day is not None
        assert pose is not None
        hour[at] = int(of_day)
        apart_m = np.linalg.norm(points - pose.translation, axis=1)
        apart_m[ahead @ pose.rotation[:, 2] < _VIEW_COS] = np.inf
        apart_m[places.of_node[rows] < 0] = np.inf
        nearest = int(np.argmin(apart_m))
        if apart_m[nearest] <= _NEAR_M:
            place[at] = places.of_node[rows[nearest]]
    return place, hour


def main() -> None:
    """Prints what was named and missed after each drive, and all together."""
    parser = command_line(__doc__)
    parser.add_argument("campaign", metavar="NAME@SEED")
    parser.add_argument("--drives", type=int, default=24, metavar="N", help="first drives of it")
    parser.add_argument("--mapped", type=int, default=1, metavar="N", help="of these; 0: all")
    parser.add_argument("--ahead", type=int, default=4, metavar="N", help="drives looked at next")
    parser.add_argument("--from", type=int, default=2, dest="first", metavar="N",
                        help="drives in the map at first")  # fmt: skip
    parser.add_argument("--maps", type=Path, required=True, metavar="DIR")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    asked = parser.parse_args()
    settings = read_settings(None, asked.set)
    name, _, seed = asked.campaign.partition("@")
    logs = campaign_logs(campaign_named(name, int(seed or 1)), campaigns_folder())[: asked.drives]
    path = asked.maps / f"{name}-{seed or 1}-{asked.drives}-{asked.mapped}.engram"
    driven = drive_all(path, drives_of(logs), asked.mapped, settings.of_robot())
    found = []
    for known in range(asked.first, len(logs)):
        found.append(judge(driven, known, asked.ahead, settings.weak_spots))
        print(f"{known:3} drives: {found[-1].text()}", flush=True)
    pooled = Judged.all(found)
    print(f"all: {pooled.text()}")
    figures = [
        Figure("share of the frames missed in what was named", _share(pooled.hit, pooled.missed)),
        Figure("share of the gaps that begin there", _share(pooled.begun, pooled.gaps)),
        Figure("share of route and hours named", pooled.named),
        Figure("frames of the next drives not localised", pooled.missed),
    ]
    report(figures, asked.json, asked.campaign)


if __name__ == "__main__":
    main()
