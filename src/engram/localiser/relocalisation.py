"""Finding a lost robot: which nodes of the whole map to attempt (SPEC §6)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from engram.experience.graph import ExperienceGraph
from engram.frontend import Frame


class Relocaliser(Protocol):
    """Proposes nodes for a robot that does not know where it is."""

    @property
    def name(self) -> str:
        """Its key in `RELOCALISERS`."""
        ...

    def propose(self, live: Frame, count: int) -> list[int]:
        """Up to `count` nodes to attempt for this frame, best first.

        Args:
            live: the live frame.
            count: how many attempts the frame's budget allows.

        Returns:
            Dense indices into the graph, without repeats.
        """
        ...


class Exhaustive:
    """Goes through all nodes of the map, over as many live frames as that takes.

    Neighbouring nodes show the same place, so the order first strides over the map in wide steps
    and then fills the gaps: the bit-reversed count (van der Corput) covers every scale evenly.
    Nodes that join the map meanwhile are met in the next pass.
    """

    name = "exhaustive"

    def __init__(self, graph: ExperienceGraph) -> None:
        self._graph = graph
        self._order: list[int] = []
        self._next = 0

    def propose(self, live: Frame, count: int) -> list[int]:
        """See `Relocaliser`; `live` is of no interest to it."""
        del live
        if self._next >= len(self._order):
            self._order, self._next = van_der_corput_order(len(self._graph)), 0
        proposed = self._order[self._next : self._next + count]
        self._next += len(proposed)
        return proposed


def van_der_corput_order(count: int) -> list[int]:
    """0 … count−1 in bit-reversed order: every prefix is spread evenly over the range."""
    bits = max(count - 1, 0).bit_length()
    reversed_numbers = (int(f"{i:0{bits}b}"[::-1], 2) if bits else 0 for i in range(1 << bits))
    return [number for number in reversed_numbers if number < count]


RELOCALISERS: dict[str, Callable[[ExperienceGraph], Relocaliser]] = {
    Exhaustive.name: Exhaustive,
}
