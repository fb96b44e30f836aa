"""Two streams of images become pairs of one instant."""

from __future__ import annotations

from collections import OrderedDict


class Pairs:
    """Pairs the images of two topics by stamp; images without a partner are counted and left out.

    Args:
        tolerance_ns: largest difference of the stamps of a pair.
        waiting: images of a side that wait for their partner.
    """

    def __init__(self, tolerance_ns: int, waiting: int = 8) -> None:
        self.single = 0
        self._tolerance_ns = tolerance_ns
        self._waiting = waiting
        self._images = (OrderedDict(), OrderedDict())

    def add(self, side: int, stamp_ns: int, image):
        """Takes an image of the left (0) or right (1) side.

        Returns:
            (stamp_ns of the left image, left, right), or None while a partner is missing.
        """
        others = self._images[1 - side]
        nearest = min(others, key=lambda other: abs(other - stamp_ns), default=None)
        if nearest is None or abs(nearest - stamp_ns) > self._tolerance_ns:
            mine = self._images[side]
            mine[stamp_ns] = image
            while len(mine) > self._waiting:
                mine.popitem(last=False)
                self.single += 1
            return None
        partner = others.pop(nearest)
        self._forget_older(nearest, 1 - side)
        self._forget_older(stamp_ns, side)
        if side == 0:
            return stamp_ns, image, partner
        return nearest, partner, image

    def _forget_older(self, stamp_ns: int, side: int) -> None:
        waiting = self._images[side]
        for old in [one for one in waiting if one < stamp_ns]:
            del waiting[old]
            self.single += 1
