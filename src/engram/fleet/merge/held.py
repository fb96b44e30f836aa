"""A node whose replay is not decided yet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from engram.frontend import Frame
from engram.graph.model import Attempt
from engram.localiser import Localisation, LocalisationStatus
from engram.localiser.attempts import Outcome
from engram.maps import StoredNode


@dataclass(slots=True, eq=False)
class Held:
    """A replayed node, held back while its fix or one before it may still be withdrawn.

    Attributes:
        stored, live: the node, and its frame.
        found: its localisation; not localised once its fix is withdrawn.
        outcomes: of the frame's attempts.
        attempts: as a map stores them.
    """

    stored: StoredNode
    live: Frame
    found: Localisation
    outcomes: Sequence[Outcome]
    attempts: list[Attempt]

    def withdrawn(self, *, is_the_fix: bool) -> None:
        """Drops the position; for the disproved fix, its match too."""
        self.found = replace(self.found, position=None)
        if is_the_fix:
            self.found = replace(
                self.found,
                status=LocalisationStatus.LOST,
                node=None,
                node_from_live=None,
                covariance=None,
            )
            self.outcomes = ()
            self.attempts = [replace(one, accepted=False) for one in self.attempts]
