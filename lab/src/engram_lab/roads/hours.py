"""Protocol H: how many inliers are left of a day's map as the hours pass, in clear weather.

    python -m engram_lab.roads.hours [--towns 504,505,506] [--rows roads.csv]

The road: 512×384 pictures of a robot at the University of Toronto (3 and 9 August), matched by
features learnt on that very place (utiasASRL, deep_learned_visual_features). Its hours are met by
the height of its sun, so that Oxford's dusk stands for Toronto's. XFeat, learnt elsewhere, is held
to them: inliers against a map of 11 h, divided by those of noon.

SIFT shows what the papers tell of: a morning's map does not serve the afternoon.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.roads.matching import SIFT, Answer, Answers, Mapped, learnt
from engram_lab.roads.seasons import JUDGED
from engram_lab.town.rendering import Places, Visit, at

_LOOP_M, _EVERY_M = 150.0, 15.0
_SERVES = 20  # inliers of a frame that a map serves

_NOON = Visit("noon", at(8, 7, 12.0), "clear", 37)
_MIDDAY_MAP, _MORNING_MAP = (
    Visit(f"map of {hour:g} h", at(8, 6, hour), "clear", 36) for hour in (11.0, 8.0)
)
# Name, UTC in Oxford with the height of that hour's sun in Toronto, inliers there ÷ noon's.
_ROAD = (
    ("17 h: sun at 33 degrees", 16.0, 0.85),
    ("low sun: 18 degrees", 17.6, 0.65),
    ("dusk: 6 degrees", 19.0, 0.8),
    ("21 h: 12 degrees below", 21.3, 0.4),
    ("3 h: 20 degrees below", 1.5, 0.27),
)
_AFTER_MORNING = range(9, 19)


def _of_midday(towns: list[int], loop_m: float, answers: Answers) -> Iterator[Figure]:
    matcher = learnt()
    maps = {town: Mapped(matcher, _places(town, loop_m), _MIDDAY_MAP) for town in towns}

    def inliers(visit: Visit) -> float:
        """Median over all places."""
        return float(np.median([one.inliers for one in _seen(maps, visit, answers)]))

    noon = inliers(_NOON)
    yield Figure("XFeat: inliers at noon", noon)
    for name, hour, road in _ROAD:
        visit = Visit(name, at(8, 7, hour), "clear", 37)
        yield Figure(f"XFeat: {name}, inliers / noon's (road {road:g})", inliers(visit) / noon)


def _of_morning(towns: list[int], loop_m: float, answers: Answers) -> Iterator[Figure]:
    maps = {town: Mapped(SIFT, _places(town, loop_m), _MORNING_MAP) for town in towns}
    for hour in _AFTER_MORNING:
        visit = Visit(f"{hour} h", at(8, 7, float(hour)), "clear", 37)
        seen = _seen(maps, visit, answers)
        served = float(np.mean([one.near and one.inliers >= _SERVES for one in seen]))
        name = f"SIFT: map of 8 h, frames of {hour} h with {_SERVES} inliers"
        yield Figure(name, 100 * served, "%")


def _places(town: int, loop_m: float) -> Places:
    return Places(town, every_m=_EVERY_M, loop_m=loop_m)


def _seen(maps: dict[int, Mapped], visit: Visit, answers: Answers) -> list[Answer]:
    return [one for town, mapped in maps.items() for one in answers.of(town, mapped, visit)]


def main() -> None:
    """Command line."""
    parser = command_line(__doc__)
    parser.add_argument("--towns", type=numbers, default=list(JUDGED))
    parser.add_argument("--loop", type=float, default=_LOOP_M, metavar="M", help="length")
    parser.add_argument("--rows", type=Path, metavar="FILE", help="resumable table of all answers")
    asked = parser.parse_args()
    for protocol, what in ((_of_midday, "midday"), (_of_morning, "morning")):
        rows = protocol(asked.towns, asked.loop, Answers(asked.rows, what))
        report(rows, asked.json, f"{what}, towns {asked.towns}")


if __name__ == "__main__":
    main()
