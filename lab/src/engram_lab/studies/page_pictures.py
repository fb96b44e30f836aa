"""The pictures of docs that `engram_lab.studies.pages` draws: from tables, or from a made map."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from engram.graph.graph import ExperienceGraph
from engram.ranking.context import RankingContext
from engram.ranking.policies import policy_named
from engram.testing.contracts import make_context, make_node
from engram.viewing.drawings import GOOD, LOST, PALETTE
from engram_lab.studies import paper_figures
from engram_lab.studies.paper_figures import Row, read

_GREY = "#999999"


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture of a page.

    Attributes:
        source: digest of what it shows; a file that remembers another one is drawn again.
    """

    source: str
    draw: Callable[[], Figure]

    @staticmethod
    def of_tables(tables: Sequence[Path], draw: Callable[..., Figure]) -> Picture:
        """Drawn from the rows of tables."""
        return Picture(content_of(*tables), lambda: draw(*(read(one) for one in tables)))


def content_of(*tables: Path) -> str:
    """What a picture remembers of its tables."""
    return _digest(b"".join(one.read_bytes() for one in tables))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def pictures(tables: Path) -> dict[str, Picture]:
    """Each picture by name; none of what was not measured."""
    drawn = {**paper_figures.DRAWN, "eyes": (("eyes/eyes.csv",), eyes)}
    found = {
        name: Picture.of_tables([tables / one for one in some], draw)
        for name, (some, draw) in drawn.items()
        if all((tables / one).exists() for one in some)
    }
    orders = [order_by_policy(policy) for policy in POLICIES]
    return {**found, "ranking": Picture(_digest(repr(orders).encode()), partial(ranking, orders))}


KINDS = ("brief", "net")
_MARKS = ("o", "s")


