"""The interval of a forecast: what a mission will miss, calibrated on missions in other towns.

`Coverage` expects a share of the route without a match, and its level is too dark in dry weather
and too bright in wet. So a mission is compared with those that calibration met: in the same kind of
weather, in a map of about as many drives, in the light of one of them or not, and with about as
much expected to be lost by the nodes left out. The table below says what four in five of those
missed. Where calibration met too few, or their towns differ too much, nothing is promised.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

import numpy as np

from engram.fleet.download.daylight import light_apart_deg, nearest_hours
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.stock import Stock

Interval: TypeAlias = tuple[float, float]

# Share of missions that the interval holds.
LEVEL = 0.8
# Losses by nodes left out, of the expected share, between which missions are alike.
BINS = (0.0, 0.02, 0.15, 0.3, 0.45, 0.6, 0.75, 1.0)
# Maps of fewer drives are calibrated apart.
MOST_DRIVES = 8
# A mission is in the light of a drive if the sun stands as high, to so many degrees between dusk
# and a low sun; without a known latitude, if it is within so many hours.
ALIKE_DEG = 4.0
ALIKE_H = 3.0


class Weather(StrEnum):
    """What the camera looks through."""

    DRY = "dry"
    SHOWERS = "showers"
    RAIN = "rain"


@dataclass(frozen=True, slots=True)
class Light:
    """Whether the map contains drives in the mission's light.

    Attributes:
        alike: whether some drive of the map had the same; None if that is unknown.
    """

    alike: bool | None

    @staticmethod
    def of(stock: Stock, options: DownloadOptions) -> Light:
        """By the height of the sun where the latitude is known, else by the hour."""
        apart_deg = light_apart_deg(stock, options)
        if apart_deg is not None:
            return Light(apart_deg <= ALIKE_DEG)
        return Light(True if nearest_hours(stock, options) <= ALIKE_H else None)


def _few(*known: Interval | None) -> tuple[Interval | None, ...]:
    """Intervals of the first bins; none for the others."""
    return known + (None,) * (len(BINS) - 1 - len(known))


# (low, high) of each bin, by weather, by whether a drive of the map had the mission's light, and by
# whether the map has few drives. Source: `engram_lab.fits.forecasts fit`, lab/reports/downloads.md.
INTERVALS: dict[tuple[Weather, bool, bool], tuple[Interval | None, ...]] = {
    (Weather.DRY, True, True): _few((0.0, 0.01), (0.0, 0.08)),
    (Weather.DRY, True, False): (
        (0.0, 0.005),
        (0.0, 0.005),
        (0.0, 0.09),
        (0.0, 0.145),
        (0.195, 0.515),
        (0.725, 0.905),
        (0.705, 1.0),
    ),
    (Weather.DRY, False, True): _few((0.165, 0.605), (0.435, 0.885)),
    (Weather.SHOWERS, True, True): ((0.315, 0.535),) * (len(BINS) - 1),
    (Weather.RAIN, False, True): ((0.995, 1.0),) * (len(BINS) - 1),
}


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a mission will miss, for each kind of weather that it may meet.

    Attributes:
        expected: share of the route without a match that `Coverage` expects.
        missed: ends of the interval of the share by weather; None where it is not known.
    """

    expected: float
    missed: dict[Weather, Interval | None]

    @staticmethod
    def of(expected: float, lost: float, drives: int, light: Light) -> Forecast:
        """The forecast of one mission.

        Args:
            expected: share of the route without a match by `Coverage`.
            lost: of that, by nodes that are left out.
            drives: sessions in the map.
            light: whether the map contains drives in the mission's light.
        """
        place = int(np.digitize(lost, BINS[1:-1]))
        missed: dict[Weather, Interval | None] = dict.fromkeys(Weather)
        if light.alike is not None:
            for weather in Weather:
                table = INTERVALS.get((weather, light.alike, drives < MOST_DRIVES), _few())
                missed[weather] = table[place]
        return Forecast(expected, missed)

    def text(self) -> str:
        """The forecast as one line of text."""
        told = ", ".join(
            f"{weather} " + ("not known" if one is None else f"{one[0]:.1%} to {one[1]:.1%}")
            for weather, one in self.missed.items()
        )
        return f"route without a match in {LEVEL:.0%} of such missions: {told}"
