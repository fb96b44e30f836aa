"""What a robot localises by condition, in a map of one clear morning and one fair night.

    python -m engram_lab.studies.conditions --maps maps --towns 22 --landmarks 600,1000
    python -m engram_lab.studies.conditions --maps maps --towns 507,508 --csv conditions.csv
    python -m engram_lab.studies.conditions --maps maps --set mapper.landmarks=0 --misplaced 15

Small towns of one loop, eleven drives each in all kinds of light and weather. Each drive that is
not in the map is localised in it by the product's robot, from a given place, once. With
`--misplaced` robots are also given a wrong place, carried off, and set down in another town.
With `--month` all drives are mapped one after another: nodes and bytes.

Frames, landmarks and odometry are those of the frame logs, so that the time of a step is that of
localising alone.
"""

from __future__ import annotations

import csv
import time
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from engram.cli.settings import read_settings
from engram.config import config_hash
from engram.frontend.frontend import FrontendConfig
from engram.geometry.se3 import SE3
from engram.maps.map import open_map
from engram.robot.settings import RobotOptions, Settings
from engram_lab.accuracy import Count
from engram_lab.programs import command_line, numbers
from engram_lab.studies.building import build_map
from engram_lab.studies.drives import EvaluatedDrive
from engram_lab.studies.plan import write_csv
from engram_lab.studies.streets import Kind, Street, Try, drives_in
from engram_lab.town.camera_model import CLEAN, Lens
from engram_lab.town.campaigns import Campaign, small_loop
from engram_lab.town.glass import Glass

_FIRST_DAY = datetime(2025, 7, 14, tzinfo=UTC)
_BEHIND_A_PANE = Lens(glass=Glass(distance_mm=40.0))
# Condition, day, UTC hour, weather, lens.
_DRIVES: tuple[tuple[str, int, float, str, Lens], ...] = (
    ("clear morning", 0, 8.5, "clear", CLEAN),
    ("overcast", 1, 11.0, "overcast", CLEAN),
    ("fair night", 1, 22.5, "fair", CLEAN),
    ("rain by day", 2, 10.0, "rain", CLEAN),
    ("rain at night", 2, 23.0, "rain", CLEAN),
    ("rain by day, 2", 4, 14.0, "rain", CLEAN),
    ("rain at night, 2", 5, 22.5, "rain", CLEAN),
    ("dusk", 6, 20.4, "fair", CLEAN),
    ("low sun", 7, 18.3, "clear", CLEAN),
    ("rain on a pane", 8, 14.0, "rain", _BEHIND_A_PANE),
    ("snow", 170, 11.0, "snow", CLEAN),
)
_LOOP_M = 200.0
_MAPPED = (0, 2)
# Drives whose robots are misplaced.
_MISPLACED = (1, 4, 5, 7)


def small_town(seed: int) -> Campaign:
    """One loop of 200 m with a drive in each condition."""
    drives = [
        (_FIRST_DAY + timedelta(days=day, hours=hour), weather, lens)
        for _, day, hour, weather, lens in _DRIVES
    ]
    return small_loop("small", seed, _LOOP_M, drives)


@dataclass(frozen=True, slots=True)
class Row:
    """One drive in one map.

    Attributes:
        right, false, off: shares of the frames that are localised; false by more than 1 m or 5°,
            off by more than 0.5 m.
        gap_m: longest distance without a right fix, metres.
        cpu_ms: processor time of a step, ms.
    """

    condition: str
    frames: int
    right: int
    false: int
    off: int
    median_mm: float
    p95_mm: float
    gap_m: float
    attempts: float
    cpu_ms: float

    def text(self) -> str:
        """A line for people."""
        return (
            f"{self.condition:18}{self.frames:5}{self.right:6}{100 * self.right / self.frames:7.1f}"
            f"{self.false:6}{self.off:5}{self.median_mm:7.0f}{self.p95_mm:6.0f}{self.gap_m:7.1f}"
            f"{self.attempts:7.1f}{self.cpu_ms:7.2f}"
        )


