"""The words of a map's nodes, and the book in which a lost robot is looked up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from engram.errors import EngramError, IncompatibleError, MapCorruptError
from engram.frontend.frame import DescriptorKind, Frame
from engram.graph.graph import ExperienceGraph
from engram.graph.model import LandmarkSource, NodeId
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.place_blocks import PLACES_PER_BLOCK, StoredBlocks, block_parts
from engram.maps.records import Problem
from engram.monitor import QUIET, Monitor
from engram.places.recognisers import (
    Comparison,
    FabMap,
    PlaceRecogniser,
    ReadsFrames,
    StoresBlocks,
    inverse_frequencies,
)
from engram.places.vocabulary import Vocabulary, decode_vocabulary, default_vocabulary, hash_of

Words = NDArray[np.int32]

# Nodes written in one transaction: about 1 MB.
_BATCH = 1000
# Nodes whose words are kept: about 11 MB.
_REMEMBERED = 4096


def vocabulary_of(opened: Map) -> Vocabulary | None:
    """The vocabulary stored in a map; None without one. For `Map.derived`."""
    return None if opened.vocabulary is None else decode_vocabulary(opened.vocabulary)


def problems_of(path: Path, *, thin: bool = False) -> list[Problem]:
    """Faults of a map file, its vocabulary included."""
    return [*check_file(path, thin=thin).problems, *vocabulary_problems(path)]


def vocabulary_problems(path: Path) -> list[Problem]:
    """Faults of a map's vocabulary; none where the map itself cannot be opened."""
    try:
        with Map.open(path) as store:
            body = store.vocabulary
    except EngramError:
        return []
    try:
        if body is not None:
            decode_vocabulary(body)
    except MapCorruptError as error:
        return [Problem("vocabularies", "", str(error))]
    except IncompatibleError:  # of a package that is not installed here
        return []
    return []


def vocabulary_or_default(opened: Map, descriptor: DescriptorKind) -> Vocabulary:
    """A map's vocabulary, or the default one; `descriptor` is used while the map is empty."""
    own = opened.derived(vocabulary_of)
    return own or default_vocabulary(opened.descriptor or descriptor)


def words_of(opened: Map, descriptor: DescriptorKind) -> NodeWords:
    """The words of a map's nodes and of live frames of this kind. For `Map.derived`."""
    return NodeWords(opened.frames, lambda: vocabulary_or_default(opened, descriptor), opened)


