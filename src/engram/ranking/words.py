"""The visual words of nodes and live frames, for policies that compare appearances."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from engram.errors import MapCorruptError
from engram.frontend import Frame
from engram.graph.graph import ExperienceGraph
from engram.graph.model import LandmarkSource, NodeId
from engram.places import Vocabulary
from engram.places.bag_of_words import inverse_frequencies


class WordSource(Protocol):
    """Words of frames and of nodes, and how much each word tells."""

    @property
    def idf(self) -> NDArray[np.float64]:
        """(W,) inverse document frequency of each word of the vocabulary."""
        ...

    def of_frame(self, frame: Frame) -> NDArray[np.int32]:
        """The distinct words (n,) int32 of a live frame, rising."""
        ...

    def of_node(self, node: int) -> NDArray[np.int32]:
        """The distinct words (n,) int32 of a node, by its dense index, rising."""
        ...


class QuantisedWords:
    """A `WordSource` that looks words up when they are first asked for, and keeps nodes' words.

    Args:
        graph: the nodes.
        frames: their landmarks.
        vocabulary: gives the vocabulary; called once, at first use.
        known: gives the words that the map keeps by it; None where it keeps none.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        frames: LandmarkSource,
        vocabulary: Callable[[], Vocabulary],
        known: Callable[[Vocabulary], Mapping[NodeId, NDArray[np.int32]]] | None = None,
    ) -> None:
        self._graph = graph
        self._frames = frames
        self._make_vocabulary = vocabulary
        self._look_up = known
        self._known: Mapping[NodeId, NDArray[np.int32]] = {}
        self._vocabulary: Vocabulary | None = None
        self._idf: NDArray[np.float64] | None = None
        self._of_node: dict[int, NDArray[np.int32]] = {}
        # The live frame's words: several localisers in step ask for them one after another.
        self._last: tuple[Frame, NDArray[np.int32]] | None = None

    @property
    def idf(self) -> NDArray[np.float64]:
        """See `WordSource`."""
        if self._idf is None:
            self._idf = inverse_frequencies(self._loaded.statistics)
        return self._idf

    def of_frame(self, frame: Frame) -> NDArray[np.int32]:
        """See `WordSource`.

        Raises:
            IncompatibleError: its descriptors are of another kind than the vocabulary's.
        """
        last = self._last
        if last is None or last[0] is not frame:
            words = self._loaded.words_of(frame.landmarks.descriptors, frame.descriptor)
            last = self._last = (frame, words)
        return last[1]

    def prepare(self) -> None:
        """Reads the vocabulary and the nodes' words now, not in the midst of a drive."""
        _ = self.idf

    def of_node(self, node: int) -> NDArray[np.int32]:
        """See `WordSource`; none of a node that is damaged: whoever attempts it says so."""
        words = self._of_node.get(node)
        if words is None:
            words = self._read(self._graph.node(node).id)
            self._of_node[node] = words
        return words

    def _read(self, node: NodeId) -> NDArray[np.int32]:
        vocabulary = self._loaded
        words = self._known.get(node)
        if words is None:
            try:
                frame = self._frames.frame(node)
            except MapCorruptError:
                return np.zeros(0, np.int32)
            words = vocabulary.words_of(frame.landmarks.descriptors, frame.descriptor)
        return words

    @property
    def _loaded(self) -> Vocabulary:
        if self._vocabulary is None:
            self._vocabulary = self._make_vocabulary()
            if self._look_up is not None:
                self._known = self._look_up(self._vocabulary)
        return self._vocabulary
