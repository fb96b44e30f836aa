"""The words of a map's nodes: kept in it by whoever writes, worked out where they are missing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from engram.errors import MapCorruptError
from engram.frontend import DescriptorKind, Frame
from engram.graph.model import LandmarkSource, NodeId
from engram.maps import Map
from engram.monitor import QUIET, Monitor
from engram.places.bag_of_words import inverse_frequencies
from engram.places.vocabulary import Vocabulary, decode_vocabulary, default_vocabulary, hash_of

Words = NDArray[np.int32]

# Nodes written in one transaction: about 1 MB.
_BATCH = 1000


def vocabulary_of(opened: Map) -> Vocabulary | None:
    """The vocabulary that was trained for a map; None if there is none: for `Map.derived`.

    Raises:
        MapCorruptError: it is damaged.
    """
    return None if opened.vocabulary is None else decode_vocabulary(opened.vocabulary)


def vocabulary_or_default(opened: Map, descriptor: DescriptorKind) -> Vocabulary:
    """A map's vocabulary, or the default one; `descriptor` counts while the map is empty."""
    own = opened.derived(vocabulary_of)
    return own or default_vocabulary(opened.descriptor or descriptor)


def words_of(opened: Map, descriptor: DescriptorKind) -> NodeWords:
    """The words of a map's nodes and of live frames of this kind: for `Map.derived`."""
    return NodeWords(opened.frames, lambda: vocabulary_or_default(opened, descriptor), opened)


class NodeWords:
    """The distinct words, rising, that nodes and live frames show by one vocabulary.

    Those that the map keeps are taken from there; others are worked out from landmarks, once.

    Args:
        frames: landmarks of the nodes.
        vocabulary: gives the vocabulary; called once, at first use.
        store: the map that keeps words; None where none are kept.
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
        self._worked_out: dict[NodeId, Words | None] = {}
        # The live frame's words: several localisers in step ask for them one after another.
        self._last: tuple[Frame, Words] | None = None

    @classmethod
    def of_map(cls, store: Map, vocabulary: Vocabulary) -> NodeWords:
        """The words of a map's nodes by this vocabulary."""
        return cls(store.frames, lambda: vocabulary, store)

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """Whose words they are."""
        return self._give_vocabulary()

    @cached_property
    def hash(self) -> bytes:
        """Of the vocabulary, by which maps name it."""
        return hash_of(self.vocabulary)

    @cached_property
    def kept(self) -> Mapping[NodeId, Words]:
        """What the map keeps by this vocabulary, as far as it can be of it."""
        if self._store is None:
            return {}
        kept, most = self._store.words(self.hash), len(self.vocabulary)
        return {node: words for node, words in kept.items() if not len(words) or words[-1] < most}

    @cached_property
    def idf(self) -> NDArray[np.float64]:
        """(W,) inverse document frequency of each word of the vocabulary."""
        return inverse_frequencies(self.vocabulary.statistics)

    def prepare(self) -> None:
        """Reads the vocabulary and the kept words now, not in the midst of a drive."""
        _ = self.idf, self.kept

    def of_frame(self, frame: Frame) -> Words:
        """The words (n,) int32 of a frame.

        Raises:
            IncompatibleError: its descriptors are of another kind than the vocabulary's.
        """
        last = self._last
        if last is None or last[0] is not frame:
            words = self.vocabulary.words_of(frame.landmarks.descriptors, frame.descriptor)
            last = self._last = (frame, words)
        return last[1]

    def of_node(self, node: NodeId) -> Words | None:
        """The words (n,) int32 of a node; None where its landmarks are damaged.

        `engram check` names such a node, and whoever needs its landmarks meets the error.

        Raises:
            IncompatibleError: as `of_frame`.
        """
        words = self.kept.get(node)
        if words is None and node not in self._worked_out:
            self._worked_out[node] = self._work_out(node)
        return self._worked_out[node] if words is None else words

    def keep_missing(self, nodes: Sequence[NodeId], monitor: Monitor = QUIET) -> int:
        """Works out the words of nodes for which the map keeps none, and keeps them there.

        A damaged node is left out. Stopped half way, what was done is kept.

        Args:
            nodes: nodes of the map, which is open for writing.
            monitor: sees the stage `words`, one item a node.

        Returns:
            How many nodes were worked out.

        Raises:
            IncompatibleError: the nodes have another kind of descriptor.
            StorageFullError: no space; what was done is kept.
        """
        assert self._store is not None
        missing = [node for node in nodes if node not in self.kept]
        count = 0
        with monitor.stage("words", len(missing)) as stage:
            for first in range(0, len(missing), _BATCH):
                found = {}
                for node in missing[first : first + _BATCH]:
                    words = self._work_out(node)
                    if words is not None:
                        found[node] = words
                    stage.advance()
                if found:
                    self._store.put_words(self.hash, found)
                    count += len(found)
        return count

    def give(self, other: Map, nodes: Sequence[NodeId]) -> None:
        """Keeps the words of nodes in another map, whether this one keeps them or not.

        So the same nodes make the same bytes.
        """
        found = {node: words for node in nodes if (words := self.of_node(node)) is not None}
        other.put_words(self.hash, found)

    def _work_out(self, node: NodeId) -> Words | None:
        try:
            frame = self._frames.frame(node)
        except MapCorruptError:
            return None
        return self.vocabulary.words_of(frame.landmarks.descriptors, frame.descriptor)
