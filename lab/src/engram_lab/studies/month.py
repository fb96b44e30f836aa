"""A month of a fleet: what does a cap on its map cost?

    engram lab simulate month
    python -m engram_lab.studies.month --out results/month

Each of ten robots copies the fleet's map in the morning, drives once at its hour, maps what the
copy does not show, and hands its map in at night. Then the fleet's map forgets what is beyond its
cap, and erases it (`engram forget --down-to BYTES --erase`). The cap is what the nodes of a map
that forgets nothing come to after ten days, or half of that. A second run continues where the first
one stopped; `--arm` runs one arm, so that others run next to it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engram.fleet.forgetting import Retention, forget_and_erase
from engram.fleet.merge.merging import merge
from engram.fleet.serving import node_bytes
from engram.maps.map import Map
from engram.maps.map_files import copy_map
from engram.robot.settings import RobotOptions, Settings
from engram_lab.programs import command_line
from engram_lab.studies.building import build_map, write_json
from engram_lab.studies.drives import EvaluatedDrive, open_campaign
from engram_lab.studies.plan import Row, table, write_csv
from engram_lab.studies.year import drive_row, far_share, route_missed
from engram_lab.town.campaigns import MONTH_ROBOTS
from engram_lab.town.simulating import campaigns_folder

# The day whose map sets the cap, and is compared with that of the last day.
_CAPPED_FROM = 10
UNCAPPED = "no cap"
# Share of the nodes' bytes after that day that a map may keep; None for all that come.
ARMS: Mapping[str, float | None] = {
    UNCAPPED: None,
    "capped to day 10": 1.0,
    "capped to half of it": 0.5,
}


@dataclass(frozen=True, slots=True)
class Month:
    """The drives of a month, and where the maps are kept."""

    drives: Sequence[EvaluatedDrive]
    folder: Path
    settings: Settings
    options: RobotOptions
    a_day: int = MONTH_ROBOTS

    def rows(self, arm: str, most_bytes: int | None) -> list[Row]:
        """One row for each drive, in the fleet's map of the morning.

        Args:
            arm: key of `ARMS`.
            most_bytes: what the nodes of the fleet's map may take after a day; None for any size.
        """
        centre = self.folder / f"{arm.replace(' ', '-')}.engram"
        kept = centre.with_suffix(".rows.json")
        found = _rows_of(centre, kept)
        for first in range(len(found), len(self.drives), self.a_day):
            tonight = centre.with_name(f"{centre.stem}.tonight.engram")
            tonight.unlink(missing_ok=True)
            if centre.exists():
                copy_map(centre, tonight)
            today = self.drives[first : first + self.a_day]
            rows = [self._driven(arm, centre, tonight, drive) for drive in today]
            if most_bytes is not None:
                cap = Retention(down_to=(most_bytes, None))
                forget_and_erase(
                    tonight, cap, author="laboratory", why="cap", erase=True, dry_run=False
                )
            evening = {"day": first // self.a_day + 1, **_size(tonight)}
            # The record first: where a run is killed between the two, the day is done again.
            write_json(kept, [*found, *({**row, **evening} for row in rows)])
            tonight.replace(centre)
            found = _rows_of(centre, kept)
        return found

    def _driven(self, arm: str, centre: Path, tonight: Path, drive: EvaluatedDrive) -> Row:
        """Maps a drive in a copy of the morning's map, and merges that into the evening's."""
        robot, rows = self.folder / f"{centre.stem}.robot.engram", list[Row]()
        _remove(robot)
        build_map(
            robot,
            [drive],
            self.settings,
            self.options,
            base=centre if centre.exists() else None,
            known=self.drives,
            look_at=lambda drive, report: rows.append(drive_row(arm, drive, report)),
        )
        (handed_in,) = merge(tonight, [robot], settings=self.settings)
        if handed_in.interrupted:
            raise KeyboardInterrupt
        _remove(robot)
        return rows[0]


def _remove(robot: Path) -> None:
    for path in (robot, robot.with_suffix(".json")):
        path.unlink(missing_ok=True)


def _rows_of(centre: Path, kept: Path) -> list[Row]:
    """The rows of the days that a fleet's map holds."""
    if not (centre.exists() and kept.exists()):
        return []
    found: list[Row] = json.loads(kept.read_text(encoding="utf-8"))
    with Map.open(centre) as store:
        return [row for row in found if row["revision"] <= store.revision]


def _size(path: Path) -> Row:
    """What the fleet's map holds at night."""
    with Map.open(path) as store:
        return {
            "revision": store.revision,
            "nodes": store.node_count(),
            "node_bytes": int(node_bytes(store.sized().sizes).sum()),
            "file_bytes": store.info().size_bytes,
        }


def cap_bytes(rows: Sequence[Row], share: float) -> int:
    """The cap: a share of what the nodes of the map that forgets nothing take after ten days."""
    return int(share * next(row["node_bytes"] for row in rows if row["day"] == _CAPPED_FROM))


def compared(rows: Sequence[Row]) -> Iterator[Row]:
    """What each arm came to: the map's size by days, and what drives missed after the tenth."""
    for arm in dict.fromkeys(row["arm"] for row in rows):
        own = [row for row in rows if row["arm"] == arm]
        after = [row for row in own if row["day"] > _CAPPED_FROM]
        if not after:
            continue
        tenth, last = (_evening(own, day) for day in (_CAPPED_FROM, own[-1]["day"]))
        yield {
            "fleet's map": arm,
            "nodes after day 10": int(tenth["nodes"]),
            f"after day {last['day']:g}": int(last["nodes"]),
            "ratio": last["nodes"] / tenth["nodes"],
            "file, MB": last["file_bytes"] / 1e6,
            "saved a drive": float(np.mean([row["saved"] for row in after])),
            "route missed after day 10, %": 100 * route_missed(after),
            "P(> 10 m), %": 100 * far_share(after),
        }


def _evening(rows: Sequence[Row], day: int) -> Row:
    return next(row for row in rows if row["day"] == day)


def main() -> None:
    """Drives the month in every arm, and reports it."""
    parser = command_line(__doc__)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--campaign", default="month", help="NAME or NAME@SEED")
    parser.add_argument("--arm", dest="arms", action="append", help="one of them; repeatable")
    asked = parser.parse_args()
    settings = Settings().for_descriptor(None)
    drives = open_campaign(asked.campaign, campaigns_folder(), settings=settings).drives
    asked.out.mkdir(parents=True, exist_ok=True)
    month = Month(drives, asked.out, settings, RobotOptions())
    found = whole = month.rows(UNCAPPED, None)
    for arm, share in ARMS.items():
        if share is not None and (asked.arms is None or arm in asked.arms):
            found = [*found, *month.rows(arm, cap_bytes(whole, share))]
    write_csv(asked.out / "drives.csv", found)
    lines = [f"{len(whole)} drives of `{asked.campaign}`.", "", *table(list(compared(found)))]
    (asked.out / "month.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
