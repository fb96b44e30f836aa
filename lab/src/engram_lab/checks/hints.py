"""Robots that are given a wrong place of their own town, or carried there unseen.

    python -m engram_lab.checks.hints                         # held-out towns, 3,000 tries
    python -m engram_lab.checks.hints --tries 300 --json hints.json
    python -m engram_lab.checks.hints --towns 401 --kinds told

Each try counts the 40 frames after a robot is told a place 15 m or more off (σ 0.1, 1 or 3 m), or
carried there, with the budget that robots have by default. A fix is false that is more than 1 m or
5° off. The towns are rendered once; tries that are in `--out` are not made again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from engram.frontend.frame import BRIEF, DescriptorKind
from engram.localiser.localisation import Budget
from engram.localiser.settings import METHOD_VERSION
from engram.monitor import QUIET
from engram.robot.settings import Settings
from engram_lab.misplaced import FALSE_M, FALSE_RAD, Kind, Street, Try
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.trial_towns import HELD_OUT_TOWNS, streets, towns_folder

KINDS = {"told": Kind.TOLD, "carried": Kind.CARRIED, "gap": Kind.GAP, "lost": Kind.LOST}


@dataclass(frozen=True, slots=True)
class Came:
    """Result of one try.

    Attributes:
        street: the map and the drive.
        kind, first, sigma_m, seed: the try.
        fixes: frames that were localised.
        false: of those more than 1 m or 5° off.
        worst_m: largest error of a fix.
        again: number of the first frame with a right fix; None if none.
    """

    street: str
    kind: str
    first: int
    sigma_m: float
    seed: int
    fixes: int
    false: int
    worst_m: float
    again: int | None

    @property
    def key(self) -> tuple[str, str, int, float, int]:
        """What identifies it."""
        return self.street, self.kind, self.first, self.sigma_m, self.seed


def outcome(name: str, street: Street, one: Try) -> Came:
    """Makes one try."""
    errors, again = [], None
    for number, looked in enumerate(looked for looked in street.run(one) if looked.counts):
        found = looked.found
        if found.node is None or found.node_from_live is None:
            continue
        error = street.error(looked.frame, found.node, found.node_from_live)
        if error is not None:
            errors.append(error)
            if again is None and not _is_false(error):
                again = number
    worst_m = max((error[0] for error in errors), default=0.0)
    false = sum(map(_is_false, errors))
    return Came(name, *one.key, len(errors), false, worst_m, again)


def _is_false(error: tuple[float, float]) -> bool:
    return error[0] > FALSE_M or error[1] > FALSE_RAD


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--kind", type=DescriptorKind, default=BRIEF, help="of features")
    parser.add_argument("--towns", type=numbers, default=list(HELD_OUT_TOWNS))
    parser.add_argument("--tries", type=int, default=3000)
    parser.add_argument("--kinds", default="told,carried")
    parser.add_argument("--lost-rounds", type=int, default=Budget().lost_rounds)
    parser.add_argument("--out", type=Path, help="where tries are kept")
    asked = parser.parse_args()
    settings = Settings().for_descriptor(asked.kind)
    kinds = [KINDS[name] for name in asked.kinds.split(",")]
    out = asked.out or towns_folder(settings) / f"hints-{METHOD_VERSION}.jsonl"
    known = _known(out)
    places = list(streets(asked.towns, settings, asked.lost_rounds, QUIET))
    per_street = -(-asked.tries // (len(places) * len(kinds)))
    done: list[Came] = []
    with out.open("a", encoding="utf-8") as lines:
        for name, street in places:
            for kind in kinds:
                for one in street.tries(kind, per_street, seed=1):
                    key = (name, *one.key)
                    if key not in known:
                        known[key] = outcome(name, street, one)
                        lines.write(json.dumps(asdict(known[key])) + "\n")
                        lines.flush()
                    done.append(known[key])
            street.close()
    report(figures(done), asked.json, "robots told a wrong place or carried there")


def _known(path: Path) -> dict[tuple[str, str, int, float, int], Came]:
    """Tries of earlier runs."""
    if not path.exists():
        return {}
    rows = [Came(**json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]
    return {row.key: row for row in rows}


def figures(rows: list[Came]) -> Iterator[Figure]:
    """All tries, then each kind and each street."""
    for name, some in _groups(rows):
        again = [row.again for row in some if row.again is not None]
        yield Figure(f"{name}: tries", len(some))
        yield Figure("  with false fixes", sum(row.false > 0 for row in some))
        yield Figure("  false fixes", sum(row.false for row in some))
        yield Figure("  largest error of a fix", max(row.worst_m for row in some), "m")
        yield Figure("  found again", 100 * len(again) / len(some), "%")
        yield Figure("  after (median)", float(np.median(again)) if again else np.nan, "frames")


def _groups(rows: list[Came]) -> Iterator[tuple[str, list[Came]]]:
    yield "all", rows
    for kind in dict.fromkeys(row.kind for row in rows):
        yield kind, [row for row in rows if row.kind == kind]
    for street in dict.fromkeys(row.street for row in rows):
        yield street, [row for row in rows if row.street == street]


if __name__ == "__main__":
    main()