def eyes(rows: Sequence[Row]) -> Figure:
    """Places that each kind of features matches, by the two conditions."""
    seen: dict[str, list[Row]] = {}
    for row in rows:
        if row["where"] == "towns 1, 4" and " / " in row["what"] and row["kind"] in KINDS:
            seen.setdefault(row["what"], []).append(row)
    # The greatest gain comes first, which is the top.
    pairs = sorted(seen, key=lambda what: _gain(seen[what]))
    figure = Figure(figsize=(5.6, 3.2), layout="constrained")
    axes = figure.add_subplot()
    for place, what in enumerate(pairs):
        counts = [int(row["value"]) for row in seen[what]]
        axes.plot(counts, [place] * len(counts), color=_GREY, linewidth=1.5, zorder=1)
    for number, kind in enumerate(KINDS):
        counts = [int(seen[what][number]["value"]) for what in pairs]
        axes.scatter(
            counts,
            range(len(pairs)),
            # The square stands round the circle where both match as many.
            s=(30, 75)[number],
            marker=_MARKS[number],
            facecolor=(PALETTE[number], "none")[number],
            edgecolor=PALETTE[number],
            linewidth=1.8,
            label=kind,
            zorder=2 + number,
        )
    of = next(iter(seen.values()))[0]["of"]
    axes.set_yticks(range(len(pairs)), pairs)
    axes.set_xlim(0, int(of) + 2)
    axes.set_xlabel(f"places that match, of {of}")
    axes.grid(axis="x", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower left")
    return figure


def _gain(rows: Sequence[Row]) -> int:
    """How many places more the last kind matches than the first."""
    return int(rows[-1]["value"]) - int(rows[0]["value"])


# A road that three drives saved, one node a metre each; and how far apart in passing they drove.
POLICIES = ("distance", "path", "recall")
DRIVES = {"in the sun": 0.1, "in rain": 0.35, "at night": -0.3}
_METRES = range(-5, 3)
_NEAR = (-1, 0, 1)
# A robot in rain comes along: what it attempted on the last metres, and what matched.
TRIED = (
    (-5, "in the sun", False),
    (-5, "in rain", True),
    (-4, "in rain", True),
    (-3, "in the sun", False),
    (-3, "in rain", True),
    (-2, "in rain", True),
)
# Past drives that kept to each experience.
_PAST = {"in the sun": 3, "in rain": 2, "at night": 2}


@dataclass(frozen=True, slots=True)
class RankedNode:
    """A candidate of the made road: its drive, metres ahead of the robot, place in the order."""

    drive: str
    ahead_m: float
    place: int


def order_by_policy(policy: str) -> list[RankedNode]:
    """The candidates of the made road in the order of a policy."""
    order = policy_named(policy).rank(_made_context())
    candidates = [(drive, metre) for drive in DRIVES for metre in _NEAR]
    return [
        RankedNode(drive, metre + DRIVES[drive], place)
        for place, (drive, metre) in enumerate((candidates[row] for row in order), 1)
    ]


def _made_context() -> RankingContext:
    graph = ExperienceGraph()
    for number in range(len(DRIVES)):
        for metre in range(len(_METRES)):
            graph.add_node(make_node(number, metre))
    drives = list(DRIVES)

    def node(drive: str, metre: int) -> int:
        return drives.index(drive) * len(_METRES) + metre - _METRES.start

    return make_context(
        graph=graph,
        paths=[
            [node(drive, metre) for metre in _METRES]
            for drive, times in _PAST.items()
            for _ in range(times)
        ],
        candidates=[node(drive, metre) for drive in DRIVES for metre in _NEAR],
        along_m=[metre + aside for aside in DRIVES.values() for metre in _NEAR],
        observed=[node(drive, metre) for metre, drive, _ in TRIED],
        outcomes=[matched for *_, matched in TRIED],
        reference=node("in rain", -2),
        run=[(float(metre), node(drive, metre), 0.9, matched) for metre, drive, matched in TRIED],
    )


def ranking(orders: Sequence[Sequence[RankedNode]]) -> Figure:
    """The candidates of the made road, numbered as each policy attempts them."""
    figure = Figure(figsize=(7.2, 5.0), layout="constrained")
    every = figure.subplots(len(orders), sharex=True)
    for axes, policy, order in zip(every, POLICIES, orders, strict=True):
        _draw_road(axes)
        for one in order:
            _number(axes, one)
        axes.set_title(policy, loc="left", family="monospace", fontsize=10)
    every[-1].set_xlabel("metres ahead of the robot")
    handles, labels = every[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels), frameon=False)
    return figure


def _draw_road(axes: Axes) -> None:
    """Three drives, the robot, and what it attempted."""
    rows = {drive: -number for number, drive in enumerate(DRIVES)}
    for drive, row in rows.items():
        at_m = [metre + DRIVES[drive] for metre in _METRES]
        axes.plot(at_m, [row] * len(at_m), color=_GREY, marker=".", linewidth=1, zorder=1)
    axes.axvline(0, color="black", linestyle="--", linewidth=1, label="robot", zorder=0)
    for matched, mark, colour, words in (
        (True, "P", GOOD, "matched just now"),
        (False, "X", LOST, "failed just now"),
    ):
        some = [
            (metre + DRIVES[drive], rows[drive]) for metre, drive, took in TRIED if took is matched
        ]
        ahead_m, at = zip(*some, strict=True)
        axes.scatter(ahead_m, at, marker=mark, s=90, color=colour, label=words, zorder=2)
    axes.set_yticks([*rows.values()], [*rows])
    axes.set_ylim(-len(rows) + 0.4, 0.6)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)


def _number(axes: Axes, one: RankedNode) -> None:
    """A candidate with its place; those that two lanes in one round attempt are filled."""
    first = one.place <= 2
    at = one.ahead_m, -list(DRIVES).index(one.drive)
    axes.scatter(
        *at, s=190, facecolor=PALETTE[0] if first else "white", edgecolor=PALETTE[0], zorder=3
    )
    colour = "white" if first else PALETTE[0]
    axes.annotate(
        str(one.place), at, ha="center", va="center_baseline", color=colour, fontsize=9, zorder=4
    )
