"""The interval of a download's forecast: missions in towns by weather, light and size of the map.

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
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy import stats

from engram.errors import InputError
from engram.fleet.download import DownloadOptions
from engram.fleet.download.daylight import DUSK_DEG, LOW_DEG
from engram.fleet.download.forecast import (
    ALIKE_DEG,
    BINS,
    LEVEL,
    MOST_DRIVES,
    Forecast,
    Light,
    Weather,
)
from engram.graph.sun import sun_height_deg
from engram.measures import route_not_localised
from engram.robot import RobotOptions, Settings, map_drive, open_drive
from engram_lab.town.conditions import OXFORD
from engram_lab.trial import try_downloads

NAMES = (
    "town", "drives", "mission", "weather", "apart_deg", "policy", "expected", "lost", "missed",
)  # fmt: skip
# Wider intervals promise nothing.
_WIDEST = 0.5
_FEWEST = 5
POLICIES = {
    "copy": DownloadOptions(),
    "tod": DownloadOptions("tod"),
    "budget": DownloadOptions("budget", budget_percent=50.0),
}
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


def class_of(row: Row) -> tuple[Weather, bool, bool, int]:
    """Which missions a mission is alike: a key of `INTERVALS`, and a bin; all are one if wet."""
    weather = Weather(row["weather"]) if row["weather"] in set(Weather) else Weather.DRY
    alike = float(row["apart_deg"]) <= ALIKE_DEG
    bin_of = int(np.digitize(float(row["lost"]), BINS[1:-1])) if weather is Weather.DRY else 0
    return weather, alike, int(row["drives"]) < MOST_DRIVES, bin_of


def interval(towns: Mapping[str, Sequence[float]], *, few: bool) -> tuple[float, float] | None:
    """What four in five missions of one more town miss, by those of some towns.

    The spread within a town is that of quantiles; between towns it is that of a normal prediction
    (Student's t), since a handful of them tells little of how far the next may lie. Maps of many
    drives were met in one town only, which stands for itself.
    """
    missed = [np.asarray(one) for one in towns.values()]
    if sum(map(len, missed)) < _FEWEST or (few and len(missed) < 2):
        return None
    tail = (1 - LEVEL) / 2
    means = np.array([one.mean() for one in missed])
    within = np.concatenate([one - one.mean() for one in missed])
    low, high = np.quantile(within, [tail, 1 - tail])
    between = 0.0
    if len(means) > 1:
        quantile = stats.t.ppf(1 - tail, len(means) - 1)
        between = quantile * means.std(ddof=1) * np.sqrt(1 + 1 / len(means))
    middle = means.mean()
    ends = np.clip([middle - np.hypot(low, between), middle + np.hypot(high, between)], 0, 1)
    return (float(ends[0]), float(ends[1])) if np.ptp(ends) <= _WIDEST else None


def fit(rows: Sequence[Row]) -> None:
    """Prints the table that ships, and how many missions and towns each interval rests on."""
    found: dict[tuple[Weather, bool, bool, int], dict[str, list[float]]] = {}
    for row in rows:
        towns = found.setdefault(class_of(row), {})
        towns.setdefault(row["town"], []).append(float(row["missed"]))
    for key in sorted(found):
        weather, alike, few, place = key
        ends = interval(found[key], few=few)
        count = sum(map(len, found[key].values()))
        told = "None" if ends is None else f"({ends[0]:.3f}, {ends[1]:.3f})"
        lost = f"lost {BINS[place]:g} to {BINS[place + 1]:g}" if weather is Weather.DRY else "all"
        print(f"{weather}, {'light known' if alike else 'other light'}, "
              f"{'few' if few else 'many'} drives, {lost}: "
              f"{told}  # {count} missions of {len(found[key])} towns")  # fmt: skip


def judge(rows: Sequence[Row]) -> None:
    """Prints how many missions lie within their interval, and the median width."""
    inside, widths = [], []
    for row in rows:
        weather, alike, _, _ = class_of(row)
        forecast = Forecast.of(
            float(row["expected"]), float(row["lost"]), int(row["drives"]), Light(alike)
        )
        ends = forecast.missed[weather]
        if ends is None:
            continue
        inside.append(ends[0] <= float(row["missed"]) <= ends[1])
        widths.append(100 * (ends[1] - ends[0]))
    print(f"{len(rows)} missions, {len(inside)} with a promise; {np.mean(inside):.1%} within the "
          f"{LEVEL:.0%} interval; median width {np.median(widths):.1f} points")  # fmt: skip


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
