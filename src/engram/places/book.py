"""The words of a map's nodes in a place recogniser: what a lost robot looks itself up in."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import numpy as np

from engram.frontend import Frame
from engram.graph.graph import ExperienceGraph
from engram.places.recogniser import Comparison, PlaceRecogniser
from engram.places.vocabulary import Vocabulary
from engram.places.words import NodeWords, Words


class PlaceBook:
    """All nodes of a map, known by their words.

    One thread, that of the graph, calls `learn_new_nodes`; any thread may compare.

    Args:
        graph: the nodes; may grow.
        words: their words.
        recogniser: makes the recogniser for a vocabulary.

    Attributes:
        unreadable: nodes, by dense index, whose landmarks are damaged: they stand in the book
            without words, and are not to be proposed.
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
        self.learn_new_nodes()

    def __len__(self) -> int:
        """Number of nodes that are known; their numbers are the graph's."""
        return len(self._recogniser)

    def words_of(self, frame: Frame) -> Words:
        """The distinct words (n,) int32 of a frame, rising.

        Raises:
            IncompatibleError: it has another kind of descriptor.
        """
        return self._words.of_frame(frame)

    def learn_new_nodes(self) -> None:
        """Adds the nodes that have joined the graph since."""
        for index in range(len(self._recogniser), len(self._graph)):
            words = self._words.of_node(self._graph.node(index).id)
            if words is None:  # the others can be found without it
                self.unreadable.add(index)
                words = np.zeros(0, np.int32)
            with self._lock:
                self._recogniser.add(words)

    def compare(self, words: Words) -> Comparison:
        """See `PlaceRecogniser.compare`."""
        with self._lock:
            return self._recogniser.compare(words)
