"""False fixes of undisturbed robots, by how they drive: events per 100 km.

    python -m engram_lab.checks.undisturbed keble                       # 8 maps of 3 drives each
    python -m engram_lab.checks.undisturbed keble,oxford --maps 20 --drives 2 --json events.json
    python -m engram_lab.checks.undisturbed keble --mapped 0,2,6 --live 4,1 --sure 0

Of each campaign maps are built from drives drawn at random, and every other drive is driven in each
map to its end: once from its first frame, told its place, and once from a frame drawn at random,
lost. A fix is false that is more than 1 m or 5° off; false fixes less than 20 m apart are one
event. The bound is Poisson's for all events: drives that pass the same road in several maps count
each time, and the number of distinct drives is told beside it. What `--out` holds is not made
again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from engram.cli.screen import Bars
from engram.frontend.frame import BRIEF, DescriptorKind
from engram.localiser.localisation import Budget
from engram.localiser.settings import METHOD_VERSION
from engram.mapper.mapper import MapperConfig
from engram.monitor import Monitor
from engram.robot.settings import Settings
from engram_lab.misplaced import Kind, Street, Try
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.studies.drives import EvaluatedDrive, campaign_logs, drives_of
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.simulating import campaign_folder, campaigns_folder, simulate
from engram_lab.trial_towns import towns_folder

# False fixes closer than this are one event, metres.
EVENT_M = 20.0
# Reported beside what is false.
_NEAR_M = 0.5
_STARTS = (Kind.UNDISTURBED, Kind.COLD)
_LEVEL = 0.95


@dataclass(frozen=True, slots=True)
class Way:
    """Result of one robot that drove to the end of a drive.

    Attributes:
        metres: it drove.
        frames, fixes: how many, and how many of them have a fix.
        off: fixes more than 0.5 m off.
        false: fixes that are false.
        events: of false fixes.
        largest_m: the largest error of a fix.
    """

    metres: float
    frames: int
    fixes: int
    off: int
    false: int
    events: int
    largest_m: float


@dataclass(frozen=True, slots=True)
class Driven:
    """One such robot.

    Attributes:
        campaign, mapped, drive, start, kind, method, sure: what was driven, in which map, and how;
            frames that match with fewer inliers than `sure` were saved.
        way: its result.
    """

    campaign: str
    mapped: tuple[int, ...]
    drive: str
    start: str
    kind: str
    method: int
    sure: int
    way: Way

    @property
    def key(self) -> tuple[object, ...]:
        """What identifies it."""
        how = self.start, self.kind, self.method, self.sure
        return self.campaign, self.mapped, self.drive, *how

    @staticmethod
    def of(line: str) -> Driven:
        """That of a kept line."""
        one = json.loads(line)
        return Driven(**{**one, "mapped": tuple(one["mapped"]), "way": Way(**one["way"])})


def events_of(at_m: Sequence[float]) -> int:
    """How many events false fixes at these distances along a drive are; in order, metres."""
    return sum(at - before >= EVENT_M for before, at in zip([-np.inf, *at_m], at_m, strict=False))


def driven(street: Street, kind: Kind, first: int) -> Way:
    """Result of a robot that starts at a frame."""
    way = np.array([pose.translation for pose in street.truth])
    along_m = np.concatenate([[0.0], np.linalg.norm(np.diff(way, axis=0), axis=1).cumsum()])
    frames = fixes = off = 0
    false_m, largest_m = [], 0.0
    for looked in street.run(Try(kind, first)):
        frames += 1
        found = looked.found
        if found.node is None or found.node_from_live is None:
            continue
        fixes += 1
        error = street.error(looked.frame, found.node, found.node_from_live)
        if error is None:
            continue
        largest_m, off = max(largest_m, error[0]), off + (error[0] > _NEAR_M)
        if street.is_false(looked.frame, found.node, found.node_from_live):
            false_m.append(float(along_m[looked.frame]))
    metres = float(along_m[-1] - along_m[first])
    return Way(metres, frames, fixes, off, len(false_m), events_of(false_m), largest_m)


def maps_of(drives: int, maps: int, mapped: int, seed: int) -> list[tuple[int, ...]]:
    """Which drives each map is built from, in the order of time."""
    rng = np.random.default_rng(seed)
    drawn = (rng.choice(drives, mapped, replace=False).tolist() for _ in range(maps))
    return list(dict.fromkeys(tuple(sorted(one)) for one in drawn))


class Kept:
    """Lines of an earlier run; new ones are added as they come."""

    def __init__(self, path: Path) -> None:
        self._path = path
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        self._rows = {row.key: row for row in map(Driven.of, lines)}

    def get(self, key: tuple[object, ...]) -> Driven | None:
        """The stored row of a key."""
        return self._rows.get(key)

    def add(self, row: Driven) -> None:
        """Keeps one more."""
        with self._path.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(asdict(row)) + "\n")


@dataclass(frozen=True, slots=True)
class Asked:
    """How much is requested of each campaign.

    Attributes:
        maps: how many maps are drawn; one that is drawn twice counts once.
        drives: that each is built from.
        seed: of both.
        mapped: the drives of a single map instead; empty to draw.
        live: the drives that are driven there; empty for all others.
    """

    maps: int
    drives: int
    seed: int
    mapped: tuple[int, ...] = ()
    live: tuple[int, ...] = ()


def campaign_rows(
    name: str, asked: Asked, settings: Settings, kept: Kept, monitor: Monitor
) -> Iterator[Driven]:
    """All robots of a campaign; renders and maps what is not there yet."""
    campaign, folder = campaign_named(name), towns_folder(settings)
    every = range(len(campaign.sessions))
    needed = {*asked.mapped, *asked.live} if asked.live else set(every)
    simulate(campaign, folder, sessions=sorted(needed), settings=settings, monitor=monitor)
    logs = campaign_logs(campaign, folder)
    shown = drives_of([logs[k] for k in sorted(needed)])
    drives = dict(zip(sorted(needed), shown, strict=True))
    kind, sure = str(settings.frontend.descriptor), settings.mapper.sure_inliers
    drawn = maps_of(len(every), asked.maps, asked.drives, asked.seed)
    for mapped in [asked.mapped] if asked.mapped else drawn:
        path = campaign_folder(folder, campaign) / (
            f"map{'-'.join(map(str, mapped))}-{METHOD_VERSION}-{sure}.engram"
        )
        some = [drives[k] for k in mapped]
        others = [drives[k] for k in asked.live or every if k not in mapped]
        for live, start in product(others, _STARTS):
            what = (name, mapped, live.name, start.value, kind, METHOD_VERSION, sure)
            row = kept.get(what)
            if row is None:
                row = Driven(*what, _way(path, some, live, start, settings))
                kept.add(row)
            yield row


def _way(
    path: Path, mapped: Sequence[EvaluatedDrive], live: EvaluatedDrive, start: Kind,
    settings: Settings,
) -> Way:  # fmt: skip
    street = Street(path, mapped, live, settings, Budget().lost_rounds)
    rng = np.random.default_rng(live.session.start_ns)
    first = int(rng.integers(len(street.frames) // 2)) if start is Kind.COLD else 0
    try:
        return driven(street, start, first)
    finally:
        street.close()


def figures(rows: Sequence[Driven]) -> Iterator[Figure]:
    """Of all, and of each campaign."""
    for name in ("all", *dict.fromkeys(row.campaign for row in rows)):
        some = [row for row in rows if name in {"all", row.campaign}]
        km = sum(row.way.metres for row in some) / 1000
        events = sum(row.way.events for row in some)
        bound = float(chi2.ppf(_LEVEL, 2 * (events + 1)) / 2)
        yield Figure(f"{name}: driven", km, "km")
        yield Figure("  distinct drives", len({(row.campaign, row.drive) for row in some}))
        yield Figure("  maps", len({(row.campaign, row.mapped) for row in some}))
        fixes = sum(row.way.fixes for row in some)
        yield Figure("  frames with a fix", 100 * fixes / sum(row.way.frames for row in some), "%")
        yield Figure("  fixes more than 0.5 m off", sum(row.way.off for row in some))
        yield Figure("  false fixes", sum(row.way.false for row in some))
        yield Figure("  false events", events)
        yield Figure("  false events per 100 km", 100 * events / km)
        yield Figure("  their upper bound, 95 %", 100 * bound / km)
        yield Figure("  largest error of a fix", max(row.way.largest_m for row in some), "m")


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("campaigns", help="names, joined by commas")
    parser.add_argument(
        "--maps", type=int, default=8, help="drawn of each campaign; one drawn twice counts once"
    )
    parser.add_argument("--drives", type=int, default=3, help="that each map is built from")
    parser.add_argument("--seed", type=int, default=0, help="of the drives that are mapped")
    parser.add_argument("--kind", type=DescriptorKind, default=BRIEF, help="of features")
    parser.add_argument("--mapped", type=numbers, default=[], help="drives of one map instead")
    parser.add_argument("--live", type=numbers, default=[], help="drives that are driven there")
    parser.add_argument(
        "--sure", type=int, default=MapperConfig().sure_inliers, help="mapper.sure_inliers"
    )
    parser.add_argument("--out", type=Path, default=campaigns_folder() / "undisturbed.jsonl")
    given = parser.parse_args()
    if given.live and not given.mapped:
        parser.error("--live needs --mapped")
    plain = Settings().for_descriptor(given.kind)
    settings = replace(plain, mapper=replace(plain.mapper, sure_inliers=given.sure))
    which = tuple(given.mapped), tuple(given.live)
    asked, kept, rows = Asked(given.maps, given.drives, given.seed, *which), Kept(given.out), []
    for name in given.campaigns.split(","):
        for row in campaign_rows(name, asked, settings, kept, Bars()):
            rows.append(row)
            what = f"{row.campaign} {row.mapped} {row.drive} {row.start}"
            came = f"{row.way.fixes} fixes, {row.way.false} false, {row.way.largest_m:.2f} m"
            print(f"{what}: {row.way.metres:.0f} m, {came}", flush=True)
    report(figures(rows), given.json, "false fixes of undisturbed robots")


if __name__ == "__main__":
    main()
