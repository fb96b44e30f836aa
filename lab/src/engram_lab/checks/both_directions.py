"""Both directions of a road: what drives in either direction miss after one in each.

    python -m engram_lab.checks.both_directions SEED SESSION...     # of `longer_trial_town`
    python -m engram_lab.checks.both_directions oxford 0 1 4 7 8 9 --mapped 0,1 8,9 4,7

Of each pair of drives, one each way, a map is made, and all other drives are localised there, with
`--one-way` also in a map of the pair's first drive alone. Without `--mapped` the pair is the town's
first drive and its first against it. `--length` drives a loop of so many metres in place of the
campaign's. Drives that are not there yet are rendered.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from engram.maps.map import Map
from engram.maps.map_files import copy_map
from engram.measures import Drive, route_not_localised
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import measure
from engram.sequences.opening import open_drive
from engram_lab.intervals import Array, Interval, Resamples
from engram_lab.town.campaigns import Campaign, campaign_named
from engram_lab.town.simulating import campaigns_folder, simulate
from engram_lab.trial_towns import longer_trial_town


@dataclass(frozen=True, slots=True)
class Missed:
    """What one drive missed.

    Attributes:
        session: number of the drive.
        reverse: whether it went against the usual way.
        both: share of its route without a match, in the map of one drive each way.
        one_way: the same in a map of the usual way alone; None if that was not asked.
    """

    session: int
    reverse: bool
    both: float
    one_way: float | None


def localised(centre: Path, log: Path) -> Drive:
    """What a robot that starts lost makes of a drive."""
    with Map.open(centre) as opened:
        return measure(opened, open_drive(log), Settings(), RobotOptions())


def in_a_map_of(
    pair: Sequence[int], town: Campaign, logs: Mapping[int, Path], with_one_way: bool
) -> Iterator[Missed]:
    """Maps two drives, and localises all others."""
    with tempfile.TemporaryDirectory() as folder:
        one, both = Path(folder) / "one.engram", Path(folder) / "both.engram"
        map_drive(one, open_drive(logs[pair[0]]), Settings(), RobotOptions())
        copy_map(one, both)
        map_drive(both, open_drive(logs[pair[1]]), Settings(), RobotOptions())
        for number, log in logs.items():
            if number not in pair:
                one_way = missed(one, log) if with_one_way else None
                yield Missed(number, town.session(number).reverse, missed(both, log), one_way)


def missed(centre: Path, log: Path) -> float:
    """Share of a drive's route without a match."""
    return route_not_localised([localised(centre, log)])


def by_drive(found: Sequence[Missed], reverse: bool) -> Array:
    """(D,) what each drive of one direction missed, mean over the maps."""
    drives: dict[int, list[float]] = {}
    for one in found:
        if one.reverse == reverse:
            drives.setdefault(one.session, []).append(one.both)
    return np.array([np.mean(shares) for shares in drives.values()])


def apart(usual: Array, against: Array) -> Interval:
    """By how much more is missed against the usual direction; the interval is over drives."""
    draws = [Resamples.of(len(one), seed=at).counts for at, one in enumerate((usual, against))]
    values = draws[1] @ against / len(against) - draws[0] @ usual / len(usual)
    low, high = np.percentile(values, [5, 95])
    return Interval(float(against.mean() - usual.mean()), float(low), float(high))


def town_of(name: str) -> Campaign:
    """A campaign by its name, or the longer trial town of a seed."""
    return longer_trial_town(int(name)) if name.isdecimal() else campaign_named(name)


def of_length(town: Campaign, length_m: float | None) -> Campaign:
    """The campaign on a loop of another length: a town of its own, with the same drives."""
    if length_m is None:
        return town
    name = f"{town.name}-{length_m:.0f}m"
    return replace(town, name=name, home=name, length_m=length_m)


def pair_of(text: str) -> list[int]:
    """Two sessions, as in 0,1."""
    first, second = map(int, text.split(","))
    return [first, second]


def main() -> None:
    """Prints a line for each drive in each map, then the two directions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("town", type=town_of)
    parser.add_argument("sessions", type=int, nargs="+")
    parser.add_argument("--mapped", metavar="A,B", nargs="+", type=pair_of)
    parser.add_argument("--one-way", action="store_true")
    parser.add_argument("--length", metavar="M", type=float)
    asked = parser.parse_args()
    town: Campaign = of_length(asked.town, asked.length)
    first_against = next(one.number for one in town.sessions if one.reverse)
    pairs: list[list[int]] = asked.mapped or [[0, first_against]]
    wanted = sorted({*chain(*pairs), *asked.sessions})
    files = simulate(town, campaigns_folder(), sessions=wanted).files
    logs = dict(zip(wanted, map(Path, files), strict=True))
    found: list[Missed] = []
    for pair in pairs:
        for one in in_a_map_of(pair, town, logs, asked.one_way):
            found.append(one)
            alone = "" if one.one_way is None else f", {one.one_way:.2%} in one of the first alone"
            print(f"{town.session(one.session).name}: missed {one.both:.2%} in a map of "
                  f"{pair[0]} and {pair[1]}{alone}", flush=True)  # fmt: skip
    usual, against = by_drive(found, reverse=False), by_drive(found, reverse=True)
    more = apart(usual, against)
    print(f"the usual way {usual.mean():.2%}, against it {against.mean():.2%}: "
          f"{100 * more.estimate:+.2f} points ({100 * more.low:.2f} … "
          f"{100 * more.high:.2f})")  # fmt: skip


if __name__ == "__main__":
    main()
