"""The interval of a forecast: what a mission will miss, calibrated on missions in other towns.

`Coverage` expects a share of the route without a match. In dry weather missions miss less than
that, and by how much depends on how many drives the map holds; the table below says what four in
five of them missed. In rain and showers the same expectation came with 25 to 99 % missed: there is
no interval for them, nor for expectations that calibration met too seldom, nor for missions whose
hour is far from that of any drive in the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Share of missions that the interval holds.
LEVEL = 0.8
# Expected shares between which missions are alike.
BINS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
# Maps of fewer drives are calibrated apart.
MOST_DRIVES = 8
# A mission farther than this from the hour of any drive in the map is in another light, hours.
FARTHEST_H = 3.0
# (low, high) of each bin, for maps of few and of many drives; None where fewer than five missions
# were met. Source: `engram_lab.fits.forecasts fit`, lab/reports/forecasts.md.
INTERVALS: dict[bool, tuple[tuple[float, float] | None, ...]] = {
    # Three bins together: there were twelve such missions.
    True: (None, None, None, *((0.0, 0.01),) * 3, None, None, None, None),
    False: (
        (0.0, 0.01),
        (0.0, 0.01),
        (0.0, 0.02),
        (0.0, 0.12),
        (0.0, 0.14),
        (0.01, 0.46),
        (0.19, 0.52),
        None,
        (0.61, 0.93),
        (0.70, 1.0),
    ),
}


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a mission in dry weather will miss.

    Attributes:
        expected: share of the route without a match that `Coverage` expects.
        low, high: the interval of the share; 0 and 1 if it is not known.
        known: whether calibration met enough such missions.
    """

    expected: float
    low: float
    high: float
    known: bool

    @staticmethod
    def of(expected: float, drives: int, apart_h: float) -> Forecast:
        """The forecast of one mission.

        Args:
            expected: share of the route without a match by `Coverage`.
            drives: sessions in the map.
            apart_h: hours from the mission's start to the time of day of the nearest of them.
        """
        table = INTERVALS[drives < MOST_DRIVES]
        place = int(np.digitize(expected, BINS[1:-1]))
        found = table[place] if apart_h <= FARTHEST_H else None
        if found is None:
            return Forecast(expected, 0.0, 1.0, known=False)
        return Forecast(expected, *found, known=True)

    def text(self) -> str:
        """The forecast as one line of text."""
        if not self.known:
            return (
                "share of the route without a match: not known for such a mission (expected "
                f"{self.expected:.1%})"
            )
        return (
            f"share of the route without a match, dry weather: {self.low:.1%} to {self.high:.1%} "
            f"({LEVEL:.0%} of such missions); not known for rain and showers"
        )
