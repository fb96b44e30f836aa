"""The words of a map's nodes in a place recogniser, in which a lost robot is looked up."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import numpy as np

from engram.frontend import Frame
from engram.graph.graph import ExperienceGraph
from engram.graph.model import NodeId
from engram.places.recogniser import Comparison, PlaceRecogniser, ReadsFrames
from engram.places.vocabulary import Vocabulary
from engram.places.words import NodeWords, Words


class PlaceBook:
    """All nodes of a map as places of a recogniser.

    Only the thread of the graph calls `learn_new_nodes`; any thread may compare.

    Args:
        graph: the experience graph; may grow.
        words: the words of its nodes, and their frames.
        recogniser: makes the recogniser for a vocabulary.

    Attributes:
        unreadable: nodes, by dense index, with damaged landmarks: they have no words here, and
            must not be proposed.
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
        """Number of known nodes; place numbers are dense indices of the graph."""
        return len(self._recogniser)

    def words_of(self, frame: Frame) -> Words:
        """What the recogniser compares of a frame, (n,) int32: its words, or its signature.

        Raises:
            IncompatibleError: it has another kind of descriptor.
        """
        if isinstance(self._recogniser, ReadsFrames):
            return self._recogniser.signature(frame)
        return self._words.of_frame(frame)

    def learn_new_nodes(self) -> None:
        """Adds the new nodes of the graph."""
        for index in range(len(self._recogniser), len(self._graph)):
            words = self._words_of_node(self._graph.node(index).id)
            if words is None:  # relocalisation works without it
                self.unreadable.add(index)
                words = np.zeros(0, np.int32)
            with self._lock:
                self._recogniser.add(words)

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
