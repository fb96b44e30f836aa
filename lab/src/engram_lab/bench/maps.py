"""Stages on made-up maps: opening one, ranking its nodes, recognising its places."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import BRIEF
from engram.geometry.se3 import SE3
from engram.graph.model import Edge, EdgeKind, Node, PathEntry, PathEntryKind, path_id
from engram.graph.neighbourhood import Search
from engram.graph.paths import Attempts, PathMemory
from engram.localiser.settings import LocaliserConfig
from engram.maps.map import Map
from engram.maps.writer import RevisionWriter
from engram.places.recognisers import FabMap, FabMapConfig, ObservationModel
from engram.places.vocabulary import (
    TrainingConfig,
    TreeArrays,
    Vocabulary,
    WordStatistics,
    train_vocabulary,
)
from engram.ranking.context import RankingContext
from engram.ranking.policies import policy_named
from engram.robot.localisers import lessons_of
from engram_lab.bench.data import BenchData
from engram_lab.bench.stage import PlainPipeline, Prepared
from engram_lab.bench.synthetic import SyntheticPlace
from engram_lab.synthetic_places import (
    CAMERA,
    DESCRIPTOR,
    FRONTEND,
    drive_of,
    landmark_bytes,
    node_of,
    stored,
)

SESSIONS, SESSION_NODES, EDGES, ATTEMPTS = 8, 500, 31_584, 183_637
_SIGMA = np.diag([0.01**2] * 3 + [0.002**2] * 3)
_STORED = 20  # of a node: opening reads none of them


def prepare_opening(data: BenchData, plain: PlainPipeline | None) -> Prepared:
    """Open the map and read what a localiser needs at one place: graph, paths and lessons."""
    del data, plain
    folder = tempfile.TemporaryDirectory(prefix="engram-bench-")  # lives as long as `ours`
    write_map(Path(folder.name) / "many.engram")

    def ours(_: int) -> dict[str, int]:
        with Map.open(Path(folder.name) / "many.engram") as store:
            graph, config = store.read_graph(), LocaliserConfig()
            at, around = SESSION_NODES // 2, Search(config.search_radius_m, np.pi)
            near = graph.neighbourhood(at, SE3.identity(), _SIGMA, around)
            lessons = lessons_of(store, CAMERA.fx, config.basin, config.lessons)[1]
            lessons.log_odds_of(near.nodes)
            PathMemory(graph, pages=store.pages).co_occurrence(near.nodes, near.nodes)
            return {"nodes": len(graph), "candidates": len(near.nodes)}

    return Prepared(ours)


def write_map(path: Path) -> None:
    """Eight drives along one street, tied to each other as mapping and merging tie them."""
    rng = np.random.default_rng(0)
    blob = landmark_bytes(rng, None, _STORED)
    with (
        Map.create(path) as store,
        store.begin_revision(author="bench", message="made up", configuration={}) as writer,
    ):
        drives = [_write_drive(writer, number, blob) for number in range(SESSIONS)]
        nodes = [node for drive in drives for node in drive]
        left = EDGES - SESSIONS * (SESSION_NODES - 1)
        for a, b in _pairs(rng, left):
            metres = float(b % SESSION_NODES - a % SESSION_NODES)
            pose = SE3.exp([0.1, 0.0, metres, 0.0, 0.01, 0.0])
            writer.add_edge(Edge(nodes[a].id, nodes[b].id, EdgeKind.PROXIMITY, pose, _SIGMA))
        each = np.diff(np.linspace(0, ATTEMPTS, SESSIONS + 1).astype(int))
        for number, count in enumerate(each):
            session = nodes[number * SESSION_NODES].session
            writer.copy_attempts(session, _attempts(rng, count), [node.id for node in nodes])
        writer.commit()


def _write_drive(writer: RevisionWriter, number: int, blob: bytes) -> list[Node]:
    start_ns = 1_000_000_000_000 * (number + 1)
    drive = drive_of("bench", start_ns)
    writer.add_session(drive, CAMERA, descriptor=DESCRIPTOR, frontend=FRONTEND)
    nodes: list[Node] = []
    step = SE3(np.eye(3), np.array([0.0, 0.0, 1.0]))
    for at in range(SESSION_NODES):
        node = node_of(drive, start_ns + at * 100_000_000, float(at))
        writer.copy_node(stored(node, blob))
        if nodes:
            writer.add_edge(Edge(nodes[-1].id, node.id, EdgeKind.ODOMETRY, step, _SIGMA))
        kind = PathEntryKind.SAVED
        writer.add_path_entry(PathEntry(path_id(drive.id), at, node.id, kind, node.stamp_ns))
        nodes.append(node)
    return nodes


def _pairs(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 2) int: pairs of nodes of two drives, at most 5 m apart, each once."""
    places = SESSIONS * SESSION_NODES
    a = rng.integers(0, places, 4 * count)
    there = np.clip(a % SESSION_NODES + rng.integers(-5, 6, len(a)), 0, SESSION_NODES - 1)
    b = (a // SESSION_NODES + rng.integers(1, SESSIONS, len(a))) % SESSIONS * SESSION_NODES + there
    return np.unique(np.column_stack([a, b]), axis=0)[rng.permutation(count)]


def _attempts(rng: np.random.Generator, count: int) -> Attempts:
    nodes = SESSIONS * SESSION_NODES
    return Attempts(
        session=np.zeros(count, np.int32),
        iteration=np.arange(count, dtype=np.int64) // 2,
        reference=rng.integers(0, nodes, count).astype(np.int32),
        node=rng.integers(0, nodes, count).astype(np.int32),
        **{
            name: rng.uniform(0.01, 2, count).astype(np.float32)
            for name in ("along_m", "across_m", "yaw_rad", "sigma_m", "sigma_yaw_rad")
        },
        accepted=rng.random(count) < 0.5,
        inliers=rng.integers(0, 300, count).astype(np.int32),
        rank=rng.integers(0, 20, count).astype(np.int32),
        policy=np.zeros(count, np.int32),
        policies=("recall",),
    )


_CANDIDATES, _OBSERVED = 200, 1000
_INPUTS = 1000
# Of each input the best of so many runs counts: what the machine does besides is not the policy's.
_BEST_OF = 10


def prepare_ranking(
    data: BenchData, plain: PlainPipeline | None, *, policy: str, paths: int
) -> Prepared:
    """Order the candidates of 1,000 situations drawn at random, with `paths` paths in memory.

    A drive's situations are like each other, these are not: what a policy keeps from frame to
    frame helps it only within the ten runs of one input. The reference of `path-near` works the
    formula out in NumPy, over 150 paths only: over 10,000 it takes a hundred times as long.
    """
    del data, plain
    place = SyntheticPlace(paths)
    contexts = [place.context(_CANDIDATES, _OBSERVED) for _ in range(_INPUTS)]
    ranking = policy_named(policy)

    def ours(i: int) -> dict[str, int]:
        order = ranking.rank(contexts[i % _INPUTS])
        return {"paths": paths, "candidates": len(order), "observed": _OBSERVED}

    if policy != "path-near" or paths > 1000:
        return Prepared(ours, best_of=_BEST_OF)
    formula = PlainFormula(place)

    def reference(i: int) -> dict[str, int]:
        order = formula.rank(contexts[i % _INPUTS])
        return {"paths": paths, "candidates": len(order), "observed": _OBSERVED}

    return Prepared(ours, reference, best_of=_BEST_OF)


class PlainFormula:
    """[L15 §V] as one would write it in NumPy, over a dense table of who was where."""

    def __init__(self, place: SyntheticPlace) -> None:
        every = np.arange(len(place.graph), dtype=np.int32)
        self._paths = place.memory.paths
        self._on = place.memory.on_paths(self._paths, every).T.astype(np.float32)

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """Rows, most promising first."""
        return np.lexsort((context.neighbourhood.distance_m, -self.scores(context)))

    def scores(self, context: RankingContext) -> NDArray[np.float32]:
        """(Y,) log posterior up to a common constant."""
        on = self._on
        if context.own_path is not None:
            on = np.delete(on, self._paths.index(context.own_path), axis=1)
        nodes, seen = context.neighbourhood.nodes, context.observations
        theta = on[nodes] @ on[seen.nodes].T + 1
        theta /= theta.sum(axis=1, keepdims=True)
        score = np.log(np.where(seen.succeeded, theta, 1 - theta)).sum(axis=1)
        if context.reference is not None:
            score += np.log(on[nodes] @ on[context.reference] + 1)
        return np.asarray(score, np.float32)


_BRANCHES = (22, 22, 22)  # 10,648 leaves, of which the last level keeps 10,000
_WORDS = 10_000
_SHOWN = 470  # words that an image of 500 to 600 landmarks shows on average, of 10,000
_QUERIES = 16
_LOOKS = 5000  # drawing a million would take a minute
_LANDMARKS = 500
_TRAINING_FRAMES, _TRAINING_WORDS = 100, 1000


def prepare_places_query(
    data: BenchData, plain: PlainPipeline | None, *, places: int, dense: bool
) -> Prepared:
    """500 descriptors in, the ten most likely of `places` places out, by FAB-MAP at 10,000 words.

    Words are as frequent as a gamma distribution makes them, some in every second image and most
    in few; there are 5,000 looks that places can have. The reference is `DenseTable`; it gets its
    words from the same tree.
    """
    del data, plain
    rng = np.random.default_rng(places)
    vocabulary = made_up_vocabulary(rng)
    frequency = vocabulary.statistics.seen / vocabulary.statistics.images
    recogniser = FabMap(vocabulary)
    table = DenseTable(vocabulary, recogniser.config, places) if dense else None
    looks = [_drawn(frequency, rng) for _ in range(min(places, _LOOKS))]
    for look in rng.integers(0, len(looks), places):
        recogniser.add(looks[look])
        if table is not None:
            table.add(looks[look])
    leaves = vocabulary.tree.leaf_centres
    queries = [leaves[rng.choice(_drawn(frequency, rng), _LANDMARKS)] for _ in range(_QUERIES)]

    def words_of(i: int) -> NDArray[np.int32]:
        return vocabulary.words_of(queries[i % _QUERIES], BRIEF)

    def ours(i: int) -> dict[str, int]:
        words = words_of(i)
        recogniser.recognise(words, 10)
        memory = round(recogniser.bytes_per_place)
        return {"places": places, "words": len(words), "bytes_per_place": memory}

    if table is None:
        return Prepared(ours)

    def reference(i: int) -> dict[str, int]:
        words = words_of(i)
        table.best(words, 10)
        return {"places": places, "words": len(words), "bytes_per_place": 4 * _WORDS}

    return Prepared(ours, reference)


def prepare_vocabulary_train(data: BenchData, plain: PlainPipeline | None) -> Prepared:
    """1,000 words and their Chow-Liu tree from 100 frames of 500 descriptors.

    A hundredth of what `engram vocabulary train` is made for: clustering costs in proportion to
    descriptors, the tree of words in proportion to the square of the words. There is no reference.
    """
    del data, plain
    rng = np.random.default_rng(0)
    things = rng.integers(0, 256, (2000, 32), dtype=np.uint8)
    frames = []
    for _ in range(_TRAINING_FRAMES):
        seen = things[rng.integers(0, len(things), _LANDMARKS)]
        frames.append(seen ^ np.packbits(rng.random((_LANDMARKS, 256)) < 0.08, axis=1))
    config = TrainingConfig(words=_TRAINING_WORDS)

    def ours(_: int) -> dict[str, int]:
        vocabulary = train_vocabulary(frames, BRIEF, config)
        return {"words": len(vocabulary), "descriptors": _TRAINING_FRAMES * _LANDMARKS}

    return Prepared(ours)


def made_up_vocabulary(rng: np.random.Generator) -> Vocabulary:
    """10,000 words in a tree of three levels, and a tree of company of random shape."""
    images = 2000
    share = rng.gamma(0.8, size=_WORDS)
    frequency = np.minimum(_SHOWN * share / share.sum(), 0.9)
    seen = (images * frequency).astype(np.int32)
    before = np.arange(_WORDS)
    parents = np.where(before > 0, rng.integers(0, np.maximum(before, 1)), -1).astype(np.int32)
    both = np.where(parents >= 0, np.minimum(seen, seen[parents]) // 2, 0).astype(np.int32)
    statistics = WordStatistics(images, seen, parents, both)
    samples = tuple(_drawn(frequency, rng) for _ in range(100))
    return Vocabulary(BRIEF, _made_up_tree(rng), statistics, samples)


def _made_up_tree(rng: np.random.Generator) -> TreeArrays:
    """Centres that differ from their parents in fewer bits the deeper they are."""
    level = np.zeros((1, 32), np.uint8)
    levels, children = [level], []
    for branches, flips in zip(_BRANCHES, (0.5, 0.2, 0.1), strict=True):
        count = len(level) * branches
        counts = np.full(len(level), branches)
        if count > _WORDS:
            counts = np.diff(np.linspace(0, _WORDS, len(level) + 1).astype(np.int64))
            count = _WORDS
        level = np.repeat(level, counts, axis=0)
        level = level ^ np.packbits(rng.random((count, 256)) < flips, axis=1)
        levels.append(level)
        children.append(counts)
    children.append(np.zeros(len(level), np.int64))
    bounds = np.concatenate([[1], 1 + np.cumsum(np.concatenate(children))])
    return TreeArrays(np.concatenate(levels), bounds.astype(np.int32))


def _drawn(frequency: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.int32]:
    """Words of an image, each drawn by itself."""
    return np.flatnonzero(rng.random(len(frequency), np.float32) < frequency).astype(np.int32)


class DenseTable:
    """FAB-MAP as NumPy does it best: a row per place, one matrix-vector product per query."""

    def __init__(self, vocabulary: Vocabulary, config: FabMapConfig, places: int) -> None:
        model = ObservationModel.of(vocabulary.statistics, config.detector)
        self._unseen, self._seen = model.log_p.astype(np.float32)
        self._parents = model.parents
        self._every = np.arange(len(vocabulary))
        self._shows = np.zeros((places, len(vocabulary)), np.float32)
        self._count = 0

    def add(self, words: NDArray[np.int32]) -> None:
        """Adds a place."""
        self._shows[self._count, words] = 1
        self._count += 1

    def best(self, words: NDArray[np.int32], count: int) -> NDArray[np.int64]:
        """Numbers of the `count` most likely places, in no order."""
        z = np.zeros(len(self._parents), np.int64)
        z[words] = 1
        case = 2 * z + np.where(self._parents >= 0, z[self._parents], 0)
        unseen = self._unseen[case, self._every]
        scores = self._shows @ (self._seen[case, self._every] - unseen) + unseen.sum()
        return np.argpartition(scores, -count)[-count:]