HEADER = (
    f"{'':18}{'frms':>5}{'right':>6}{'%':>7}{'false':>6}{'off':>5}{'mm':>7}{'95%':>6}{'gap m':>7}"
    f"{'tries':>7}{'ms':>7}"
)


def row_of(condition: str, street: Street) -> Row:
    """A robot's whole drive."""
    errors, right_at, attempts = [], [], 0
    false = off = 0
    began = time.process_time()
    looked = list(street.run(Try(Kind.UNDISTURBED)))
    cpu_s = time.process_time() - began
    for at, one in enumerate(looked):
        attempts += one.found.attempts
        fix = street.fix(at, one.frame, one.found)
        if fix is None:
            continue
        errors.append(fix.error_m)
        false += fix.false
        off += fix.error_m > 0.5
        if not fix.false:
            right_at.append(at)
    median, p95 = np.quantile(errors, [0.5, 0.95]) if errors else (np.nan, np.nan)
    return Row(
        condition,
        len(looked),
        len(right_at),
        false,
        off,
        1e3 * median,
        1e3 * p95,
        longest_gap_m(street.truth, right_at),
        attempts / len(looked),
        1e3 * cpu_s / len(looked),
    )


def longest_gap_m(world_from_cam: Sequence[SE3], localised: Sequence[int]) -> float:
    """Longest distance between localised frames, from the start and to the end too, metres."""
    at_m = np.array([pose.translation for pose in world_from_cam])
    driven_m = np.concatenate([[0.0], np.linalg.norm(np.diff(at_m, axis=0), axis=1).cumsum()])
    stops = [0.0, *driven_m[list(localised)].tolist(), float(driven_m[-1])]
    return float(np.diff(stops).max())


@dataclass(frozen=True, slots=True)
class Conditions:
    """Drives of some towns with so many landmarks, and where their maps are kept.

    Attributes:
        mapped: numbers of the drives in the map.
    """

    settings: Settings
    landmarks: int
    folder: Path
    mapped: Sequence[int] = _MAPPED

    def drives(self, seed: int) -> dict[int, EvaluatedDrive]:
        """The drives of a town by number; renders what is not there yet."""
        # Logs keep more landmarks than any robot's settings ask for.
        usual = Settings().for_descriptor(self.settings.frontend.descriptor)
        found = drives_in(small_town(seed), usual)
        return {n: replace(one, landmarks=self.landmarks) for n, one in found.items()}

    def street(self, seed: int, live: EvaluatedDrive, *, same_town: bool = True) -> Street:
        """A drive in the map of a town."""
        drives = self.drives(seed)
        path = self._map_path(seed)
        mapped = [drives[number] for number in self.mapped]
        return Street(path, mapped, live, self.settings, same_town=same_town)

    def _map_path(self, seed: int) -> Path:
        return self._path(seed, f"of-{'-'.join(map(str, self.mapped))}")

    def _path(self, seed: int, name: str) -> Path:
        self.folder.mkdir(parents=True, exist_ok=True)
        made_by = config_hash(self.settings)[:8]
        return self.folder / f"{name}-{seed}-{made_by}.engram"

    def rows(self, seed: int) -> Iterator[Row]:
        """Each drive that is not in the map."""
        drives = self.drives(seed)
        for number, (condition, *_) in enumerate(_DRIVES):
            if number in self.mapped:
                continue
            street = self.street(seed, drives[number])
            yield row_of(condition, street)
            street.close()

    def size(self, seed: int) -> tuple[int, int]:
        """Nodes and bytes of the map."""
        path = self._map_path(seed)
        with open_map(path) as opened:
            return opened.node_count(), path.stat().st_size

    def misplaced(self, seed: int, other: int, count: int) -> dict[Kind, Count]:
        """So many robots of each kind; those that start lost do so in another town's map."""
        found = {kind: Count() for kind in (Kind.MISPLACED, Kind.CARRIED, Kind.LOST)}
        own, others = self.drives(seed), self.drives(other)
        for kind in found:
            for number in _MISPLACED:
                elsewhere = kind is Kind.LOST
                live = (others if elsewhere else own)[number]
                street = self.street(seed, live, same_town=not elsewhere)
                for one in street.tries(kind, count, seed):
                    found[kind] += street.count(one)
                street.close()
        return found

    def month(self, seed: int) -> tuple[int, int, list[int]]:
        """Nodes and bytes of a map of all drives, and the nodes that each drive added."""
        drives = list(self.drives(seed).values())
        path = self._path(seed, "month")
        built = build_map(path, drives, self.settings, RobotOptions())
        nodes = [session.nodes for session in built.sessions]
        return nodes[-1], path.stat().st_size, np.diff([0, *nodes]).tolist()


