"""Finding a lost robot: which nodes of the whole map to attempt (SPEC §6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.frontend import Frame
from engram.geometry import SE3
from engram.graph.graph import ExperienceGraph
from engram.localiser.belief import PlaceBelief
from engram.places import RECOGNISERS, PlaceRecogniser, Vocabulary
from engram.places.book import PlaceBook
from engram.places.words import NodeWords

# Neighbours in the order of saving show the same place: where one was not matched, others of that
# place mostly are not either. Source: nodes are saved every metre, and matched up to 3 to 4 m away.
_NEIGHBOURS = 3
# A node that failed is not tried again for so many frames, unless nothing else is left.
_PATIENCE = 10


class Relocaliser(Protocol):
    """Proposes nodes for a robot that does not know where it is."""

    @property
    def name(self) -> str:
        """Its key in `RELOCALISERS`."""
        ...

    @property
    def new_place(self) -> float | None:
        """Probability that the last frame showed nothing of the map; None if it cannot tell."""
        ...

    def propose(self, live: Frame, count: int, allowed: Callable[[int], bool]) -> list[int]:
        """Up to `count` nodes to attempt for this frame, best first.

        Args:
            live: the live frame.
            count: how many attempts the frame's budget allows.
            allowed: whether a node, by its dense index, may be proposed.

        Returns:
            Dense indices into the graph, without repeats.

        Raises:
            IncompatibleError: the frame has another kind of descriptor than the map.
        """
        ...

    def carry_on(self, motion: SE3 | None) -> None:
        """The robot moved on since the last frame; None if nobody knows how."""
        ...

    def failed(self, nodes: Sequence[int]) -> None:
        """Attempts to match the last frame with these nodes, by dense index, failed."""
        ...

    def forget(self) -> None:
        """The robot was found, or is another one: earlier frames say nothing any more."""
        ...


class Exhaustive:
    """Goes through all nodes of the map, over as many live frames as that takes.

    Neighbouring nodes show the same place, so the order first strides over the map in wide steps
    and then fills the gaps: the bit-reversed count (van der Corput) covers every scale evenly.
    Nodes that join the map meanwhile are met in the next pass.
    """

    name = "exhaustive"
    new_place = None

    def __init__(self, graph: ExperienceGraph, words: NodeWords) -> None:
        del words  # it does without
        self._graph = graph
        self._order: list[int] = []
        self._next = 0

    def propose(self, live: Frame, count: int, allowed: Callable[[int], bool]) -> list[int]:
        """See `Relocaliser`; `live` is of no interest to it."""
        del live
        if self._next >= len(self._order):
            self._order, self._next = van_der_corput_order(len(self._graph)), 0
        proposed = self._order[self._next : self._next + count]
        self._next += len(proposed)
        return [index for index in proposed if allowed(index)]

    def carry_on(self, motion: SE3 | None) -> None:
        """See `Relocaliser`; of no interest to it."""

    def failed(self, nodes: Sequence[int]) -> None:
        """See `Relocaliser`; it does not come back to them before the next pass."""

    def forget(self) -> None:
        """See `Relocaliser`; the pass over the map goes on where it was."""


class ByAppearance:
    """Asks a place recogniser which nodes look like the live frames (SPEC §6).

    The evidence of several frames is added up (`PlaceBelief`), so that one that could be of many
    places does not decide. A frame's attempts go to different places first, and over several
    frames to places further down the list: a place that looks right and is not costs an attempt,
    not the whole budget.

    Args:
        graph: the nodes; may grow.
        words: their words, read when this is made.
        name: key in `RELOCALISERS`.
        recogniser: makes the recogniser for a vocabulary.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        words: NodeWords,
        name: str,
        recogniser: Callable[[Vocabulary], PlaceRecogniser],
    ) -> None:
        self.name = name
        self.book = PlaceBook(graph, words, recogniser)
        self.new_place: float | None = None
        self._belief = PlaceBelief(graph)
        self._frames_seen = 0
        self._tried: dict[int, int] = {}

    def propose(self, live: Frame, count: int, allowed: Callable[[int], bool]) -> list[int]:
        """See `Relocaliser`."""
        self.book.learn_new_nodes()
        compared = self.book.compare(self.book.words_of(live))
        self.new_place = compared.new_place
        self._frames_seen += 1
        likely = self._belief.observe(compared.evidence)
        # All that were tried lately may stand in front.
        most = (_PATIENCE + 2) * count
        places = [place for place in best_places(self.book, likely, most) if allowed(place)]
        fresh = [
            place
            for place in places
            if self._frames_seen - self._tried.get(place, -_PATIENCE) >= _PATIENCE
        ]
        proposed = spread(fresh, count)
        chosen = set(proposed)
        tried = [place for place in places if place not in chosen]
        return proposed + tried[: count - len(proposed)]

    def carry_on(self, motion: SE3 | None) -> None:
        """See `Relocaliser`."""
        self._belief.carry_on(motion)

    def failed(self, nodes: Sequence[int]) -> None:
        """See `Relocaliser`."""
        self._belief.refute(nodes)
        self._tried.update(dict.fromkeys(nodes, self._frames_seen))

    def forget(self) -> None:
        """See `Relocaliser`."""
        self._belief.forget()
        self._tried.clear()


def best_places(book: PlaceBook, likely: NDArray[np.float64], most: int) -> list[int]:
    """The most likely nodes, best first, without those whose words nobody could read."""
    best = _core.best_scores(likely, most)
    return [int(place) for place in best if int(place) not in book.unreadable]


def spread(places: list[int], count: int) -> list[int]:
    """The first `count` places of which no two are neighbours, then the rest in order."""
    apart: list[int] = []
    near: set[int] = set()
    for place in places:
        if len(apart) == count:
            return apart
        if place not in near:
            apart.append(place)
            near.update(range(place - _NEIGHBOURS, place + _NEIGHBOURS + 1))
    chosen = set(apart)
    return (apart + [place for place in places if place not in chosen])[:count]


def van_der_corput_order(count: int) -> list[int]:
    """0 … count−1 in bit-reversed order: every prefix is spread evenly over the range."""
    bits = max(count - 1, 0).bit_length()
    reversed_numbers = (int(f"{i:0{bits}b}"[::-1], 2) if bits else 0 for i in range(1 << bits))
    return [number for number in reversed_numbers if number < count]


RELOCALISERS: dict[str, Callable[[ExperienceGraph, NodeWords], Relocaliser]] = {
    Exhaustive.name: Exhaustive,
    **{
        name: partial(ByAppearance, name=name, recogniser=recogniser)
        for name, recogniser in RECOGNISERS.items()
    },
}
