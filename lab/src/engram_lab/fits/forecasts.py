"""The interval of a download's forecast: missions in towns by weather and size of the map.

    python -m engram_lab.fits.forecasts collect TOWN... --out rows.csv    # resumable
    python -m engram_lab.fits.forecasts fit rows.csv…                     # the table that ships
    python -m engram_lab.fits.forecasts judge rows.csv…                   # coverage and width

A town is a folder of frame logs. Its drives are mapped one after another; after each, every later
drive is a mission: a download for its date and hour is made, and the drive is localised there. The
fit also reads `lab/reports/fleet_sessions.csv`. Towns of the fit are never judged.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from engram.errors import InputError
from engram.fleet.download import DownloadOptions
from engram.fleet.download.forecast import BINS, FARTHEST_H, INTERVALS, LEVEL, MOST_DRIVES, Forecast
from engram.measures import route_not_localised
from engram.robot import RobotOptions, Settings, map_drive, open_drive
from engram_lab.trial import try_downloads

NAMES = ("town", "drives", "mission", "weather", "apart_h", "policy", "expected", "missed")
POLICIES = {
    "copy": DownloadOptions(),
    "tod": DownloadOptions("tod"),
    "budget": DownloadOptions("budget", budget_percent=50.0),
}
WET = frozenset({"rain", "showers"})
Row = dict[str, str]


def collect(town: Path, out: Path) -> None:
    """Missions of one town, appended to a table; known ones are not made again."""
    logs = sorted(town.glob("*.framelog"))
    done = {(one["town"], one["drives"], one["mission"]) for one in read([out])}
    with tempfile.TemporaryDirectory() as folder:
        centre = Path(folder) / "centre.engram"
        for count, log in enumerate(logs[:-1], start=1):
            map_drive(centre, open_drive(log), Settings(), RobotOptions())
            for mission in logs[count:]:
                if (town.name, str(count), mission.stem) not in done:
                    apart_h = min(hours_apart(one, mission) for one in logs[:count])
                    append(out, list(missions(town, centre, count, mission, apart_h)))


def hours_apart(drive: Path, mission: Path) -> float:
    """Difference in hour of day of two drives, by their names: 005-0716T2300-rain-wildcat."""
    clocks = [one.stem.split("-")[1].partition("T")[2] for one in (drive, mission)]
    hours = [int(clock[:2]) + int(clock[2:]) / 60 for clock in clocks]
    return abs((hours[0] - hours[1] + 12) % 24 - 12)


def missions(town: Path, centre: Path, count: int, mission: Path, apart_h: float) -> Iterator[Row]:
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
            f"{apart_h:.2f}",
            name,
            f"{trial.report.expected_missed:.4f}",
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
        if not path.exists():
            continue
        with path.open(encoding="utf-8", newline="") as file:
            found = list(csv.DictReader(file))
        rows += [_of_study(one) if "experiment" in one else one for one in found if _counts(one)]
    return rows


def _counts(row: Row) -> bool:
    return "experiment" not in row or (row["map"].startswith("held out") and row["arm"] == "B")


def _of_study(row: Row) -> Row:
    weather = row["drive"].split("-")[2]
    values = (row["campaign"], "28", row["drive"], weather, "0", row["map"], row["expected_missed"],
              row["share_not_localised"])  # fmt: skip
    return dict(zip(NAMES, values, strict=True))


def fit(rows: Sequence[Row]) -> None:
    """Prints quantiles of what dry missions missed, by what was expected and the map's size."""
    tail = (1 - LEVEL) / 2
    for few in (True, False):
        own = [one for one in rows if (int(one["drives"]) < MOST_DRIVES) is few]
        dry = [
            one for one in own if one["weather"] not in WET and float(one["apart_h"]) <= FARTHEST_H
        ]
        expected = np.array([float(one["expected"]) for one in dry])
        missed = np.array([float(one["missed"]) for one in dry])
        places = np.digitize(expected, BINS[1:-1])
        print("few drives:" if few else "many drives:")
        for place in range(len(BINS) - 1):
            here = missed[places == place]
            ends = np.quantile(here, [tail, 1 - tail]) if len(here) else [np.nan] * 2
            print(f"  {BINS[place]:.2f} to {BINS[place + 1]:.2f}: {ends[0]:.3f} {ends[1]:.3f} "
                  f"({len(here)} missions)")  # fmt: skip


def judge(rows: Sequence[Row]) -> None:
    """Prints how many dry missions lie within their interval, and the median width."""
    dry = [one for one in rows if one["weather"] not in WET]
    found = [
        Forecast.of(float(one["expected"]), int(one["drives"]), float(one["apart_h"]))
        for one in dry
    ]
    known = [(one, row) for one, row in zip(found, dry, strict=True) if one.known]
    inside = [one.low <= float(row["missed"]) <= one.high for one, row in known]
    widths = [100 * (one.high - one.low) for one, _ in known]
    print(f"{len(rows)} missions, {len(rows) - len(dry)} in rain or showers: no promise; of "
          f"{len(dry)} dry ones {len(dry) - len(known)} without a promise")  # fmt: skip
    print(f"within the {LEVEL:.0%} interval: {np.mean(inside):.1%}; median width "
          f"{np.median(widths):.1f} points ({len(INTERVALS)} tables)")  # fmt: skip


def main() -> None:
    """Collects, fits or judges."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("verb", choices=("collect", "fit", "judge"))
    parser.add_argument("paths", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=Path("forecasts.csv"))
    asked = parser.parse_args()
    if asked.verb == "collect":
        for town in asked.paths:
            collect(town, asked.out)
    else:
        {"fit": fit, "judge": judge}[asked.verb](read(asked.paths))


if __name__ == "__main__":
    main()
