"""Attempts of lost robots at places where they are not: how many would be accepted.

    python -m engram_lab.checks.wrong_places                      # 10^6 attempts, held-out towns
    python -m engram_lab.checks.wrong_places --towns 401,402,403,404 --every 1 --json wrong.json

Frames of each drive are matched with every node of each map: with all of another town's, and with
those 15 m or more away in their own. What is there in `--out` is not made again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from engram.localiser.settings import METHOD_VERSION
from engram.robot.settings import Settings
from engram_lab.misplaced import Street, WrongPlaces
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.town.simulating import campaigns_folder
from engram_lab.trial_towns import HELD_OUT_TOWNS, town_pairs

# Matches of so many inliers are wrong, and would be fixes near a prediction by the published rule.
_MANY = 20


@dataclass(frozen=True, slots=True)
class Tried:
    """All attempts of one drive in one map.

    Attributes:
        street, every, method: what was tried, and how.
        same_town: whether the map is of the drive's town.
        attempts: how many.
        many: of those with a false pose and 20 inliers or more.
        accepted: of those believed.
        waiting: of those that a second match would confirm.
        most: most log-odds that one had.
    """

    street: str
    every: int
    method: int
    same_town: bool
    attempts: int
    many: int
    accepted: int
    waiting: int
    most: float

    @staticmethod
    def of(name: str, street: Street, every: int) -> Tried:
        """Makes the attempts."""
        places = WrongPlaces(street, every)
        found = [place.outcome for place in places.lost()]
        return Tried(
            name,
            every,
            METHOD_VERSION,
            street.same_town,
            places.attempts,
            sum(one.match.inliers >= _MANY for one in found),
            sum(one.accepted for one in found),
            sum(one.plausible and not one.accepted for one in found),
            max((one.confidence for one in found), default=-100.0),
        )


def figures(rows: list[Tried]) -> Iterator[Figure]:
    """Of the drive's own town, and of others."""
    for name, same in (("same town, 15 m away or more", True), ("another town", False)):
        some = [row for row in rows if row.same_town is same]
        yield Figure(f"{name}: attempts", sum(row.attempts for row in some))
        yield Figure("  false, 20 inliers or more", sum(row.many for row in some))
        yield Figure("  accepted", sum(row.accepted for row in some))
        yield Figure("  waiting for a second", sum(row.waiting for row in some))
        yield Figure("  most log-odds", max((row.most for row in some), default=-100.0))


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--towns", type=numbers, default=list(HELD_OUT_TOWNS))
    parser.add_argument("--every", type=int, default=10, help="frames from one to the next")
    parser.add_argument("--out", type=Path, default=campaigns_folder() / "wrong_places.jsonl")
    asked = parser.parse_args()
    known = {}
    if asked.out.exists():
        kept = map(json.loads, asked.out.read_text(encoding="utf-8").splitlines())
        known = {(one["street"], one["every"], one["method"]): Tried(**one) for one in kept}
    rows = []
    with asked.out.open("a", encoding="utf-8") as lines:
        for name, street in town_pairs(asked.towns, Settings()):
            key = (name, asked.every, METHOD_VERSION)
            if key not in known:
                known[key] = Tried.of(name, street, asked.every)
                lines.write(json.dumps(asdict(known[key])) + "\n")
                lines.flush()
            rows.append(known[key])
            street.close()
    report(figures(rows), asked.json, "wrong places that a lost robot would believe")


if __name__ == "__main__":
    main()
