"""Height of the sun from the day, the hour of day and a latitude."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_TROPIC_DEG = 23.44
_YEAR_DAYS = 365.2425
# From the winter solstice to the first of January.
_SOLSTICE_DAYS = 10.0


def sun_height_deg(day: ArrayLike, hour: ArrayLike, latitude_deg: float) -> NDArray[np.float64]:
    """Height of the sun over the horizon, degrees; negative at night.

    Accurate to 2°, as mean solar time leaves out the equation of time.

    Args:
        day: float or (N,) float64, days since 1 January 0:00 of any year.
        hour: float or (N,) float64, hour of day, mean solar time (method §2.8).
        latitude_deg: latitude, degrees, north positive.

    Returns:
        (N,) float64, or one if both are; degrees.

    Source: Cooper, "The absorption of radiation in solar stills", 1969 (declination).
    """
    turned = 2 * np.pi * (np.asarray(day, np.float64) + _SOLSTICE_DAYS) / _YEAR_DAYS
    declination = np.deg2rad(-_TROPIC_DEG * np.cos(turned))
    angle = np.deg2rad(15 * (np.asarray(hour, np.float64) - 12))
    latitude = np.deg2rad(latitude_deg)
    up = np.sin(latitude) * np.sin(declination)
    up = up + np.cos(latitude) * np.cos(declination) * np.cos(angle)
    return np.asarray(np.rad2deg(np.arcsin(np.clip(up, -1.0, 1.0))), np.float64)


def day_of_year(stamp_ns: int) -> float:
    """Days since 1 January 0:00 UTC, accurate to a day, for a year of mean length."""
    return stamp_ns / 86_400e9 % _YEAR_DAYS
