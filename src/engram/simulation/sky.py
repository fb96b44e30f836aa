"""Where the sun stands, and how bright sun and sky are."""

from __future__ import annotations

import math
from datetime import datetime

import numpy as np
from numpy.typing import NDArray


def sun_direction(when: datetime, latitude_deg: float, longitude_deg: float) -> NDArray[np.float64]:
    """Unit vector (3,) towards the sun, world axes (x east, y north, z up).

    Args:
        when: UTC.
        latitude_deg: north is positive.
        longitude_deg: east is positive.

    Source: Spencer (1971), declination and equation of time as Fourier series; within 0.2°.
    """
    hour_utc = when.hour + when.minute / 60 + when.second / 3600
    day = 2 * math.pi * (when.timetuple().tm_yday - 1 + (hour_utc - 12) / 24) / 365
    declination = (
        0.006918 - 0.399912 * math.cos(day) + 0.070257 * math.sin(day)
        - 0.006758 * math.cos(2 * day) + 0.000907 * math.sin(2 * day)
    )  # fmt: skip
    equation_min = 229.18 * (
        0.000075 + 0.001868 * math.cos(day) - 0.032077 * math.sin(day)
        - 0.014615 * math.cos(2 * day) - 0.040849 * math.sin(2 * day)
    )  # fmt: skip
    solar_hour = hour_utc + longitude_deg / 15 + equation_min / 60
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
        return 0.16 + 0.62 * math.sqrt(elevation_sine)
    return max(0.0035, 0.16 * 10 ** (elevation_deg / 3.6))
