"""Which places of a map look alike though they are not known to be near each other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError
from engram.frontend.frame import BRIEF
from engram.graph.graph import ExperienceGraph
from engram.graph.model import NodeId
from engram.maps.map import Map, open_map
from engram.monitor import QUIET, Monitor
from engram.places.words import vocabulary_or_default, words_of
from engram_lab.bag_of_words import BagOfWords

# Edges are about a metre long; what is within so many of them may well look alike.
_SURROUNDINGS_EDGES = 15
_PICTURE_PX = 720


@dataclass(frozen=True, slots=True)
class Lookalike:
    """A node and the place that looks most like it, its surroundings left out.

    Attributes:
        similarity: cosine of their bags of words, 0…1.
    """

    node: NodeId
    like: NodeId
    similarity: float


@dataclass(frozen=True, slots=True, eq=False)
class Confusion:
    """How alike the places of a map look.

    Attributes:
        matrix: (M, M) float32, similarity of M nodes, evenly taken in the order of saving, to
            each other.
    """

    nodes: int
    lookalikes: tuple[Lookalike, ...]
    matrix: NDArray[np.float32]


def find_lookalikes(
    map_path: Path, at: int | str | None = None, monitor: Monitor = QUIET
) -> Confusion:
    """Compares every node of a map with every other by their words.

    Args:
        at: number of its revision; None for the newest.
    """
    with open_map(map_path, at) as opened:
        words = _words(opened)
        recogniser = BagOfWords(vocabulary_or_default(opened, BRIEF))
        for one in words:
            recogniser.add(one)
        ids = [node.id for node in opened.graph.nodes]
        shown = np.unique(np.linspace(0, max(len(ids) - 1, 0), _PICTURE_PX).astype(np.int64))
        shown = shown[: len(ids)]
        rows, found = [], []
        with monitor.stage("compare", len(ids)) as part:
            for index, one in enumerate(words):
                similarity = recogniser.similarities(one)
                if index in shown:
                    rows.append(similarity[shown].astype(np.float32))
                similarity[_surroundings(opened.graph, index)] = -1
                like = int(similarity.argmax())
                if similarity[like] >= 0:
                    found.append(Lookalike(ids[index], ids[like], float(similarity[like])))
                part.advance()
    found.sort(key=lambda pair: -pair.similarity)
    return Confusion(
        len(ids), tuple(found), np.array(rows, np.float32).reshape(len(rows), len(shown))
    )


def write_confusion_picture(file: Path, confusion: Confusion) -> None:
    """The similarities as a square picture: bright off the diagonal is what looks alike."""
    if confusion.matrix.size == 0:
        raise InputError("the map has no nodes: there is nothing to draw")
    grey = np.clip(255 * confusion.matrix, 0, 255).astype(np.uint8)
    side = max(1, _PICTURE_PX // len(grey)) * len(grey)
    square = cv2.resize(grey, (side, side), interpolation=cv2.INTER_NEAREST)
    try:
        written = cv2.imwrite(str(file), cv2.applyColorMap(square, cv2.COLORMAP_VIRIDIS))
    except cv2.error as error:
        raise InputError(f"{file}: cannot be written as a picture: {error}") from error
    if not written:
        raise InputError(f"{file}: cannot be written")


def _words(opened: Map) -> list[NDArray[np.int32]]:
    """Of each node, kept in the map or worked out from its landmarks."""
    words = opened.derived(words_of, BRIEF)
    nothing = np.zeros(0, np.int32)
    found = [words.of_node(node.id) for node in opened.graph.nodes]
    return [nothing if one is None else one for one in found]


def _surroundings(graph: ExperienceGraph, index: int) -> list[int]:
    """A node and all that is reached from it over a few edges."""
    reached, front = {index}, {index}
    for _ in range(_SURROUNDINGS_EDGES):
        ends = (
            graph.index(end)
            for node in front
            for edge in graph.edges_of(node)
            for end in (edge.a, edge.b)
        )
        front = set(ends) - reached
        reached |= front
    return sorted(reached)
