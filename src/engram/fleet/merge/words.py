"""The words of nodes go along with them: lost robots are found without their landmarks."""

from __future__ import annotations

from engram.fleet.merge.state import Merge
from engram.frontend import DescriptorKind
from engram.maps import Map
from engram.places.words import NodeWords, vocabulary_or_default


def keep_words(store: Map, merge: Merge, descriptor: DescriptorKind) -> None:
    """Copies the words that the robot's map has by the centre's vocabulary, and works out the rest.

    Words are no part of any revision: where this is interrupted, they are worked out later.
    """
    vocabulary, graph = vocabulary_or_default(merge.centre, descriptor), merge.graph
    theirs = NodeWords.of_map(merge.robot.store, vocabulary)
    brought = {
        node: theirs.kept[node]
        for node in merge.robot.nodes
        if node in graph and node in theirs.kept
    }
    if brought:
        store.put_words(theirs.hash, brought)
    NodeWords.of_map(store, vocabulary).keep_missing([node.id for node in graph.nodes])
