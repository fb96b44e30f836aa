"""Streets of equal fronts: robots on an unmapped street next to a mapped one.

    python -m engram_lab.checks.equal_fronts                     # 20, 30 and 37.5 m, three towns
    python -m engram_lab.checks.equal_fronts --first-town 601    # the same fronts in other towns
    python -m engram_lab.checks.equal_fronts --periods 25 --equal 0.8 --unique things,cars
    python -m engram_lab.checks.equal_fronts --beside 3 --starts 1 --json equal.json    # minutes

One ring of a town is mapped. Robots drive along the ring beside it, whose fronts are the same:
switched on there, or told that they are on the mapped one. Every fix is false. Then the ring alone,
and both rings, are mapped: edges between places that are more than 1 m wrong are counted. Last, a
later drive is localised on the mapped ring, from a true start. Towns are rendered if they are not
there yet, session by session: a run that was stopped continues with the next one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engram.cli.settings import read_settings
from engram.graph.model import EdgeKind
from engram.maps.map import open_map
from engram.robot.settings import Settings
from engram_lab.misplaced import FALSE_M, SURE, Kind, Street, Try
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.studies.building import GENEROUS, build_map, true_nodes
from engram_lab.studies.drives import EvaluatedDrive, drives_of
from engram_lab.town.campaigns import AGAIN, BESIDE, MAPPED, Campaign, estate
from engram_lab.town.simulating import campaign_folder, campaigns_folder, simulate
from engram_lab.town.streets import Fronts, Unique

_FIRST_TOWN = 501
PERIODS_M = (20.0, 30.0, 37.5)
_BETWEEN_PLACES = frozenset({EdgeKind.MATCH, EdgeKind.TIE})


@dataclass(frozen=True, slots=True)
class Counted:
    """Fixes of some robots.

    Attributes:
        frames: that they were shown.
        right, false: fixes.
        sure: false ones that claim a confidence above 7.
    """

    frames: int = 0
    right: int = 0
    false: int = 0
    sure: int = 0

    def __add__(self, other: Counted) -> Counted:
        return Counted(
            self.frames + other.frames,
            self.right + other.right,
            self.false + other.false,
            self.sure + other.sure,
        )


def counted(street: Street, one: Try) -> Counted:
    """Fixes of one robot."""
    total = Counted()
    for looked in street.run(one):
        found, false = looked.found, None
        if found.node is not None and found.node_from_live is not None:
            false = street.is_false(looked.frame, found.node, found.node_from_live)
        sure = false is True and found.confidence > SURE
        total += Counted(1, false is False, false is True, sure)
    return total


def wrong_edges(path: Path, drives: Sequence[EvaluatedDrive]) -> tuple[int, int]:
    """Edges between places of a map of some drives, and how many are more than 1 m wrong."""
    with open_map(path) as opened:
        true = true_nodes(opened, drives)
        wrong = []
        for edge in opened.graph.edges:
            a, b = true.pose(edge.a), true.pose(edge.b)
            if edge.kind in _BETWEEN_PLACES and a is not None and b is not None:
                error = (a.inverse() @ b).translation - edge.a_from_b.translation
                wrong.append(float(np.linalg.norm(error)) > FALSE_M)
    return len(wrong), sum(wrong)


class Estate:
    """A rendered town of equal fronts.

    Args:
        campaign: the town.
        settings: of the robots, and of those that map.
        beside: numbers of the drives on the ring that is not mapped.
    """

    def __init__(
        self, campaign: Campaign, settings: Settings, beside: Sequence[int] = tuple(BESIDE)
    ) -> None:
        simulate(campaign, campaigns_folder(), sessions=[MAPPED, AGAIN, *beside])
        self._folder = campaign_folder(campaigns_folder(), campaign)
        self._campaign, self._settings, self._beside = campaign, settings, beside
        self._maps: dict[tuple[int, ...], Path] = {}
        self.mapped = self._drive(MAPPED)

    def _drive(self, number: int) -> EvaluatedDrive:
        name = self._campaign.session(number).name
        return drives_of([self._folder / f"{name}.framelog"])[0]

    def _street(self, number: int) -> Street:
        path = self._built([MAPPED])
        return Street(path, [self.mapped], self._drive(number), self._settings, 8)

    def _built(self, numbers: Sequence[int]) -> Path:
        """A map of some drives, made again by each run: it depends on the settings."""
        if tuple(numbers) in self._maps:
            return self._maps[tuple(numbers)]
        path = self._folder / f"equal{''.join(map(str, numbers))}.engram"
        for file in self._folder.glob(f"{path.stem}.*"):
            file.unlink()
        drives = [self._drive(number) for number in numbers]
        self._maps[tuple(numbers)] = build_map(path, drives, self._settings, GENEROUS).path
        return self._maps[tuple(numbers)]

    def beside(self, kind: Kind, starts: int) -> Counted:
        """Robots that drive to the end of the unmapped ring, from so many places."""
        total = Counted()
        for number in self._beside:
            street = self._street(number)
            for first in np.linspace(0, len(street.frames), starts, endpoint=False, dtype=int):
                total += counted(street, Try(kind, int(first)))
            street.close()
        return total

    def again(self) -> Counted:
        """A robot on the mapped ring, on another day."""
        street = self._street(AGAIN)
        found = counted(street, Try(Kind.UNDISTURBED, 0))
        street.close()
        return found

    def edges(self, *, both: bool) -> tuple[int, int]:
        """Edges between places of a map of the ring, or of both; and how many are wrong."""
        numbers = [MAPPED, *(self._beside if both else [])]
        return wrong_edges(self._built(numbers), [self._drive(number) for number in numbers])


def figures(towns: Sequence[Estate], starts: int) -> Iterator[Figure]:
    """All towns together, row by row."""
    for name, kind in (("switched on", Kind.COLD), ("told another street", Kind.UNDISTURBED)):
        found = sum((town.beside(kind, starts) for town in towns), Counted())
        yield Figure(f"{name} on an unmapped street: frames", found.frames)
        yield Figure("  false fixes", found.false)
        yield Figure("  of the frames", 100 * found.false / found.frames, "%")
        yield Figure("  with confidence above 7", found.sure)
    for name, both in (("mapped ring", False), ("both rings", True)):
        edges = [town.edges(both=both) for town in towns]
        whole, wrong = (sum(column) for column in zip(*edges, strict=True))
        yield Figure(f"{name}: edges between places", whole)
        yield Figure("  more than 1 m wrong", wrong)
    found = sum((town.again() for town in towns), Counted())
    yield Figure("later drive on the mapped ring: frames", found.frames)
    yield Figure("  right fixes", 100 * found.right / found.frames, "%")
    yield Figure("  false fixes", found.false)


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--periods", default=",".join(map(str, PERIODS_M)), help="metres")
    parser.add_argument("--first-town", type=int, default=_FIRST_TOWN, help="its seed")
    parser.add_argument(
        "--beside", type=numbers, default=BESIDE, help="drives on the unmapped street: 2, 3, 5, 6"
    )
    parser.add_argument("--equal", type=float, default=1.0, help="share of equal fronts")
    parser.add_argument("--unique", default=",".join(Unique), help="what is unique")
    parser.add_argument("--starts", type=int, default=2, help="of each kind on each drive")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting")
    asked = parser.parse_args()
    unique = Unique.named(asked.unique)
    settings = read_settings(None, asked.set).of_robot()
    towns = [
        Estate(
            estate(asked.first_town + at, fronts=Fronts(float(period), asked.equal, unique)),
            settings,
            asked.beside,
        )
        for at, period in enumerate(asked.periods.split(","))
    ]
    report(figures(towns, asked.starts), asked.json, "streets of equal fronts")


if __name__ == "__main__":
    main()
