"""The interval of a download's forecast: missions in towns by weather, light and size of the map.

    python -m engram_lab.fits.forecasts collect TOWN... --out rows.csv    # resumable
    python -m engram_lab.fits.forecasts fit rows.csv…                     # the table that ships
    python -m engram_lab.fits.forecasts judge rows.csv…                   # each town by the others
    python -m engram_lab.fits.forecasts shipped rows.csv…                 # new towns, by that table

A town is a folder of frame logs. Its drives are mapped one after another; after each, the next five
are missions: a download for date and hour is made, and the drive is localised there. The fit also
reads `lab/reports/forecast_fleet.csv`: held-out drives of the fleet study in world 5. Towns of the
fit are never judged.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError
from engram.fleet.download.coverage import (
    ALIKE_DEG,
    BINS,
    DUSK_DEG,
    INTERVALS,
    LEVEL,
    LOW_DEG,
    MOST_DRIVES,
    Interval,
    Weather,
)
from engram.fleet.download.mission import DownloadOptions
from engram.graph.clock import sun_height_deg
from engram.measures import route_not_localised
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive
from engram_lab.town.conditions import OXFORD
from engram_lab.trial import try_downloads

NAMES = (
    "town", "drives", "mission", "weather", "apart_deg", "policy", "expected", "lost", "missed",
)  # fmt: skip
# Wider intervals promise nothing; ends are whole steps, a frame or two of a short route.
_WIDEST = 0.5
_STEP = 0.005
_FEWEST = 5
# Drives after the newest of a map that are missions there.
_AHEAD = 5
POLICIES = {
    "copy": DownloadOptions(),
    "tod": DownloadOptions("tod"),
    "budget": DownloadOptions("budget", budget_percent=50.0),
}
Row = dict[str, str]
Shares: TypeAlias = NDArray[np.float64]
# Weather, whether the light is known, whether the map has few drives, and the bin of what is lost.
Class: TypeAlias = tuple[Weather, bool, bool, int]


def collect(town: Path, out: Path) -> None:
    """Missions of one town, appended to a table; known ones are not made again."""
    logs = [one for one in sorted(town.glob("*.framelog")) if "reverse" not in one.stem]
    done = {(one["town"], one["drives"], one["mission"]) for one in read([out])}
    with tempfile.TemporaryDirectory() as folder:
        centre = Path(folder) / "centre.engram"
        for count, log in enumerate(logs[:-1], start=1):
            map_drive(centre, open_drive(log), Settings(), RobotOptions())
            for mission in logs[count : count + _AHEAD]:
                if (town.name, str(count), mission.stem) not in done:
                    apart = min(abs(sun_deg(one) - sun_deg(mission)) for one in logs[:count])
                    append(out, list(missions(town, centre, count, mission, apart)))


def sun_deg(drive: Path) -> float:
    """Height of the sun on a drive, by its name: 005-0716T2300-rain-wildcat."""
    clock = drive.stem.split("-")[1]
    day = datetime.strptime(f"2025{clock}", "%Y%m%dT%H%M").replace(tzinfo=UTC)
    hour = day.hour + day.minute / 60 + OXFORD.longitude_deg / 15
    height = sun_height_deg(day.timetuple().tm_yday - 1, hour, OXFORD.latitude_deg)
    return float(np.clip(height, DUSK_DEG, LOW_DEG))


def missions(
    town: Path, centre: Path, count: int, mission: Path, apart_deg: float
) -> Iterator[Row]:
    """One drive in each kind of download."""
    for name, asked in POLICIES.items():
        try:
            (trial,) = try_downloads(
                centre, {name: asked}, [lambda: open_drive(mission)], Settings(), RobotOptions()
            )
        except InputError:
            continue  # the hour has no data
        values = (
            town.name,
            count,
            mission.stem,
            mission.stem.split("-")[2],
            f"{apart_deg:.2f}",
            name,
            f"{trial.report.expected_missed:.4f}",
            f"{trial.report.expected_missed - trial.report.copy_missed:.4f}",
            f"{route_not_localised([trial.steps]):.4f}",
        )
        yield dict(zip(NAMES, map(str, values), strict=True))


def append(out: Path, rows: Sequence[Row]) -> None:
    """Adds rows to a table; begins it with its header."""
    is_new = not out.exists()
    with out.open("a", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, NAMES)
        if is_new:
            writer.writeheader()
        writer.writerows(rows)


def read(paths: Sequence[Path]) -> list[Row]:
    """Rows of tables; of the fleet study's, those of held-out drives in downloads."""
    rows: list[Row] = []
    for path in paths:
        if path.exists():
            with path.open(encoding="utf-8", newline="") as file:
                found = list(csv.DictReader(file))
            rows += of_study(found) if found and "experiment" in found[0] else found
    return rows