class NodeWords:
    """The distinct words, increasing, of nodes and live frames by one vocabulary.

    Words stored in the map are read from it; others are computed from landmarks. Those of the last
    requested nodes are kept.

    Args:
        vocabulary: gives the vocabulary; called once, at first use.
        store: the map that stores words; None for none.
    """

    def __init__(
        self,
        frames: LandmarkSource,
        vocabulary: Callable[[], Vocabulary],
        store: Map | None = None,
    ) -> None:
        self._frames = frames
        self._give_vocabulary = vocabulary
        self._store = store
        self._recalled = lru_cache(_REMEMBERED)(self._words_now)
        # The live frame's words: several localisers of one drive ask for them in turn.
        self._last: tuple[Frame, Words] | None = None

    @classmethod
    def of_map(cls, store: Map, vocabulary: Vocabulary) -> NodeWords:
        """The words of a map's nodes by this vocabulary."""
        return cls(store.frames, lambda: vocabulary, store)

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """The vocabulary of the words."""
        return self._give_vocabulary()

    @cached_property
    def hash(self) -> bytes:
        """Hash of the vocabulary, its key in maps."""
        return hash_of(self.vocabulary)

    def stored(self, nodes: Sequence[NodeId]) -> dict[NodeId, Words]:
        """The valid words (n,) int32 of nodes that the map stores for this vocabulary."""
        if self._store is None:
            return {}
        found = self._store.words(self.hash, nodes)
        return {node: words for node, words in found.items() if self._fit(words)}

    def _fit(self, words: Words) -> bool:
        return not len(words) or int(words[-1]) < len(self.vocabulary)

    @cached_property
    def idf(self) -> NDArray[np.float64]:
        """(W,) float64: log inverse document frequency of each word, a weight."""
        return inverse_frequencies(self.vocabulary.statistics)

    def prepare(self) -> None:
        """Reads the vocabulary now instead of during a drive."""
        _ = self.idf

    def of_frame(self, frame: Frame) -> Words:
        """The words (n,) int32 of a frame."""
        last = self._last
        if last is None or last[0] is not frame:
            words = self.vocabulary.words_of(frame.landmarks.descriptors, frame.descriptor)
            last = self._last = (frame, words)
        return last[1]

    def of_node(self, node: NodeId) -> Words | None:
        """The words (n,) int32 of a node; None if its landmarks are damaged.

        ``engram check`` reports such a node, and reading its landmarks raises.
        """
        return self._recalled(node)

    def _words_now(self, node: NodeId) -> Words | None:
        words = self.stored([node]).get(node)
        return self._work_out(node) if words is None else words

    def keep_missing(
        self,
        nodes: Sequence[NodeId] | None = None,
        monitor: Monitor = QUIET,
        *,
        brought: NodeWords | None = None,
    ) -> int:
        """Computes the missing words of nodes and stores them in the map.

        Damaged nodes are left out. If stopped early, the progress is kept.

        Args:
            nodes: None for all of the map, but those whose place is in a stored block.
            monitor: receives the stage `words`, one item per node.
            brought: words by the same vocabulary that another map stores, which are taken over.

        Returns:
            Number of nodes whose words were stored.
        """
        assert self._store is not None
        nodes, count = self._missing(self._store) if nodes is None else nodes, 0
        with monitor.stage("words", len(nodes)) as stage:
            for part in (nodes[at : at + _BATCH] for at in range(0, len(nodes), _BATCH)):
                known = self.stored(part)
                found = {} if brought is None else dict(brought.stored(part))
                for node in part:
                    if node not in known and node not in found:
                        words = self._work_out(node)
                        if words is not None:
                            found[node] = words
                    stage.advance()
                found = {node: words for node, words in found.items() if node not in known}
                if found:
                    self._store.put_words(self.hash, found)
                    count += len(found)
        self._keep_blocks(self._store, monitor)
        return count

    def _missing(self, store: Map) -> list[NodeId]:
        """The nodes without stored words, behind the stored blocks."""
        pages, missing, known = store.pages, list[NodeId](), 0
        if pages.end >= PLACES_PER_BLOCK:
            known = store.place_blocks(self.hash, FabMap(self.vocabulary).stored_as).count
        for first in range(known * PLACES_PER_BLOCK, pages.end, PLACES_PER_BLOCK):
            end = min(first + PLACES_PER_BLOCK, pages.end)
            stored = self.of_keys(first + 1, end)
            nodes = enumerate(pages.ids(first, end), first + 1)
            missing += [node for key, node in nodes if node is not None and key not in stored]
        return missing

    def _keep_blocks(self, store: Map, monitor: Monitor) -> None:
        """Stores the missing full blocks of FAB-MAP's places, of nodes that stay."""
        due = store.settled_nodes // PLACES_PER_BLOCK
        if not due:
            return
        recogniser = FabMap(self.vocabulary)
        first = store.place_blocks(self.hash, recogniser.stored_as).count
        with monitor.stage("places", max(due - first, 0)) as stage:
            for number in range(first, due):
                at = number * PLACES_PER_BLOCK
                known = self.of_keys(at + 1, at + PLACES_PER_BLOCK)
                nodes = store.pages.ids(at, at + PLACES_PER_BLOCK)
                shown = [
                    known.get(key) if node is None or key in known else self._work_out(node)
                    for key, node in enumerate(nodes, at + 1)
                ]
                for words in shown:
                    recogniser.add(np.zeros(0, np.int32) if words is None else words)
                unreadable = [place for place, words in enumerate(shown) if words is None]
                block = recogniser.block(number - first)
                store.put_place_block(
                    self.hash,
                    recogniser.stored_as,
                    number,
                    block_parts(block.numbers, block.body, unreadable),
                )
                stage.advance()

    def stored_blocks(self, recogniser: StoresBlocks) -> StoredBlocks | None:
        """The blocks of a recogniser that the map stores for this vocabulary."""
        if self._store is None:
            return None
        return self._store.place_blocks(self.hash, recogniser.stored_as)

    def of_keys(self, first: int, last: int) -> dict[int, Words]:
        """The stored words (n,) int32 of nodes of the map, by key."""
        if self._store is None:
            return {}
        found = self._store.words_between(self.hash, first, last)
        return {key: words for key, words in found.items() if self._fit(words)}

    def give(self, other: Map, nodes: Sequence[NodeId]) -> None:
        """Stores the words of nodes in another map, whether this one stores them or not.

        So equal nodes give equal bytes.
        """
        kept = {node: words for node in nodes if (words := self.of_node(node)) is not None}
        other.put_words(self.hash, kept)

    def frame_of(self, node: NodeId) -> Frame | None:
        """The frame of a node; None if its landmarks are damaged."""
        try:
            return self._frames.frame(node)
        except MapCorruptError:
            return None

    def _work_out(self, node: NodeId) -> Words | None:
        frame = self.frame_of(node)
        if frame is None:
            return None
        return self.vocabulary.words_of(frame.landmarks.descriptors, frame.descriptor)


