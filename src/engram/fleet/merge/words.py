"""The words of nodes go along with them: lost robots are found without their landmarks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from engram.fleet.merge.state import Merge
from engram.frontend import DescriptorKind
from engram.graph.model import NodeId
from engram.maps import Map
from engram.places import decode_vocabulary, default_vocabulary, hash_of
from engram.places.stored_words import (
    keep_missing_words,
    stored_words,
    vocabulary_or_default,
    worked_out_words,
)


def keep_words(store: Map, merge: Merge, descriptor: DescriptorKind) -> None:
    """Copies the words that the robot's map has by the centre's vocabulary, and works out the rest.

    Words are no part of any revision: where this is interrupted, they are worked out later.
    """
    vocabulary, graph = vocabulary_or_default(merge.centre, descriptor), merge.graph
    theirs = stored_words(merge.robot.store, vocabulary)
    brought = {node: theirs[node] for node in merge.robot.nodes if node in graph and node in theirs}
    if brought:
        store.put_words(hash_of(vocabulary), brought)
    keep_missing_words(store, vocabulary, [node.id for node in graph.nodes])


class CentreWords:
    """Words of a centre's nodes, for downloads: kept ones, and others worked out once.

    Args:
        store: the centre, which is left as it is.
    """

    def __init__(self, store: Map) -> None:
        self._store = store
        body, descriptor = store.vocabulary, store.descriptor
        self._vocabulary = None
        if body is not None:
            self._vocabulary = decode_vocabulary(body)
        elif descriptor is not None:
            self._vocabulary = default_vocabulary(descriptor)
        self._known: dict[NodeId, NDArray[np.int32]] = {}
        if self._vocabulary is not None:
            self._known.update(stored_words(store, self._vocabulary))

    def give(self, download: Map, nodes: Sequence[NodeId]) -> None:
        """Keeps the words of the nodes of a download in it, whether the centre kept them or not.

        So the same nodes make the same bytes.
        """
        if self._vocabulary is None:
            return
        missing = [node for node in nodes if node not in self._known]
        self._known.update(worked_out_words(self._store, self._vocabulary, missing))
        found = {node: self._known[node] for node in nodes if node in self._known}
        download.put_words(hash_of(self._vocabulary), found)
