"""What becomes of what a robot finds: the one thing in which the uses of its loop differ."""

from __future__ import annotations

from dataclasses import dataclass

from engram.frontend import Frame
from engram.localiser.localisation import Localisation, Position
from engram.odometry import Motion


@dataclass(frozen=True, slots=True, eq=False)
class Hint:
    """What a keeper knows of a frame before it is localised.

    Attributes:
        position: where the robot is; None leaves it to the localiser.
        open_loop_m: how far it has come since it last matched what the map knew before; None
            leaves it as it was counted.
        guessed_m: standard deviation of the motion guessed since then; infinite where the robot
            is somewhere near, and must be found again.
        found: what was found of this very frame already; it is not localised again.
    """

    position: Position | None = None
    open_loop_m: float | None = 0.0
    guessed_m: float = 0.0
    found: Localisation | None = None


class Keeper:
    """Keeps what a robot finds. This one keeps nothing.

    For each frame `hint` is called, then `keep`. Before a match is certain for good it may be
    withdrawn: `withdrawn` is called with what `keep` had returned. Whatever a keeper makes of a
    localisation that a withdrawal could undo becomes permanent only after it can no longer come;
    until then the keeper holds it back.
    """

    def hint(self, live: Frame, motion: Motion) -> Hint | None:
        """What is known before the frame is localised; its motion led there."""
        del live, motion
        return None

    def may_propose(self, *, certain: bool) -> bool:
        """Whether places all over the map are tried; `certain` says the robot knows its place."""
        del certain
        return True

    def may_propose_own(self, *, certain: bool) -> bool:
        """The same of nodes that the session itself saved."""
        del certain
        return True

    def keep(self, live: Frame, found: Localisation) -> Localisation:
        """Takes what was found of a frame; returns it with what became of it."""
        del live
        return found

    def withdrawn(self, found: Localisation) -> None:
        """A later frame disproved it: it is to be as if the frame had not been localised."""

    def finish(self) -> None:
        """The drive is over."""


KEEPS_NOTHING = Keeper()