class PlaceBook:
    """All nodes of a map as places of a recogniser.

    Only the thread of the graph calls `learn_new_nodes`; any thread may compare.

    Attributes:
        unreadable: dense indices of nodes with damaged landmarks, and of none: they have no words
            here, and must not be proposed.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        words: NodeWords,
        recogniser: Callable[[Vocabulary], PlaceRecogniser],
    ) -> None:
        self.unreadable: set[int] = set()
        self._graph = graph
        self._words = words
        self._recogniser = recogniser(words.vocabulary)
        self._lock = Lock()

    def __len__(self) -> int:
        """Number of known nodes; place numbers are dense indices of the graph."""
        return len(self._recogniser)

    def words_of(self, frame: Frame) -> Words:
        """What the recogniser compares of a frame, (n,) int32: its words, or its signature."""
        if isinstance(self._recogniser, ReadsFrames):
            return self._recogniser.signature(frame)
        return self._words.of_frame(frame)

    def learn_new_nodes(self) -> None:
        """Adds the new nodes of the graph; at first all, by the stored blocks as far as they go."""
        if not len(self):
            self._open_blocks()
        first = len(self)
        stored = self._stored_words(first)
        for index, node in enumerate(self._graph.ids(first), first):
            words = stored.get(index + 1)
            if words is None or node is None:
                words = None if node is None else self._words_of_node(node)
            if words is None:  # relocalisation works without it
                self.unreadable.add(index)
                words = np.zeros(0, np.int32)
            with self._lock:
                self._recogniser.add(words)

    def _open_blocks(self) -> None:
        recogniser, paged = self._recogniser, self._graph.paged
        if paged < PLACES_PER_BLOCK or not isinstance(recogniser, StoresBlocks):
            return
        blocks = self._words.stored_blocks(recogniser)
        if blocks is None:
            return
        numbers, unreadable = blocks.read(recogniser.rows_of_numbers)
        count = min(numbers.shape[1], paged - paged % PLACES_PER_BLOCK)
        if count:
            with self._lock:
                recogniser.open_blocks(numbers[:, :count].copy(), blocks.body)
            self.unreadable |= {place for place in unreadable if place < count}
            self.unreadable.update(self._graph.unused(count))

    def _stored_words(self, first: int) -> dict[int, Words]:
        """Words of the map's nodes from a dense index on, by key, which is one more."""
        if first >= self._graph.paged or isinstance(self._recogniser, ReadsFrames):
            return {}
        return self._words.of_keys(first + 1, self._graph.paged)

    def _words_of_node(self, node: NodeId) -> Words | None:
        """As `words_of`; None if its landmarks are damaged."""
        if not isinstance(self._recogniser, ReadsFrames):
            return self._words.of_node(node)
        frame = self._words.frame_of(node)
        return None if frame is None else self._recogniser.signature(frame)

    def compare(self, words: Words) -> Comparison:
        """See `PlaceRecogniser.compare`."""
        with self._lock:
            return self._recogniser.compare(words)