def of_study(rows: Sequence[Row]) -> list[Row]:
    """Rows of the fleet study: its maps of 28 drives have the light of every hour."""
    held = [
        one
        for one in rows
        if one["map"].startswith("held out") and one["arm"] == "B" and one["expected_missed"]
    ]
    whole = {
        one["drive"]: float(one["expected_missed"]) for one in held if one["map"].endswith("copy")
    }
    made = []
    for one in held:
        expected = float(one["expected_missed"])
        values = (one["campaign"], "28", one["drive"], one["drive"].split("-")[2], "0", one["map"],
                  f"{expected:.4f}", f"{expected - whole[one['drive']]:.4f}",
                  one["share_not_localised"])  # fmt: skip
        made.append(dict(zip(NAMES, values, strict=True)))
    return made


def class_of(row: Row) -> Class:
    """Which missions a mission is alike: a key of `INTERVALS`, and a bin; all are one if wet."""
    weather = Weather(row["weather"]) if row["weather"] in set(Weather) else Weather.DRY
    alike = float(row["apart_deg"]) <= ALIKE_DEG
    bin_of = int(np.digitize(float(row["lost"]), BINS[1:-1])) if weather is Weather.DRY else 0
    return weather, alike, int(row["drives"]) < MOST_DRIVES, bin_of


def interval(towns: Mapping[str, Sequence[float]], *, few: bool) -> tuple[float, float] | None:
    """What four in five missions of one more town miss, by those of some towns.

    The narrowest interval that holds four in five, widened by what towns ask that were left out of
    it: split conformal prediction, with each town in turn as the part that calibrates. All towns
    count alike. Maps of many drives were met in one town only, which stands for itself.

    Source: Romano, Patterson and Candès, "Conformalized Quantile Regression", NeurIPS 2019.
    """
    missed = [np.asarray(one) for one in towns.values()]
    if sum(map(len, missed)) < _FEWEST or (few and len(missed) < 2):
        return None
    low, high = narrowest(missed)
    if len(missed) > 1:
        beyond = []
        for at, one in enumerate(missed):
            least, most = narrowest(missed[:at] + missed[at + 1 :])
            beyond.append(np.maximum(least - one, one - most))
        more = quantile(beyond)
        low, high = low - more, high + more
    low, high = min(low, high) / _STEP, max(low, high) / _STEP
    ends = np.clip(_STEP * np.array([np.floor(low + 1e-9), np.ceil(high - 1e-9)]), 0, 1)
    if ends[0] == ends[1]:  # all missed alike: a step to the side where there is room
        ends += (0, _STEP) if ends[0] < _STEP else (-_STEP, 0)
    return (float(ends[0]), float(ends[1])) if np.ptp(ends) <= _WIDEST else None


def narrowest(towns: Sequence[Shares]) -> tuple[float, float]:
    """Ends of the narrowest interval that holds `LEVEL` of the missions, each town as heavy."""
    values, weights = _weighed(towns)
    below = np.concatenate([[0.0], np.cumsum(weights)])
    last = np.searchsorted(below, below[:-1] + LEVEL - 1e-9) - 1
    firsts = np.flatnonzero(last < len(values))
    widths = values[last[firsts]] - values[firsts]
    first = firsts[np.argmin(widths)]
    return float(values[first]), float(values[last[first]])


