"""Anchors from the fixes of a satellite receiver, at the times of the nodes near them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from engram.robot.anchors import NEAR_NS, GivenAnchor
from engram.sequences.bags.fixes import Fix

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
