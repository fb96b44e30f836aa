"""Weights of the rule against streets of equal fronts, and what its constant costs.

    python -m engram_lab.fits.lookalikes
    python -m engram_lab.fits.lookalikes --shipped --towns 504,505 --estates 501

Right matches are those of small towns (`engram_lab.studies.conditions`) in maps of a morning, of a
night and of both; look-alikes those of robots beside the mapped ring of an estate, all of them
false. What `Likeness` measures of them is weighed by a logistic in which every drive counts alike.
The constant is not fitted: it says how many right frames a false one is worth. The table shows, for
each, what `Run` accepts of both.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from engram.graph.model import node_id
from engram.localiser.attempts import Attempter
from engram.localiser.settings import METHOD_VERSION
from engram.localiser.yardstick import ALIKE, Likeness, LookalikeConfig, Run, Weights, Yardstick
from engram.monitor import write_whole
from engram.robot.settings import Settings
from engram_lab.fits.confidence import logistic
from engram_lab.programs import command_line, numbers
from engram_lab.studies.conditions import Conditions
from engram_lab.studies.streets import Kind, Street, Try, drives_in, towns_folder
from engram_lab.town.campaigns import BESIDE, MAPPED, estate
from engram_lab.town.streets import Fronts

# Small towns and estates on which nothing is judged; the periods of estates follow each other.
FITTED_TOWNS, FITTED_ESTATES = (511,), (511, 512)
_PERIODS_M = (20.0, 30.0)
_MAPS = ((0,), (2,), (0, 2))
# A drive in rain along the unmapped ring.
_IN_RAIN = 6
# Of ln(share), bits and ln(unevenness): that fewer landmarks, and more alike, are no sign of right.
_SIGNS = (0, -1, -1, 1)
_CONSTANTS = np.arange(-7.0, -3.9, 0.25)


@dataclass(frozen=True, slots=True)
class Seen:
    """What the accepted matches of one robot show.

    Attributes:
        driven_m: (N,) distance of each from the start, metres.
        found: N likenesses.
        frames: of the drive, accepted or not.
    """

    name: str
    alike: bool
    frames: int
    driven_m: list[float]
    found: list[Likeness]

    def accepted(self, weights: Weights, config: LookalikeConfig) -> int:
        """How many of the matches a robot with these weights accepts."""
        run, count = Run(config), 0
        for driven_m, one in zip(self.driven_m, self.found, strict=True):
            if run.due(driven_m):
                run.add(one.alike(weights), driven_m)
            count += run.believed
        return count


def seen_by(street: Street, one: Try, name: str, *, alike: bool) -> Seen:
    """What the right matches of a robot show, or all, which are false, if they are look-alikes."""
    settings, opened = street.settings, street.opened
    attempter = Attempter(opened.frames, settings.localiser)
    yardstick = Yardstick(
        opened.graph, attempter.frame, settings.localiser.matcher, settings.frontend
    )
    at_m = np.array([pose.translation for pose in street.truth])
    along_m = np.concatenate([[0.0], np.linalg.norm(np.diff(at_m, axis=0), axis=1).cumsum()])
    driven_m, found, frames = [], [], 0
    for looked in street.run(one):
        frames += 1
        best = max(
            (each for each in looked.outcomes if each.accepted),
            key=lambda each: each.confidence,
            default=None,
        )
        if best is None or best.match.reference_from_live is None:
            continue
        false = street.is_false(looked.frame, best.candidate.node, best.match.reference_from_live)
        usual, reference = (
            yardstick.usual(best.candidate.index),
            attempter.frame(best.candidate.node),
        )
        if false is not alike or usual is None or reference is None:
            continue
        live = street.frames[looked.frame].frame
        match = attempter.with_rows(live, node_id(street.live.session.id, live.stamp_ns), best)
        if len(match.live_rows):
            driven_m.append(float(along_m[looked.frame]))
            found.append(Likeness.of(match, reference, live, usual))
    attempter.close()
    return Seen(name, alike, frames, driven_m, found)


def in_towns(towns: Sequence[int], settings: Settings, folder: Path) -> Iterator[Seen]:
    """Each drive of small towns in each map that does not hold it."""
    for seed in towns:
        for mapped in _MAPS:
            there = Conditions(settings, settings.frontend.landmarks, folder, mapped)
            for number, live in there.drives(seed).items():
                if number not in mapped:
                    name = f"{seed}-{number}-in-{'-'.join(map(str, mapped))}"
                    make = partial(there.street, seed, live)
                    yield _kept(folder, name, make, Try(Kind.UNDISTURBED), alike=False)


def beside_rings(estates: Sequence[int], settings: Settings, folder: Path) -> Iterator[Seen]:
    """Robots on the unmapped ring of estates, which start lost."""
    for at, seed in enumerate(estates):
        town = estate(seed, fronts=Fronts(_PERIODS_M[at % len(_PERIODS_M)]))
        for number in (BESIDE[0], _IN_RAIN):
            drives = drives_in(town, settings, [MAPPED, number])
            path = folder / f"estate-{seed}.engram"
            make = partial(Street, path, [drives[MAPPED]], drives[number], settings, 8)
            yield _kept(folder, f"estate-{seed}-{number}", make, Try(Kind.COLD), alike=True)


def _kept(folder: Path, name: str, make: Callable[[], Street], one: Try, *, alike: bool) -> Seen:
    """What a robot has seen; kept in a file for the next run."""
    path = folder / f"{name}-{METHOD_VERSION}.json"
    if not path.exists():
        street = make()
        seen = seen_by(street, one, name, alike=alike)
        street.close()
        rows = [[m, f.share, f.more_bits, f.unevenness]
                for m, f in zip(seen.driven_m, seen.found, strict=True)]  # fmt: skip
        with write_whole(path) as draft:
            draft.write_text(json.dumps([seen.frames, rows]), encoding="utf-8")
    frames, rows = json.loads(path.read_text(encoding="utf-8"))
    return Seen(name, alike, frames, [row[0] for row in rows], [Likeness(*row[1:]) for row in rows])


def fitted(drives: Sequence[Seen]) -> Weights:
    """The weights that separate look-alikes best, every drive of either kind counting alike."""
    terms, alike, counts = [], [], []
    for kind in (False, True):
        some = [one for one in drives if one.alike is kind and one.found]
        for one in some:
            terms += [(1.0, *each.terms()) for each in one.found]
            alike += [float(kind)] * len(one.found)
            counts += [1000.0 / len(some) / len(one.found)] * len(one.found)
    weights = logistic(np.array(terms), np.array(alike), _SIGNS, np.array(counts))
    return Weights(*np.round(weights, 2).tolist())


def table(weights: Weights, drives: Sequence[Seen], config: LookalikeConfig) -> Iterator[str]:
    """By constant: right frames of each kind of drive accepted, and frames of look-alikes, %."""
    yield " constant  right %  worst %       worst drive  alike %  worst %"
    for constant in [weights.constant, *_CONSTANTS]:
        at = replace(weights, constant=float(constant))
        right = {one.name: 100 * one.accepted(at, config) / max(len(one.found), 1)
                 for one in drives if not one.alike}  # fmt: skip
        false = [100 * one.accepted(at, config) / one.frames for one in drives if one.alike]
        worst = min(right, key=lambda name: right[name])
        yield (
            f"{constant:9.2f}{np.mean(list(right.values())):9.1f}{right[worst]:9.1f}{worst:>18}"
            f"{np.mean(false):9.1f}{max(false):9.1f}"
        )


def main() -> None:
    """Prints the weights and the table."""
    parser = command_line(__doc__)
    parser.add_argument("--towns", type=numbers, default=list(FITTED_TOWNS))
    parser.add_argument("--estates", type=numbers, default=list(FITTED_ESTATES))
    parser.add_argument("--shipped", action="store_true", help="judge the weights that are shipped")
    asked = parser.parse_args()
    usual = Settings()
    config = usual.localiser.lookalikes
    undoubted = replace(
        usual, localiser=replace(usual.localiser, lookalikes=replace(config, doubt=0.0))
    )
    folder = towns_folder(usual) / "lookalikes"
    folder.mkdir(parents=True, exist_ok=True)
    drives = [
        *in_towns(asked.towns, undoubted, folder),
        *beside_rings(asked.estates, undoubted, folder),
    ]
    weights = ALIKE if asked.shipped else fitted(drives)
    print(weights)
    for line in table(weights, drives, config):
        print(line)


if __name__ == "__main__":
    main()