def print_all(towns: Conditions, seed: int, asked: Namespace) -> None:
    """Prints what is asked of one town."""
    if not asked.no_rows:
        print(HEADER)
        rows = []
        for row in towns.rows(seed):
            print(row.text(), flush=True)
            rows.append(row)
        nodes, size = towns.size(seed)
        print(f"nodes and bytes: {nodes, size}", flush=True)
        if asked.csv is not None:
            about = {
                "town": str(seed),
                "kind": asked.kind,
                "mapped": " ".join(map(str, asked.mapped)),
            }
            add_rows(asked.csv, about, rows, {"nodes": nodes, "size_bytes": size})
    if asked.misplaced:
        other = next((one for one in asked.towns if one != seed), seed + 1)
        for kind, count in towns.misplaced(seed, other, asked.misplaced).items():
            print(
                f"{kind}: {count.robots} robots, {count.frames} frames, {count.right} right, "
                f"{count.false} false in {count.events} events, worst {count.worst_m:.1f} m",
                flush=True,
            )
    if asked.month:
        nodes, size, each = towns.month(seed)
        print(f"month: {nodes} nodes, {size / 1e6:.1f} MB, by drive {each}", flush=True)


def add_rows(
    path: Path, about: Mapping[str, str], rows: Sequence[Row], size: Mapping[str, int]
) -> None:
    """Adds the rows of one map to a table, in place of those that it has of it."""
    kept: list[dict[str, Any]] = []
    if path.exists():
        with path.open(encoding="utf-8", newline="") as file:
            kept = [one for one in csv.DictReader(file) if not about.items() <= one.items()]
    write_csv(path, [*kept, *({**about, **asdict(row), **size} for row in rows)])


def main() -> None:
    """Prints the tables."""
    parser = command_line(__doc__)
    parser.add_argument("--towns", type=numbers, default=[22])
    parser.add_argument("--landmarks", type=numbers, default=[FrontendConfig().landmarks])
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--mapped", type=numbers, default=_MAPPED, help="drives in the map")
    parser.add_argument("--kind", default="brief")
    parser.add_argument("--maps", type=Path, required=True, help="folder of the maps")
    parser.add_argument("--misplaced", type=int, default=0, metavar="N", help="of each kind")
    parser.add_argument("--month", action="store_true")
    parser.add_argument("--no-rows", action="store_true")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="adds the rows to this table")
    asked = parser.parse_args()
    for seed in asked.towns:
        for landmarks in asked.landmarks:
            changes = [
                f"frontend.descriptor={asked.kind}",
                f"frontend.landmarks={landmarks}",
                *asked.set,
            ]
            print(f"\ntown {seed}: {' '.join(changes)}", flush=True)
            settings = read_settings(None, changes).of_robot()
            towns = Conditions(settings, landmarks, asked.maps, asked.mapped)
            print_all(towns, seed, asked)


if __name__ == "__main__":
    main()
