"""Plants false joins in maps of the town, and counts what `engram check --geometry` finds of them.

    laps=3,13,23,33
    engram lab simulate begbroke24h --seed 2 --sessions $laps
    python -m engram_lab.checks.repair t2.engram --campaign begbroke24h@2 --plant 20

Each false join is a match that the matcher itself makes between two places that look alike, held to
what a robot with a prediction accepts: 20 inliers, a pose that is certain and within reach, and in
truth more than 5 m off. Every other one closes cycles. For the others a stretch of an experience is
cut off the map, so that the false match alone joins it.

Nothing is written into the map: the edges are planted in its graph. Right edges are those within
1 m of the truth; wrong ones that the map had itself are told apart: more than 5 m and three of
their own standard deviations off. Several maps, each with its campaign, add up.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from engram.frontend.frame import BRIEF
from engram.frontend.matching import MatcherConfig, match_frames, pair_seed
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind
from engram.localiser.acceptance import AcceptanceConfig
from engram.maps.map import Map
from engram.maps.map_frame import graph_of
from engram.places.words import vocabulary_or_default, words_of
from engram.repair.finding import RepairConfig, find_wrong_edges, is_measured
from engram.robot.mapping import map_drive
from engram.sequences.opening import open_drive
from engram_lab.bag_of_words import BagOfWords
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.drives import TrueNodes, campaign_logs, drives_of
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.simulating import campaigns_folder

# A planted match is wrong by more than this; places nearer than `_APART_M` are one place.
_WRONG_M, _APART_M, _RIGHT_M = 5.0, 12.0, 1.0
_LIKELY = 10  # look-alikes of each node that are matched
# Half the length of a stretch that is cut off, and least distance of two planted joins, metres.
_STRETCH_M, _SPACING_M = 12.0, 8.0


@dataclass
class Town:
    """A map with its truth, and what is planted in it."""

    opened: Map
    true: TrueNodes
    planted: list[Edge] = field(default_factory=list)
    dropped: set[int] = field(default_factory=set)

    def error_m(self, edge: Edge) -> float:
        """How far an edge lies from the truth; NaN where that is unknown."""
        a, b = self.true.pose(edge.a), self.true.pose(edge.b)
        if a is None or b is None:
            return float("nan")
        return (edge.a_from_b.inverse() @ (a.inverse() @ b)).distance_m


def plant(town: Town, count: int, rng: np.random.Generator) -> None:
    """Plants so many false edges; every other one joins a stretch that it cuts off.

    A stretch is cut off only where the rest still hangs together without it. The others join nodes
    of one component, so that they close cycles.
    """
    graph = town.opened.graph
    taken: list[int] = []
    cut: set[int] = set()
    for one, other, edge in _false_matches(town, rng):
        if len(town.planted) == count:
            return
        if any(_near(town, end, known) for end in (one, other) for known in taken):
            continue
        joins = len(town.planted) % 2 == 1
        stretch = _stretch(graph, other) if joins else set[int]()
        dropped = town.dropped | _edges_out_of(graph, stretch)
        gone = cut | stretch
        if {one, other} & cut or one in stretch or gone & set(taken) or cut & stretch:
            continue
        labels = _labels(graph, dropped)
        if len(set(labels)) > len(set(_labels(graph, town.dropped))) + joins:
            continue  # the rest would fall apart
        if not joins and labels[one] != labels[other]:
            continue
        town.dropped, cut = dropped, gone
        town.planted.append(edge)
        taken += [one] if joins else [one, other]


def _labels(graph: ExperienceGraph, dropped: set[int]) -> list[int]:
    """Components by the measured edges that are not left out."""
    kept = [row not in dropped and is_measured(edge.kind) for row, edge in enumerate(graph.edges)]
    a, b = graph.edge_ends[np.array(kept, np.bool_)].T
    links = coo_matrix((np.ones(len(a)), (a, b)), shape=(len(graph),) * 2)
    found: list[int] = connected_components(links, directed=False)[1].tolist()
    return found


def _false_matches(town: Town, rng: np.random.Generator) -> Iterator[tuple[int, int, Edge]]:
    """Wrong matches that would be accepted, from nodes drawn at random, without end of luck."""
    opened, graph, acceptance = town.opened, town.opened.graph, AcceptanceConfig()
    words = opened.derived(words_of, BRIEF)
    recogniser = BagOfWords(vocabulary_or_default(opened, BRIEF))
    poses = [town.true.pose(node.id) for node in graph.nodes]
    known = np.array([pose is not None for pose in poses])
    places = np.array([np.full(3, np.nan) if p is None else p.translation for p in poses])
    shown = [words.of_node(node.id) for node in graph.nodes]
    for one in shown:
        recogniser.add(np.zeros(0, np.int32) if one is None else one)
    for at in rng.permutation(len(graph)).tolist():
        if shown[at] is None or not known[at]:
            continue
        likeness = recogniser.similarities(shown[at])
        apart_m = np.linalg.norm(places - places[at], axis=1)
        likeness[~known | ~(apart_m > _APART_M)] = -1
        for like in np.argsort(-likeness)[:_LIKELY].tolist():
            a, b = graph.node(at), graph.node(like)
            frames = opened.frames.frame(a.id), opened.frames.frame(b.id)
            match = match_frames(*frames, MatcherConfig(), pair_seed(b.id, a.id))
            pose, covariance = match.reference_from_live, match.covariance
            if pose is None or covariance is None or match.inliers < acceptance.min_inliers:
                continue
            certain = np.trace(covariance[:3, :3]) <= acceptance.max_sigma_m**2
            edge = Edge(a.id, b.id, EdgeKind.MATCH, pose, covariance)
            believed = certain and pose.distance_m <= acceptance.reach_m
            if believed and town.error_m(edge) > _WRONG_M:
                yield at, like, edge


def _near(town: Town, one: int, other: int) -> bool:
    graph = town.opened.graph
    a, b = (town.true.pose(graph.node(at).id) for at in (one, other))
    return (
        a is not None
        and b is not None
        and (float(np.linalg.norm(a.translation - b.translation)) < _SPACING_M)
    )


def _stretch(graph: ExperienceGraph, node: int) -> set[int]:
    """The nodes of an experience around one of them."""
    along_m = np.abs(graph.driven_m - graph.driven_m[node])
    inside = (graph.experiences == graph.experiences[node]) & (along_m <= _STRETCH_M)
    return set(np.flatnonzero(inside).tolist())


def _edges_out_of(graph: ExperienceGraph, stretch: set[int]) -> set[int]:
    inside = np.zeros(len(graph), np.bool_)
    inside[sorted(stretch)] = True
    return set(np.flatnonzero(inside[graph.edge_ends].sum(axis=1) == 1).tolist())


@dataclass
class Tally:
    """What was found, of what there was."""

    planted: int = 0
    closing: int = 0
    found_closing: int = 0
    found_joining: int = 0
    right: int = 0
    right_taken: int = 0
    wrong_before: int = 0
    wrong_found: int = 0
    seconds: float = 0.0

    def count(self, town: Town, config: RepairConfig) -> list[str]:
        """Searches one town, and returns what was missed or wrongly taken, in words."""
        edges = town.opened.graph.edges
        kept = [edge for row, edge in enumerate(edges) if row not in town.dropped]
        graph = graph_of(town.opened.graph.nodes, [*kept, *town.planted])
        started = time.perf_counter()
        found = find_wrong_edges(graph, town.opened.path_memory, town.opened.frames, config)
        self.seconds += time.perf_counter() - started
        taken = {id(one.edge): one for one in found.wrong}
        errors_m = np.array([town.error_m(edge) for edge in kept])
        sigmas_m = np.array([np.sqrt(np.trace(edge.covariance[:3, :3])) for edge in kept])
        removed = np.array([id(edge) in taken for edge in kept], np.bool_)
        wrong = errors_m > np.maximum(_WRONG_M, 3 * sigmas_m)
        self.right += int((errors_m <= _RIGHT_M).sum())
        self.right_taken += int((removed & (errors_m <= _RIGHT_M)).sum())
        self.wrong_before += int(wrong.sum())
        self.wrong_found += int((removed & wrong).sum())
        told = [
            f"right, taken: {taken[id(kept[row])].text()} {taken[id(kept[row])].to_dict()}"
            for row in np.flatnonzero(removed & (errors_m <= _RIGHT_M)).tolist()
        ]
        known = {(one.edge.a, one.edge.b): one for one in (*found.wrong, *found.doubtful)}
        for number, edge in enumerate(town.planted):
            hit = id(edge) in taken
            self.planted += 1
            self.closing += number % 2 == 0
            self.found_closing += hit and number % 2 == 0
            self.found_joining += hit and number % 2 == 1
            if not hit:
                why = known.get((edge.a, edge.b))
                told.append(f"planted, missed ({'joins' if number % 2 else 'closes'}): "
                            f"{why.text() if why else 'not suspected'}")  # fmt: skip
        return told

    def figures(self) -> list[Figure]:
        """The counts."""
        joining = self.planted - self.closing
        return [
            Figure("planted joins", self.planted),
            Figure("found", self.found_closing + self.found_joining),
            Figure(f"  of {self.closing} that close cycles", self.found_closing),
            Figure(f"  of {joining} that join a part cut off", self.found_joining),
            Figure("right edges", self.right),
            Figure("right edges taken", self.right_taken),
            Figure("wrong edges that the maps had themselves", self.wrong_before),
            Figure("found of these", self.wrong_found),
            Figure("search", self.seconds, "s"),
        ]


def main() -> None:
    """Reads the command line."""
    parser = command_line(__doc__)
    parser.add_argument("maps", nargs="+", type=Path)
    parser.add_argument(
        "--campaign", action="append", required=True, help="NAME@SEED of each map, in turn"
    )
    parser.add_argument("--campaigns", type=Path, default=campaigns_folder())
    parser.add_argument("--plant", type=int, default=50, help="false joins in all")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    if len(asked.maps) != len(asked.campaign):
        raise SystemExit(f"{len(asked.maps)} maps and {len(asked.campaign)} campaigns")
    tally, rng = Tally(), np.random.default_rng(asked.seed)
    shares = [len(part) for part in np.array_split(np.arange(asked.plant), len(asked.maps))]
    for path, named, share in zip(asked.maps, asked.campaign, shares, strict=True):
        name, _, seed = named.partition("@")
        logs = [
            log
            for log in campaign_logs(campaign_named(name, int(seed or 1)), asked.campaigns)
            if log.with_suffix(".truth.txt").exists()
        ]
        truths = {drive.session.id: drive.truth() for drive in drives_of(logs)}
        if not path.exists():
            for log in logs:
                map_drive(path, open_drive(log))
        with Map.open(path) as opened:
            town = Town(opened, TrueNodes(opened, truths))
            plant(town, share, rng)
            for line in tally.count(town, RepairConfig()):
                print(f"{path.name}: {line}", flush=True)
    report(tally.figures(), asked.json, "repair")


if __name__ == "__main__":
    main()
