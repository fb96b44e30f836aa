"""A year in one map: does it tend to a constant, and what does deleting cost?

    engram lab simulate year
    python -m engram_lab.studies.year --out results/year

The weekly drives of campaign `year` are mapped one after another, as a robot does it by default.
[L15] §II says of its predecessor that the number of experiences tends to a constant, and against
deleting that what is deleted may be needed again. So the same drives are mapped in maps that may
hold a share of the nodes that the whole map comes to, four fifths or half, and that forget after
each drive what is beyond: what serves least (`engram forget --down-to`), the drives' oldest nodes,
or any. A second run continues where the first one stopped.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engram.fleet.download.part import Stock
from engram.fleet.forgetting import bridges_over
from engram.fleet.serving import serving_order
from engram.graph.model import NodeId
from engram.maps.forgetting import Chosen
from engram.maps.map import Map
from engram.measures import failure_sums, route_not_localised
from engram.robot.mapping import MapReport
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import measured
from engram_lab.programs import command_line
from engram_lab.studies.building import build_map, write_json
from engram_lab.studies.drives import EvaluatedDrive, open_campaign
from engram_lab.studies.plan import Row, table, write_csv
from engram_lab.town.simulating import campaigns_folder

_FAR_M = 10.0
# From this drive on growth is judged: three months.
_SETTLED = 13


def random_order(stock: Stock) -> list[NodeId]:
    """Nodes in an order that says nothing, the same in every run."""
    return [stock.node_ids[at] for at in np.random.default_rng(0).permutation(len(stock))]


def newest_first(stock: Stock) -> list[NodeId]:
    """The oldest nodes last."""
    at = sorted(range(len(stock)), key=lambda k: stock.nodes[k].stamp_ns, reverse=True)
    return [stock.node_ids[k] for k in at]


def most_serving_first(stock: Stock) -> list[NodeId]:
    """As `engram forget --down-to` keeps them."""
    return [stock.node_ids[at] for at in serving_order(stock)[0].tolist()]


@dataclass(frozen=True, slots=True)
class Forgetting:
    """How a map forgets.

    Attributes:
        kept_first: its nodes in the order in which they are kept.
        share: of the whole map's last number of nodes, which it may hold.
    """

    kept_first: Callable[[Stock], list[NodeId]]
    share: float = 0.5


# None forgets nothing.
ARMS: Mapping[str, Forgetting | None] = {
    "everything kept": None,
    "a fifth forgotten, least serving": Forgetting(most_serving_first, 0.8),
    "half forgotten, least serving": Forgetting(most_serving_first),
    "half forgotten, oldest": Forgetting(newest_first),
    "half forgotten, random": Forgetting(random_order),
}


def forget_down_to(path: Path, most: int, kept_first: Callable[[Stock], list[NodeId]]) -> int:
    """Forgets nodes of a map until so many are left; how many that were."""
    with Map.open(path, writes=True) as store:
        nodes = kept_first(Stock(store))
        if len(nodes) <= most:
            return 0
        chosen = Chosen(nodes=frozenset(nodes[most:]))
        store.forget_nodes(
            chosen,
            bridges_over(store, chosen),
            author="laboratory",
            message="forget: a year",
            configuration={},
            dry_run=False,
        )
    return len(nodes) - most


@dataclass(frozen=True, slots=True)
class Year:
    """The drives of a year, and where their maps are kept."""

    drives: Sequence[EvaluatedDrive]
    folder: Path
    settings: Settings
    options: RobotOptions

    def rows(self, arm: str, most: int | None) -> list[Row]:
        """One row for each drive, in a map of all before it.

        Args:
            arm: key of `ARMS`.
            most: nodes that the map may hold after a drive; None for any number.
        """
        path = self.folder / f"{arm.replace(' ', '-')}.engram"
        kept = path.with_suffix(".rows.json")
        found: list[Row] = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else []
        for number in range(len(found), len(self.drives)):
            built = build_map(
                path,
                self.drives[: number + 1],
                self.settings,
                self.options,
                look_at=lambda drive, report: found.append(
                    {**drive_row(arm, drive, report), "forgotten": 0}
                ),
            )
            if len(found) <= number:
                raise SystemExit(f"{path} holds drives that are missing from {kept}; remove both")
            forgetting = ARMS[arm]
            if most is not None and forgetting is not None:
                found[number]["forgotten"] = forget_down_to(path, most, forgetting.kept_first)
            with Map.open(path) as store:
                one = built.sessions[number]
                found[number] |= {
                    "nodes": store.node_count(),
                    "size_bytes": store.info().size_bytes,
                    "attempts_per_frame": one.attempts / max(one.frames, 1),
                }
            write_json(kept, found)
        return found


def drive_row(arm: str, drive: EvaluatedDrive, report: MapReport) -> Row:
    """What a drive missed while it was mapped, and what it saved."""
    seen = measured(report.results)
    far_m, driven_m = failure_sums(seen, np.array([_FAR_M]))
    return {
        "arm": arm,
        "drive": drive.name,
        "driven_m": float(driven_m),
        "far_m": float(far_m[0]),
        "share_not_localised": float(route_not_localised([seen])),
        "saved": report.saved,
    }


def route_missed(rows: Sequence[Row]) -> float:
    """Share of the route of some drives that was not localised."""
    missed_m = sum(row["share_not_localised"] * row["driven_m"] for row in rows)
    return float(missed_m / sum(row["driven_m"] for row in rows))


def far_share(rows: Sequence[Row]) -> float:
    """Share of the route of some drives more than 10 m after the last match."""
    return float(sum(row["far_m"] for row in rows) / sum(row["driven_m"] for row in rows))


def quarters(rows: Sequence[Row]) -> Iterator[Row]:
    """What each arm came to, by quarters of the year."""
    for arm in dict.fromkeys(row["arm"] for row in rows):
        own = [row for row in rows if row["arm"] == arm]
        forgets = any(row["forgotten"] for row in own)
        for quarter in range(4):
            some = own[_SETTLED * quarter : _SETTLED * (quarter + 1)]
            if not some:
                continue
            driven_m = sum(row["driven_m"] for row in some)
            yield {
                "arm": arm,
                "weeks": f"{_SETTLED * quarter + 1} to {_SETTLED * quarter + len(some)}",
                "nodes saved a km": sum(row["saved"] for row in some) / driven_m * 1e3,
                "nodes": some[-1]["nodes"],
                # What is forgotten stays in the file until it is erased.
                "MB": None if forgets else some[-1]["size_bytes"] / 1e6,
                "route not localised, %": 100 * route_missed(some),
                "P(> 10 m), %": 100 * far_share(some),
                "attempts a frame": float(np.mean([row["attempts_per_frame"] for row in some])),
            }


def growth_a_month(rows: Sequence[Row]) -> float:
    """Growth of the nodes after the third month, per cent of them a month of 52 ÷ 12 weeks."""
    after = np.array([row["nodes"] for row in rows[_SETTLED - 1 :]], np.float64)
    months = (len(after) - 1) * 12 / 52
    return float(100 * ((after[-1] / after[0]) ** (1 / months) - 1)) if months > 0 else 0.0


def main() -> None:
    """Maps the year in every arm, and reports it."""
    parser = command_line(__doc__)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--campaign", default="year", help="NAME or NAME@SEED")
    parser.add_argument("--arm", dest="arms", action="append", help="one of them; repeatable")
    asked = parser.parse_args()
    settings = Settings().for_descriptor(None)
    drives = open_campaign(asked.campaign, campaigns_folder(), settings=settings).drives
    asked.out.mkdir(parents=True, exist_ok=True)
    year = Year(drives, asked.out, settings, RobotOptions())
    first, *others = ARMS
    found = year.rows(first, None)
    whole = list(found)
    for arm in others:
        forgetting = ARMS[arm]
        if forgetting is not None and (asked.arms is None or arm in asked.arms):
            found += year.rows(arm, int(forgetting.share * whole[-1]["nodes"]))
    write_csv(asked.out / "drives.csv", found)
    lines = [
        f"{len(whole)} drives of `{asked.campaign}`. Nodes grow by {growth_a_month(whole):.1f} % a "
        "month after the third month.",
        "",
        *table(list(quarters(found))),
    ]
    (asked.out / "year.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
