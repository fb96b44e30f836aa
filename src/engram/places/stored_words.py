"""The words of a map's nodes: kept in it by whoever writes, worked out where they are missing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from engram.errors import MapCorruptError
from engram.frontend import DescriptorKind
from engram.graph.model import NodeId
from engram.maps import Map
from engram.monitor import ignore
from engram.places import Vocabulary, decode_vocabulary, default_vocabulary, hash_of

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


def stored_words(store: Map, vocabulary: Vocabulary) -> Mapping[NodeId, Words]:
    """What a map keeps of words by this vocabulary, as far as they can be of it."""
    kept = store.words(hash_of(vocabulary))
    return {
        node: words for node, words in kept.items() if not len(words) or words[-1] < len(vocabulary)
    }


def keep_missing_words(
    store: Map,
    vocabulary: Vocabulary,
    nodes: Sequence[NodeId],
    advance: Callable[[str, float], None] | None = None,
) -> int:
    """Works out the words of nodes that have none by this vocabulary, and keeps them.

    A node whose landmarks are damaged is left out. Killed half way, what was done is kept.

    Args:
        store: the map.
        vocabulary: its vocabulary.
        nodes: all of its nodes.
        advance: called now and then with `words` and the share of the work that is done, 0…1.

    Returns:
        How many nodes were worked out.

    Raises:
        IncompatibleError: the nodes have another kind of descriptor.
        StorageFullError: no space; what was done is kept.
    """
    report = advance or (lambda _, __: ignore(""))
    known = stored_words(store, vocabulary)
    missing = [node for node in nodes if node not in known]
    name = hash_of(vocabulary)
    found = worked_out_words(store, vocabulary, missing)
    count = 0
    while batch := dict(islice(found, _BATCH)):
        store.put_words(name, batch)
        count += len(batch)
        report("words", count / len(missing))
    return count


def worked_out_words(
    store: Map, vocabulary: Vocabulary, nodes: Sequence[NodeId]
) -> Iterator[tuple[NodeId, Words]]:
    """The words of nodes by a vocabulary, from their landmarks; damaged nodes are left out."""
    for node in nodes:
        try:
            frame = store.frames.frame(node)
        except MapCorruptError:
            continue  # `engram check` names it; whoever needs this very node meets the error
        yield node, vocabulary.words_of(frame.landmarks.descriptors, frame.descriptor)