def quantile(towns: Sequence[Shares]) -> float:
    """What `LEVEL` of the missions do not exceed, each town as heavy."""
    values, weights = _weighed(towns)
    place = int(np.searchsorted(np.cumsum(weights), LEVEL - 1e-9))
    return float(values[min(place, len(values) - 1)])


def _weighed(towns: Sequence[Shares]) -> tuple[Shares, Shares]:
    values = np.concatenate(towns)
    weights = np.concatenate([np.full(len(one), 1 / len(one) / len(towns)) for one in towns])
    order = np.argsort(values, kind="stable")
    return values[order], weights[order]


def classes(rows: Sequence[Row]) -> dict[Class, dict[str, list[float]]]:
    """What missions missed, by their class and town."""
    found: dict[Class, dict[str, list[float]]] = {}
    for row in rows:
        towns = found.setdefault(class_of(row), {})
        towns.setdefault(row["town"], []).append(float(row["missed"]))
    return found


def fit(rows: Sequence[Row]) -> None:
    """Prints the table that ships, and how many missions and towns each interval rests on."""
    for key, towns in sorted(classes(rows).items()):
        ends = interval(towns, few=key[2])
        told = "None" if ends is None else f"({ends[0]:.3f}, {ends[1]:.3f})"
        print(f"{_named(key)}: {told}  # {sum(map(len, towns.values()))} missions of "
              f"{len(towns)} towns")  # fmt: skip


def judge(rows: Sequence[Row]) -> None:
    """Prints how many missions lie within intervals that were fitted on the other towns."""
    promises = []
    for town in sorted({row["town"] for row in rows}):
        others = classes([row for row in rows if row["town"] != town])
        for row in (row for row in rows if row["town"] == town):
            key = class_of(row)
            promises.append((row, interval(others.get(key, {}), few=key[2])))
    _print_kept(promises)


def judge_shipped(rows: Sequence[Row]) -> None:
    """Prints how many missions of towns that the fit never met the table that ships holds."""
    promises = []
    for row in rows:
        weather, alike, few, place = class_of(row)
        table = INTERVALS.get((weather, alike, few))
        promises.append((row, None if table is None else table[place]))
    _print_kept(promises)


def _print_kept(promises: Sequence[tuple[Row, Interval | None]]) -> None:
    found: dict[Class, list[tuple[bool, float]]] = {}
    for row, ends in promises:
        if ends is not None:
            missed = float(row["missed"])
            told = (ends[0] <= missed <= ends[1], float(np.ptp(ends)))
            found.setdefault(class_of(row), []).append(told)
    for key, some in sorted(found.items()):
        print(f"{_named(key)}: {_summary(some)}")
    every = [one for some in found.values() for one in some]
    kept = _summary(every) if every else "none"
    print(f"{len(promises)} missions, {len(every)} with a promise: {kept}")


def _named(key: Class) -> str:
    weather, alike, few, place = key
    lost = f"lost {BINS[place]:g} to {BINS[place + 1]:g}" if weather is Weather.DRY else "all"
    return (
        f"{weather}, {'light known' if alike else 'other light'}, {'few' if few else 'many'} "
        f"drives, {lost}"
    )


def _summary(told: Sequence[tuple[bool, float]]) -> str:
    inside, widths = zip(*told, strict=True)
    return (
        f"{sum(inside)} of {len(inside)} within ({np.mean(inside):.1%}; {LEVEL:.0%} promised), "
        f"median width {100 * np.median(widths):.1f} points"
    )


def main() -> None:
    """Collects, fits or judges."""
    verbs = {"fit": fit, "judge": judge, "shipped": judge_shipped}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("verb", choices=("collect", *verbs))
    parser.add_argument("paths", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=Path("forecasts.csv"))
    asked = parser.parse_args()
    if asked.verb == "collect":
        for town in asked.paths:
            collect(town, asked.out)
    else:
        verbs[asked.verb](read(asked.paths))


if __name__ == "__main__":
    main()
