"""What happens to each localisation: the one part in which the uses of the robot's loop differ."""

from __future__ import annotations

from dataclasses import dataclass

from engram.frontend import Frame
from engram.localiser.localisation import Localisation, Position
from engram.odometry import Motion


@dataclass(frozen=True, slots=True, eq=False)
class Hint:
    """What a keeper contributes about a frame before it is localised.

    Attributes:
        position: where the robot is; None leaves it to the localiser.
        open_loop_m: distance driven since the last match with the map, metres; None keeps the
            localiser's own count.
        guessed_m: standard deviation of the motion guessed since then, metres; infinite if the
            robot is only roughly known and must be found again.
        agreed: number of fixes that confirm the position; 0 if only the caller supplied it.
        found: an earlier result for this frame, which is then not localised again.
    """

    position: Position | None = None
    open_loop_m: float | None = 0.0
    guessed_m: float = 0.0
    agreed: int = 0
    found: Localisation | None = None


class Keeper:
    """Keeps the results of a robot. This base class keeps nothing.

    For each frame the robot calls `hint`, then `keep`. It may later withdraw a match: it calls
    `withdrawn` with the result of `keep`. A keeper holds back whatever a withdrawal would undo
    until a withdrawal is no longer possible.
    """

    def hint(self, live: Frame, motion: Motion) -> Hint | None:
        """The keeper's contribution before the frame is localised; `motion` led to it."""
        del live, motion
        return None

    def may_propose(self, *, certain: bool) -> bool:
        """Whether to try places all over the map; `certain` if the position is known."""
        del certain
        return True

    def may_propose_own(self, *, certain: bool) -> bool:
        """The same for nodes that the session itself saved."""
        del certain
        return True

    def alone_m(self) -> float:
        """Distance driven since the nodes being saved lost their connection to the map, metres.

        0 while connected.
        """
        return 0.0

    def keep(self, live: Frame, found: Localisation) -> Localisation:
        """Keeps the result for a frame; returns it, completed by what was stored."""
        del live
        return found

    def withdrawn(self, found: Localisation) -> None:
        """A later frame disproved the match: treat the frame as not localised."""

    def finish(self) -> None:
        """The drive is over."""


KEEPS_NOTHING = Keeper()
