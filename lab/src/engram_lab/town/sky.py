"""Where the sun stands, and how bright sun and sky are."""

from __future__ import annotations

import math
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

_J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)


def sun_direction(when: datetime, latitude_deg: float, longitude_deg: float) -> NDArray[np.float64]:
    """Unit vector (3,) towards the sun, world axes (x east, y north, z up).

    Args:
        when: UTC.
        latitude_deg: north is positive.
        longitude_deg: east is positive.

    Source: the Astronomical Almanac's low-precision formulae, within 0.01° from 1950 to 2050.
    """
    days = (when - _J2000).total_seconds() / 86400
    mean_longitude = math.radians((280.460 + 0.9856474 * days) % 360)
    anomaly = math.radians((357.528 + 0.9856003 * days) % 360)
    ecliptic = mean_longitude + math.radians(
        1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly)
    )
    obliquity = math.radians(23.439 - 4e-7 * days)
    declination = math.asin(math.sin(obliquity) * math.sin(ecliptic))
    ascension = math.atan2(math.cos(obliquity) * math.sin(ecliptic), math.cos(ecliptic))
    # The equation of time: how far the true sun is ahead of the mean one, as an angle.
    ahead = math.remainder(mean_longitude - ascension, 2 * math.pi)
    hour_utc = when.hour + when.minute / 60 + when.second / 3600
    solar_hour = hour_utc + longitude_deg / 15 + math.degrees(ahead) / 15
    angle = math.radians(15 * (solar_hour - 12))
    latitude = math.radians(latitude_deg)
    east = -math.cos(declination) * math.sin(angle)
    north = math.cos(latitude) * math.sin(declination) - math.sin(latitude) * math.cos(
        declination
    ) * math.cos(angle)
    up = math.sin(latitude) * math.sin(declination) + math.cos(latitude) * math.cos(
        declination
    ) * math.cos(angle)
    return np.array([east, north, up])


def clear_sun_power(elevation_sine: float) -> float:
    """Irradiance / π of the direct sun through clear air, in units where the noon sky is about 1.

    Extinction by air mass (Kasten and Young 1989, simplified to 1/sin with a floor).
    """
    if elevation_sine <= 0:
        return 0.0
    return 5.2 * math.exp(-0.21 / max(elevation_sine, 0.035))


def clear_sky_power(elevation_sine: float) -> float:
    """Mean luminance of a clear sky; falls by about a factor ten for every 3° below −2°."""
    elevation_deg = math.degrees(math.asin(max(-1.0, min(1.0, elevation_sine))))
    if elevation_deg >= 0:
        return 0.14 + 0.53 * math.sqrt(elevation_sine)
    return max(0.0035, 0.14 * 10 ** (elevation_deg / 3.6))
