"""Protocol R: a map of an overcast day against every other condition, as RobotCar Seasons does it.

    python -m engram_lab.roads.seasons [--towns 504,505,506] [--only rain,night] [--rows roads.csv]

OpenCV's SIFT, one picture at a time. What counts is the share within 5 m and 10° and its difference
to another overcast day. Towns 504 to 506 are for judging: no light, weather or change of the town
is ever set by them. 501 to 503 judged an earlier choice.

The road's differences are those of SIFT, ratio test and NetVLAD retrieval on RobotCar Seasons'
training split, by condition.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.roads.matching import SIFT, Answer, Answers, Mapped
from engram_lab.town.rendering import Places, Visit, at

JUDGED = (504, 505, 506)
# A loop long enough for a hundred places that share little of what they see.
_LOOP_M, EVERY_M = 750.0, 7.5

MAP = Visit("map", at(7, 15, 11.0), "overcast", 15)
OVERCAST = Visit("overcast", at(7, 22, 14.0), "overcast", 22)


@dataclass(frozen=True, slots=True)
class Against:
    """A condition and what the road loses by it.

    Attributes:
        visit: when.
        road: its share within 5 m and 10° less that of an overcast day, points.
    """

    visit: Visit
    road: float


# Winter is that after the next summer: on the road, too, a year of works lay between.
CONDITIONS = tuple(
    Against(Visit(name, start, weather, day), road)
    for name, start, weather, day, road in (
        ("rain", at(7, 17, 11.0), "rain", 17, -2),
        ("snow", datetime(2025, 12, 28, 11, tzinfo=UTC), "snow", 180, -5),
        ("sun at 9 h", at(7, 16, 8.0), "clear", 16, -12),
        ("sun at 16 h", at(7, 16, 15.0), "clear", 16, -12),
        ("dusk", at(7, 20, 20.55), "fair", 20, -6),
        ("winter", datetime(2026, 12, 10, 11, tzinfo=UTC), "overcast", 500, -7),
        ("night", at(7, 21, 23.0), "fair", 21, -78),
        ("night in rain", at(7, 23, 23.0), "rain", 23, -79),
    )
)


def shares(near: NDArray[np.bool_], base: NDArray[np.bool_]) -> tuple[float, float]:
    """Difference of two shares over the same places, in points, and its bootstrapped deviation."""
    rng = np.random.default_rng(1)
    chosen = rng.integers(0, len(near), (2000, len(near)))
    drawn = near[chosen].mean(axis=1) - base[chosen].mean(axis=1)
    return 100 * float(near.mean() - base.mean()), 100 * float(drawn.std())


def figures(towns: list[int], loop_m: float, only: list[str], answers: Answers) -> Iterator[Figure]:
    """Shares of each condition, differences to overcast, and how far those are from the road's."""
    maps = {town: Mapped(SIFT, Places(town, every_m=EVERY_M, loop_m=loop_m), MAP) for town in towns}

    def seen(visit: Visit) -> list[Answer]:
        return [one for town, mapped in maps.items() for one in answers.of(town, mapped, visit)]

    base = seen(OVERCAST)
    overcast = np.array([answer.near for answer in base])
    yield Figure("places", len(base))
    yield Figure("overcast: within 5 m, 10°", 100 * float(overcast.mean()), "%")
    yield Figure("overcast: inliers", float(np.median([answer.inliers for answer in base])))
    distances = []
    for against in CONDITIONS:
        if only and against.visit.name not in only:
            continue
        found = seen(against.visit)
        near = np.array([answer.near for answer in found])
        change, deviation = shares(near, overcast)
        distances.append(abs(change - against.road))
        name = against.visit.name
        yield Figure(f"{name}: difference to overcast (road {against.road:g})", change, "points")
        yield Figure(f"{name}: its deviation over places", deviation, "points")
        yield Figure(f"{name}: inliers", float(np.median([answer.inliers for answer in found])))
    yield Figure("mean of the distances to the road", float(np.mean(distances)), "points")
    yield Figure("largest of them", float(np.max(distances)), "points")


def main() -> None:
    """Command line."""
    parser = command_line(__doc__)
    parser.add_argument("--towns", type=numbers, default=list(JUDGED))
    parser.add_argument("--loop", type=float, default=_LOOP_M, metavar="M", help="length")
    parser.add_argument("--only", type=partial(str.split, sep=","), default=[])
    parser.add_argument("--rows", type=Path, metavar="FILE", help="resumable table of all answers")
    asked = parser.parse_args()
    rows = figures(asked.towns, asked.loop, asked.only, Answers(asked.rows, "seasons"))
    report(rows, asked.json, f"towns {asked.towns}")


if __name__ == "__main__":
    main()
