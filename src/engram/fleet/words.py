"""The words of nodes that a merge brought: lost robots are found without their landmarks."""

from __future__ import annotations

from engram.drive.place_words import keep_missing_words, stored_words
from engram.fleet.centre import Centre
from engram.fleet.handed_in import HandedIn
from engram.frontend import DescriptorKind
from engram.places import hash_of
from engram.store import WritableMapStore


def keep_words(
    store: WritableMapStore, centre: Centre, robot: HandedIn, descriptor: DescriptorKind
) -> None:
    """Copies the words that the robot's map has by the centre's vocabulary, and works out the rest.

    Words are no part of any revision: where this is interrupted, they are worked out later.
    """
    vocabulary = centre.opened.vocabulary_or_default(descriptor)
    theirs = stored_words(robot.store, vocabulary)
    brought = {
        node: theirs[node] for node in robot.nodes if node in centre.graph and node in theirs
    }
    if brought:
        store.put_words(hash_of(vocabulary), brought)
    keep_missing_words(store, vocabulary, [node.id for node in centre.graph.nodes])
