"""Light and weather of a drive: sun, sky, and how they change while it lasts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError

# Lamps (15 lx below), headlights (20 lx ten metres ahead) and windows (60 cd/m²) as they are beside
# the sky at dusk: 50 lx from a sun 3° down.
LAMP_POWER = 0.35  # of a street lamp, luminance × m² of a white surface
WINDOW = 0.02  # luminance of a lit window
BEAM = 0.3  # power of the robot's headlights
AUREOLE = 0.1  # share of the sun's light that comes from around it and fills shadows
MIRRORS = 0.5  # of what wet tarmac throws back; the rest is scattered by its grain
# At night, with what lit walls and windows throw on each other, which is not traced; and by how
# much more clouds throw back (3 to 10 times overcast: Kyba et al. 2011).
_TOWN_GLOW, _GLOW_OF_CLOUDS = 0.0003, 2.0

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
    return 0.14 * 10 ** (elevation_deg / 3.6)


@dataclass(frozen=True, slots=True)
class Weather:
    """What the sky does, apart from the hour.

    Attributes:
        cloud: share of the sky that is covered, on average over the drive, 0…1.
        changes: how far that share swings along the way, 0…1.
        fog_per_m: extinction of the air.
        rain_mm_h: that falls; `changes` makes it come and go.
        wet: film of water on the ground, 0…1.
        snow: how much lies; thin at 0.3, where wheels and patches show the ground; all from 0.5.
    """

    cloud: float = 0.0
    changes: float = 0.0
    fog_per_m: float = 0.0
    rain_mm_h: float = 0.0
    wet: float = 0.0
    snow: float = 0.0


WEATHERS: dict[str, Weather] = {
    "clear": Weather(cloud=0.04),
    "fair": Weather(cloud=0.35, changes=0.12),
    "broken": Weather(cloud=0.55, changes=0.45),
    "overcast": Weather(cloud=1.0, fog_per_m=0.0008),
    "fog": Weather(cloud=1.0, fog_per_m=0.035),
    # Rain clears the air but for its own drops; snow lies, the fall is over.
    "rain": Weather(cloud=1.0, changes=0.2, fog_per_m=0.0015, rain_mm_h=4.0, wet=1.0),
    "showers": Weather(cloud=0.75, changes=0.5, fog_per_m=0.001, rain_mm_h=2.0, wet=0.7),
    "damp": Weather(cloud=0.9, changes=0.2, fog_per_m=0.001, wet=0.7),
    "snow": Weather(cloud=1.0, fog_per_m=0.001, snow=0.3),
    "thaw": Weather(cloud=0.6, changes=0.3, wet=0.6, snow=0.15),
}


@dataclass(frozen=True, slots=True)
class Place:
    """Where on earth the town stands."""

    latitude_deg: float
    longitude_deg: float


OXFORD = Place(51.75, -1.26)


@dataclass(frozen=True, slots=True)
class Moment:
    """Light and weather at one point of a drive.

    Attributes:
        sun_direction: (3,) towards the sun, world axes.
        sun_power: irradiance / π of the sun on a surface that faces it; 0 behind a cloud.
        sky_power: mean luminance of the sky.
        cloud: share of the sky covered.
        cloud_shift: (2,) drift of the clouds, in the noise's texels.
        fog_per_m, haze: extinction; luminance of the air as a factor of the sky's.
        wet, snow: 0…1.
        rain_mm_h: that falls.
        lamps_on: street lamps and lit windows.
        headlights_on: of the robot and of others.
        sun_deg: height of the sun.
    """

    sun_direction: NDArray[np.float64]
    sun_power: float
    sky_power: float
    cloud: float
    cloud_shift: tuple[float, float]
    fog_per_m: float
    haze: float
    wet: float
    snow: float
    rain_mm_h: float
    lamps_on: bool
    headlights_on: bool
    sun_deg: float


@dataclass(frozen=True, slots=True)
class Conditions:
    """Light and weather of one drive.

    Attributes:
        start: UTC, with its zone.
        weather: key in `WEATHERS`.
        seed: of how the clouds pass.
        place: where.
        rain_mm_h: mean rate, in place of the weather's.
    """

    start: datetime
    weather: str
    seed: int
    place: Place = OXFORD
    rain_mm_h: float | None = None

    def __post_init__(self) -> None:
        if self.weather not in WEATHERS:
            known = ", ".join(WEATHERS)
            raise ConfigError(f"unknown weather '{self.weather}'; known are: {known}")

    @property
    def hour(self) -> float:
        """Mean solar time, hours."""
        utc = self.start.hour + self.start.minute / 60 + self.start.second / 3600
        return (utc + self.place.longitude_deg / 15) % 24

    @property
    def season(self) -> int:
        """0 with leaves, 1 autumn, 2 bare."""
        day = self.start.timetuple().tm_yday
        if self.leaves == 0:
            return 2
        return 0 if day < 275 else 1

    @property
    def leaves(self) -> float:
        """Share of the leaves that are out: from mid-April on, and falling till mid-November."""
        day = self.start.timetuple().tm_yday
        return float(np.interp(day, [104, 135, 285, 320], [0, 1, 1, 0]))

    def at(self, driven_m: float, elapsed_s: float) -> Moment:
        """Light and weather after so far and so long.

        The sun stands still during a drive (it moves 1° in four minutes); clouds pass over the
        robot every 50 to 300 m, and lamps come on one minute into civil twilight.
        """
        weather, swing = WEATHERS[self.weather], _drift(self.seed, driven_m)
        rate = weather.rain_mm_h if self.rain_mm_h is None else self.rain_mm_h
        rate *= max(0.0, 1 + 1.6 * weather.changes * swing)
        sun = self._sun(0.0)
        cloud = float(np.clip(weather.cloud + weather.changes * swing, 0, 1))
        shade = 1.0 if cloud > 0.97 else _shade(cloud, _drift(self.seed + 1, driven_m))
        height_deg = float(np.degrees(np.arcsin(self._sun(elapsed_s)[2])))
        dark = min(rate / 2.0, 1.0)  # how much of a rain cloud stands overhead
        return Moment(
            sun_direction=sun if sun[2] > 0 else np.array([0.0, 0.0, 1.0]),
            sun_power=clear_sun_power(float(sun[2])) * (1 - shade),
            sky_power=max(
                clear_sky_power(float(sun[2])) * (1 + 0.9 * cloud - 0.45 * dark),
                _TOWN_GLOW * (1 + _GLOW_OF_CLOUDS * cloud),
            ),
            cloud=cloud,
            cloud_shift=(0.31 * elapsed_s + 17.0 * (self.seed % 97), 0.07 * elapsed_s),
            # Extinction by the drops themselves (Atlas 1953).
            fog_per_m=weather.fog_per_m + 0.0002 * rate**0.63,
            haze=0.9,
            wet=weather.wet,
            snow=weather.snow,
            rain_mm_h=rate,
            lamps_on=height_deg < -1.0,
            headlights_on=height_deg < 1.5 or weather.fog_per_m > 0.01 or rate > 0.1,
            sun_deg=height_deg,
        )

    def _sun(self, elapsed_s: float) -> NDArray[np.float64]:
        when = self.start + timedelta(seconds=elapsed_s)
        return sun_direction(when, self.place.latitude_deg, self.place.longitude_deg)


def _drift(seed: int, driven_m: float) -> float:
    """A slow function of distance, −1…1: three waves of 90 to 400 m with phases of the seed."""
    rng = np.random.default_rng([seed & 0x7FFFFFFF, 0xC10D])
    lengths_m = rng.uniform([90, 150, 260], [150, 260, 400])
    phases = rng.uniform(0, 2 * np.pi, 3)
    waves = np.sin(2 * np.pi * driven_m / lengths_m + phases)
    return float(np.tanh(0.9 * waves.sum()))


def _shade(cloud: float, drift: float) -> float:
    """Share of the sun that clouds take: none, part or all, with soft transitions."""
    if cloud < 0.15:
        return 0.0
    edge = 1 - 2 * cloud  # the drift lies above it for about the covered share of the way
    return float(np.clip((drift - edge) / 0.25 + 0.5, 0, 1))
