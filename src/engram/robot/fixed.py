"""Fixes of a satellite receiver: as anchors of nodes, and as places where a lost robot may be."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from engram.frontend import Frame
from engram.localiser import Relocaliser
from engram.localiser.relocalisation import Suggested
from engram.maps import Map
from engram.robot.anchors import NEAR_NS, GivenAnchor
from engram.robot.localisers import relocaliser_in
from engram.robot.session import DriveSequence
from engram.robot.settings import Settings
from engram.sequences import BagSequence
from engram.sequences.bags.fixes import Fix

# Standard deviation of a fix that states none, metres.
_USUAL_SIGMA_M = 5.0

# A robot drives straight enough between fixes that are closer in time.
_APART_NS = 2_000_000_000


def anchors_of_fixes(fixes: Sequence[Fix], nodes_ns: NDArray[np.int64]) -> list[GivenAnchor]:
    """One anchor for each fix that has a node near it in time.

    The receiver's position is interpolated to the time of the node. At a fix a second, the nearest
    fix would be metres off.

    Args:
        fixes: by rising time. The receiver counts as being at the camera.
        nodes_ns: (N,) int64, UTC of the nodes, ns.

    Returns:
        An anchor for each fix; those without a node keep the fix's time.
    """
    times_ns = np.array([one.time_ns for one in fixes], np.int64)
    ordered = np.sort(nodes_ns)
    found = []
    for number, fix in enumerate(fixes):
        time_ns, position = fix.time_ns, (fix.latitude_deg, fix.longitude_deg)
        at = _nearest(ordered, time_ns)
        if at is not None:
            time_ns, position = at, _position(fixes, times_ns, at, number)
        found.append(GivenAnchor(number + 1, None, time_ns, position, None, fix.sigma_m))
    return found


def _nearest(ordered_ns: NDArray[np.int64], time_ns: int) -> int | None:
    """The nearest time of a node; None if it is too far away."""
    after = int(np.searchsorted(ordered_ns, time_ns))
    near = [int(one) for one in ordered_ns[max(after - 1, 0) : after + 1]]
    best = min(near, key=lambda one: abs(one - time_ns), default=None)
    return None if best is None or abs(best - time_ns) > NEAR_NS else best


def _position(
    fixes: Sequence[Fix], times_ns: NDArray[np.int64], at_ns: int, number: int
) -> tuple[float, float]:
    """The receiver's position at a time near a fix: between it and its neighbour."""
    after = int(np.clip(np.searchsorted(times_ns, at_ns), 1, max(len(fixes) - 1, 1)))
    if len(fixes) < 2 or times_ns[after] - times_ns[after - 1] > _APART_NS:
        return fixes[number].latitude_deg, fixes[number].longitude_deg
    a, b = fixes[after - 1], fixes[after]
    share = (at_ns - a.time_ns) / (b.time_ns - a.time_ns)
    return (
        a.latitude_deg + share * (b.latitude_deg - a.latitude_deg),
        a.longitude_deg + share * (b.longitude_deg - a.longitude_deg),
    )


class LatestFix:
    """The newest fix of a stream at a time that rises from call to call.

    Args:
        fixes: by rising time.
    """

    def __init__(self, fixes: Iterator[Fix]) -> None:
        self._fixes = fixes
        self._latest: Fix | None = None
        self._next = next(fixes, None)

    def __call__(self, time_ns: int) -> Fix | None:
        """The newest fix before a time; None if it is older than two seconds."""
        while self._next is not None and self._next.time_ns <= time_ns:
            self._latest, self._next = self._next, next(self._fixes, None)
        latest = self._latest
        return None if latest is None or time_ns - latest.time_ns > _APART_NS else latest


class ToldFix:
    """Latest fix of the robot's GNSS receiver."""

    def __init__(self) -> None:
        self._latest: Fix | None = None

    def tell(self, fix: Fix) -> None:
        """Takes a newer fix."""
        self._latest = fix

    def __call__(self, time_ns: int) -> Fix | None:
        """The newest fix; None if it is more than two seconds from a time."""
        latest = self._latest
        return None if latest is None or abs(time_ns - latest.time_ns) > _APART_NS else latest


def relocaliser_with_fixes(
    opened: Map, sequence: DriveSequence, settings: Settings, name: str | None
) -> str | Relocaliser | None:
    """The relocaliser of a drive, which also proposes nodes near its satellite fixes.

    Args:
        opened: the map; fixes propose nothing in one that is not anchored to the earth.
        sequence: the drive; only bags hold fixes.
        settings: `localiser.fix_sigmas` says how far from a fix nodes are proposed.
        name: key of `RELOCALISERS`; None for none.

    Returns:
        `name`, if there are no fixes to use.
    """
    if not isinstance(sequence, BagSequence) or not settings.localiser.fix_sigmas:
        return name
    fixes = sequence.fixes()
    return name if fixes is None else suggesting(opened, LatestFix(fixes), settings, name)


def suggesting(
    opened: Map, latest: Callable[[int], Fix | None], settings: Settings, name: str | None
) -> str | Relocaliser | None:
    """A relocaliser that also proposes nodes near a receiver's newest fix.

    Args:
        opened: the map; fixes propose nothing in one that is not anchored to the earth.
        latest: the newest fix at a time, ns; None without one.
        settings: `localiser.fix_sigmas` says how far from a fix nodes are proposed.
        name: key of `RELOCALISERS`; None for none.

    Returns:
        `name`, if fixes are not to be used.
    """
    sigmas = settings.localiser.fix_sigmas
    if not sigmas or opened.frame.origin is None:
        return name
    inner = None if name is None else relocaliser_in(opened, name, settings.frontend.descriptor)
    return Suggested(inner, nodes_near(opened, latest, sigmas))


def nodes_near(
    opened: Map, latest: Callable[[int], Fix | None], sigmas: float
) -> Callable[[Frame], list[int]]:
    """The nodes near the newest fix, for `Suggested`.

    Args:
        opened: the map, anchored to the earth.
        latest: the newest fix at a time, ns; None without one.
        sigmas: how far from a fix, in its standard deviations.
    """
    frame = opened.frame

    def suggest(live: Frame) -> list[int]:
        fix = latest(live.stamp_ns)
        if fix is None:
            return []
        within_m = sigmas * (fix.sigma_m or _USUAL_SIGMA_M)
        return frame.near(fix.latitude_deg, fix.longitude_deg, within_m)

    return suggest
