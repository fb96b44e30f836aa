"""The words of a map's nodes in a place recogniser: what a lost robot looks itself up in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from engram.errors import MapCorruptError
from engram.frontend import Frame
from engram.graph.graph import ExperienceGraph
from engram.graph.model import LandmarkSource, NodeId
from engram.places import Comparison, PlaceRecogniser, Vocabulary

Words = NDArray[np.int32]


def _nothing_stored(vocabulary: Vocabulary) -> Mapping[NodeId, Words]:
    """For maps whose words are kept nowhere."""
    del vocabulary
    return {}


@dataclass(frozen=True, slots=True)
class Searched:
    """What a relocaliser searches.

    Attributes:
        graph: the nodes; may grow.
        frames: their landmarks.
        vocabulary: gives the map's vocabulary; asked only by relocalisers that need one.
        stored_words: gives the words of nodes by a vocabulary, as far as they are kept; the
            others are worked out from their landmarks.
    """

    graph: ExperienceGraph
    frames: LandmarkSource
    vocabulary: Callable[[], Vocabulary]
    stored_words: Callable[[Vocabulary], Mapping[NodeId, Words]] = _nothing_stored


class PlaceBook:
    """All nodes of a map, known by their words.

    One thread, that of the graph, calls `learn_new_nodes`; any thread may compare.

    Args:
        searched: the map.
        recogniser: makes the recogniser for a vocabulary.

    Attributes:
        vocabulary: whose words.
        unreadable: nodes, by dense index, whose landmarks are damaged: they stand in the book
            without words, and are not to be proposed.
    """

    def __init__(
        self, searched: Searched, recogniser: Callable[[Vocabulary], PlaceRecogniser]
    ) -> None:
        self.vocabulary = searched.vocabulary()
        self.unreadable: set[int] = set()
        self._graph = searched.graph
        self._frames = searched.frames
        self._recogniser = recogniser(self.vocabulary)
        self._lock = Lock()
        self._learn(searched.stored_words(self.vocabulary))

    def __len__(self) -> int:
        """Number of nodes that are known; their numbers are the graph's."""
        return len(self._recogniser)

    def words_of(self, frame: Frame) -> Words:
        """The distinct words (n,) of a frame, rising.

        Raises:
            IncompatibleError: it has another kind of descriptor.
        """
        return self.vocabulary.words_of(frame.landmarks.descriptors, frame.descriptor)

    def learn_new_nodes(self) -> None:
        """Adds the nodes that have joined the graph since."""
        self._learn({})

    def compare(self, words: Words) -> Comparison:
        """See `PlaceRecogniser.compare`."""
        with self._lock:
            return self._recogniser.compare(words)

    def _learn(self, stored: Mapping[NodeId, Words]) -> None:
        for index in range(len(self._recogniser), len(self._graph)):
            node = self._graph.node(index).id
            words = stored.get(node)
            if words is None:
                words = self._worked_out(index, node)
            with self._lock:
                self._recogniser.add(words)

    def _worked_out(self, index: int, node: NodeId) -> Words:
        try:
            return self.words_of(self._frames.frame(node))
        except MapCorruptError:
            # The others can be found without it; `engram check` names it.
            self.unreadable.add(index)
            return np.zeros(0, np.int32)
