"""A stream that stands still while the robot moves: a frozen driver, a player that holds a picture.

A standing robot and a frozen stream look alike. Two things tell them apart. No two pictures of a
real sensor are equal, not even at rest, so pixels that repeat are an old picture, whatever text is
burnt in; only wheels at rest excuse a simulator without noise. And where wheels or a gyroscope that
have agreed with the images so far say that the robot moves, pictures that stand still are old,
though a driver or a compressor added noise to them.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.frontend import StereoPair
from engram.geometry import SE3
from engram.odometry.outside import OutsideMotion

# Every so many-th pixel is compared, both ways.
_STEP = 4
# Pixels this close to black or white say nothing: noise is cut off there.
_BLACK, _WHITE = 2, 253
# Fewer pixels than this share say nothing: the image is dark.
_LEAST = 0.05


@dataclass(frozen=True, slots=True)
class FrozenConfig:
    """When pictures count as old. Source: `lab/reports/fixed.md`."""

    equal_share: Annotated[
        float,
        Meta(
            gt=0,
            le=1,
            description="share of equal pixels from which a picture repeats an earlier one; noise "
            "of half a grey level leaves half of them equal",
        ),
    ] = 0.9
    pictures: Annotated[
        int, Meta(ge=1, description="earlier pictures that each is compared with")
    ] = 4
    rest_m: Annotated[
        float, Meta(ge=0, description="distance by wheels between frames that is rest, m")
    ] = 0.02
    rest_rad: Annotated[
        float, Meta(ge=0, description="turn from frame to frame that is rest, rad")
    ] = float(np.deg2rad(0.2))
    moved_m: Annotated[
        float,
        Meta(gt=0, description="distance by wheels, m, over which a still picture is old"),
    ] = 0.3
    moved_rad: Annotated[float, Meta(gt=0, description="turn over which it is old, rad")] = float(
        np.deg2rad(10.0)
    )
    still_share: Annotated[
        float,
        Meta(gt=0, lt=1, description="share of that motion, below which the picture stands still"),
    ] = 0.25

    def __post_init__(self) -> None:
        check_bounds(self)


class Repeats:
    """Recognises pictures that repeat an earlier one.

    Args:
        config: the limits.
    """

    def __init__(self, config: FrozenConfig) -> None:
        self._config = config
        self._last: deque[tuple[NDArray[np.uint8], NDArray[np.uint8]]] = deque(
            maxlen=config.pictures
        )

    def sides(self, pair: StereoPair) -> tuple[bool, bool]:
        """Whether the left and the right picture repeat one of the last pairs.

        Every fourth pixel both ways is compared, by a copy: a camera's driver may fill the same
        arrays again and again.
        """
        left, right = (one[::_STEP, ::_STEP].copy() for one in (pair.left, pair.right))
        found = [
            (self._equal(left, before[0]), self._equal(right, before[1])) for before in self._last
        ]
        self._last.append((left, right))
        both = next((one for one in found if all(one)), None)
        return both or next((one for one in reversed(found) if any(one)), (False, False))

    def _equal(self, now: NDArray[np.uint8], before: NDArray[np.uint8]) -> bool:
        return equal_share(now, before) >= self._config.equal_share


def equal_share(now: NDArray[np.uint8], before: NDArray[np.uint8]) -> float:
    """Share of the pixels of two pictures that are equal, of those that are not black or white.

    Args:
        now: (h, w) uint8 grey.
        before: (h, w) uint8 grey.

    Returns:
        The share; 0 where the picture is too dark or too bright to decide.
    """
    tells = (now > _BLACK) & (now < _WHITE)
    count = np.count_nonzero(tells)
    if count < _LEAST * now.size:
        return 0.0
    return np.count_nonzero(tells & (now == before)) / count


class StandsStill:
    """Recognises pictures that stand still while wheels or a gyroscope say that the robot moves.

    Args:
        config: the limits.
    """

    def __init__(self, config: FrozenConfig) -> None:
        self._config = config
        self._seen = self._told = SE3.identity()
        self._still = False

    def add(self, seen: SE3 | None, told: OutsideMotion | None) -> bool:
        """Whether the picture is old.

        Args:
            seen: prev_from_curr by odometry; None if it failed.
            told: the same motion by a trusted source; None without one.
        """
        if seen is None or told is None:
            self._begin()
            self._still = False
            return False
        self._seen, self._told = self._seen @ seen, self._told @ told.prev_from_curr
        config = self._config
        way_m = self._told.distance_m if told.has_way else 0.0
        turn_rad = self._told.angle_rad
        if way_m >= config.moved_m or turn_rad >= config.moved_rad:
            stood_m = self._seen.distance_m < config.still_share * max(way_m, config.moved_m)
            unturned = self._seen.angle_rad < config.still_share * config.moved_rad
            self._still = stood_m and unturned
            self._begin()
        elif self._seen.distance_m > config.moved_m or self._seen.angle_rad > config.moved_rad:
            self._still = False
            self._begin()
        return self._still

    def _begin(self) -> None:
        self._seen = self._told = SE3.identity()


def rests(told: OutsideMotion | None, config: FrozenConfig) -> bool:
    """Whether wheels say that the robot stands.

    Args:
        told: the motion from frame to frame by a trusted source; None without one.
        config: the limits.
    """
    if told is None or not told.has_way:
        return False
    moved = told.prev_from_curr
    return moved.distance_m <= config.rest_m and moved.angle_rad <= config.rest_rad
