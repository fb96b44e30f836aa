"""Campaigns: reproducible lists of drives, named after the papers' data sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from functools import lru_cache

import numpy as np

from engram.errors import ConfigError
from engram_lab.town.camera_model import CLEAN, Lens
from engram_lab.town.conditions import OXFORD, Place
from engram_lab.town.glass import Glass
from engram_lab.town.rainfall import STEP, Rainfall, rates_exceeded
from engram_lab.town.streets import (
    Fronts,
    Route,
    StreetPlan,
    crossing_loops,
    equal_rings,
    loop_of_length,
)

# Raised whenever a frame of any campaign changes: rendered data is kept by it.
WORLD_VERSION = 7


_SUMMER_TIME = timedelta(hours=1)
# From when to when the hour of a drive says more than its sky, UTC.
_NIGHT_H, _MORNING_H = 22, 4


class Size(StrEnum):
    """How much of a campaign: what fits working machines, or the papers' own sizes."""

    STANDARD = "standard"
    FULL = "full"

    @classmethod
    def named(cls, text: str) -> Size:
        """By the name that is given on the command line.

        Raises:
            ConfigError: there is no such size.
        """
        try:
            return cls(text)
        except ValueError:
            raise ConfigError(f"size {text!r} is unknown; known: {', '.join(cls)}") from None


@dataclass(frozen=True, slots=True)
class SessionPlan:
    """One drive.

    Attributes:
        number: within its home campaign, in the order of time.
        start: UTC.
        weather: key in `WEATHERS`.
        robot: key in `ROBOTS`.
        reverse: driven the other way round.
        seed: of the driving line, the noise, the traffic and the clouds.
        lens: what is wrong with the front lens.
        beside: driven along the route beside the campaign's.
        rain_mm_h: mean rate on the drive; None for the weather's own.
        night_in_name: whether the name of a night drive has `night` in place of its weather.
    """

    number: int
    start: datetime
    weather: str
    robot: str
    reverse: bool
    seed: int
    lens: Lens = CLEAN
    beside: bool = False
    rain_mm_h: float | None = None
    night_in_name: bool = False

    @property
    def name(self) -> str:
        """Such as ``007-0812T0930-overcast-wildcat``."""
        way = ("-reverse" if self.reverse else "") + ("-beside" if self.beside else "")
        seen = self._night_or_weather if self.night_in_name else self.weather
        return f"{self.number:03d}-{self.start:%m%dT%H%M}-{seen}-{self.robot}{way}"

    @property
    def words(self) -> str:
        """Such as ``Tue 09:30, overcast``, for people; a night by its name, whatever its sky."""
        return f"{self.start:%a %H:%M}, {self._night_or_weather}"

    @property
    def _night_or_weather(self) -> str:
        night = self.start.hour >= _NIGHT_H or self.start.hour < _MORNING_H
        return "night" if night else self.weather


@dataclass(frozen=True, slots=True)
class Campaign:
    """A town, a route in it, and the drives.

    Attributes:
        name: key in `CAMPAIGNS`.
        seed: of the town and all drives.
        length_m: of the route.
        crossing: a route of several loops that meet, instead of one loop.
        sessions: in the order of time.
        traffic: how many cars and people move, 0…1.
        size: how much of it this is.
        home: campaign whose town and drives these are: `begbroke` at standard size is the part
            of `begbroke24h` by day, and is not rendered again.
        parked_share: of the parking places that are taken.
        spacing_m: way between frames.
        begins_m: way along the route to the first frame.
        place: where on earth.
        fronts: how the fronts repeat; None where each is unique.
        town_in_names: whether the names of its robots in logs contain town and seed, so that the
            robots of two towns differ (method §2.7).
        first_day: from which structural change counts.
    """

    name: str
    seed: int
    length_m: float
    crossing: bool
    sessions: tuple[SessionPlan, ...]
    traffic: float
    size: Size
    home: str
    parked_share: float = 0.45
    spacing_m: float = 0.7
    begins_m: float = 0.0
    place: Place = OXFORD
    fronts: Fronts | None = None
    town_in_names: bool = True

    @property
    def first_day(self) -> int:
        """Proleptic ordinal of the first drive's date; a part of a campaign begins with it."""
        if self.name == self.home:
            return self.sessions[0].start.toordinal()
        return CAMPAIGNS[self.home](self.seed, self.size).first_day

    def plan(self) -> tuple[StreetPlan, Route]:
        """Where its streets run and the route that is driven."""
        if self.fronts is not None:
            return equal_rings(self.fronts, self.seed)
        return (crossing_loops if self.crossing else loop_of_length)(self.length_m, self.seed)

    def session(self, number: int) -> SessionPlan:
        """One of its drives.

        Raises:
            ConfigError: no such number.
        """
        if not 0 <= number < len(self.sessions):
            raise ConfigError(
                f"campaign '{self.name}' has sessions 0 to {len(self.sessions) - 1}, not {number}"
            )
        return self.sessions[number]


def campaign_named(name: str, seed: int = 1, size: Size = Size.STANDARD) -> Campaign:
    """A campaign by name.

    Raises:
        ConfigError: no such campaign, or the seed is outside 0 to 2³¹ − 1.
    """
    if name not in CAMPAIGNS:
        raise ConfigError(f"unknown campaign '{name}'; known are: {', '.join(CAMPAIGNS)}")
    if not 0 <= seed < 2**31:
        raise ConfigError(f"seed is {seed}, must be 0 to {2**31 - 1}")
    return CAMPAIGNS[name](seed, size)


_DAMP_FOR = timedelta(minutes=60)  # after rain


def _under(rain: Rainfall, plans: tuple[SessionPlan, ...]) -> tuple[SessionPlan, ...]:
    """The same drives, where it rains when and as hard as a course of rain has it."""
    first = plans[0].start - _DAMP_FOR
    now = rain.at(first, [plan.start for plan in plans])
    before = rain.at(first, [plan.start - _DAMP_FOR / 2 for plan in plans])
    sessions = []
    for plan, rate, earlier in zip(plans, now, before, strict=True):
        if rate > 0:
            sessions.append(replace(plan, weather="rain", rain_mm_h=rate))
        else:
            sessions.append(replace(plan, weather="damp") if earlier > 0 else plan)
    return tuple(sessions)


@lru_cache(maxsize=64)
def _dry_august(seed: int, starts: tuple[datetime, ...]) -> Rainfall:
    """A course of rain as in August 2013, when the papers drove: 19 mm, on 2 or 3 of 140 laps."""
    first = starts[0] - _DAMP_FOR
    steps = int((starts[-1] - first) / STEP)
    fewest, most = 2 * len(starts) // 140, -(-3 * len(starts) // 140)
    for course in range(10_000):
        rain = Rainfall(seed + 104_729 * course, _AUGUST_WET)
        wet_laps = sum(rate > 0 for rate in rain.at(first, starts))
        if fewest <= wet_laps <= most and abs(rain.fallen_mm(steps) - _AUGUST_MM) < 2:
            return rain
    raise ConfigError(f"seed {seed}: no course of rain of {_AUGUST_MM:g} mm found; take another")


_AUGUST_MM, _AUGUST_WET = 19.0, 0.0195


def _planned(
    name: str, seed: int, starts: list[datetime], weathers: list[str], robots: list[str],
    reverse: list[bool],
) -> tuple[SessionPlan, ...]:  # fmt: skip
    order = sorted(range(len(starts)), key=lambda k: (starts[k], k))
    base = int(np.random.default_rng([seed, *name.encode()]).integers(2**30))
    return tuple(
        SessionPlan(
            number, starts[k], weathers[k], robots[k], reverse[k], base + 7919 * number,
            Lens(dirt=0.4) if (base + number) % 13 == 5 else CLEAN,
        )
        for number, k in enumerate(order)
    )  # fmt: skip


# How often each sky comes in a summer; rain comes by its own course.
_SUMMER = {"clear": 0.21, "fair": 0.17, "broken": 0.29, "overcast": 0.33}


def _dealt(rng: np.random.Generator, count: int) -> list[str]:
    """Skies of some drives in the shares of the summer, to within one drive, in random order.

    Ten that are drawn one by one can miss the sun, and nothing would ever fail there.
    """
    names, shares = list(_SUMMER), list(_SUMMER.values())
    at = (rng.random() + np.arange(count)) / count
    dealt = np.searchsorted(np.cumsum(shares)[:-1], at, side="right")
    return [names[k] for k in rng.permutation(dealt)]


def by_day(start: datetime) -> bool:
    """Whether a drive sets out between 7 and 19 h, summer time."""
    return 7 <= (start + _SUMMER_TIME).hour < 19


def _spread(
    rng: np.random.Generator, first: datetime, days: int, count: int, hours: tuple[float, float]
) -> list[datetime]:
    """`count` starts over some days, each within the hours (UTC)."""
    day = np.sort(rng.integers(0, days, count))
    hour = rng.uniform(*hours, count)
    return [
        first + timedelta(days=int(d), minutes=round(60 * float(h)))
        for d, h in zip(day, hour, strict=True)
    ]


def _hamlet(seed: int, size: Size) -> Campaign:
    first = datetime(2025, 7, 14, tzinfo=UTC)
    drives = [
        (0, 8.5, "clear", "wildcat"), (0, 17.0, "clear", "courier"),
        (1, 11.0, "overcast", "wildcat"), (1, 22.5, "fair", "wildcat"),
        (2, 10.0, "rain", "courier"), (3, 9.0, "fair", "wildcat"),
    ]  # fmt: skip
    starts = [first + timedelta(days=d, hours=h) for d, h, _, _ in drives]
    sessions = _planned(
        "hamlet", seed, starts, [d[2] for d in drives], [d[3] for d in drives], [False] * 6
    )
    return Campaign("hamlet", seed, 150, False, sessions, 0.4, size, "hamlet")


def _village(seed: int, size: Size) -> Campaign:
    """24 drives that meet every condition there is, by two robots."""
    first = datetime(2025, 6, 20, tzinfo=UTC)
    drives = [
        (0, 6.5, "clear"), (0, 9.5, "clear"), (0, 13.0, "clear"), (0, 17.5, "clear"),
        (1, 9.5, "overcast"), (1, 14.0, "broken"), (2, 10.0, "rain"), (2, 22.8, "overcast"),
        (3, 9.7, "fair"), (4, 12.0, "showers"), (5, 5.5, "fog"), (6, 17.0, "fair"),
        (8, 21.3, "clear"), (10, 1.5, "clear"), (12, 11.0, "overcast"), (20, 16.0, "broken"),
        (40, 9.0, "clear"), (61, 19.3, "fair"), (110, 10.0, "overcast"), (125, 15.0, "clear"),
        (150, 17.2, "damp"), (190, 11.0, "snow"), (192, 13.0, "thaw"), (200, 12.0, "clear"),
    ]  # fmt: skip
    starts = [first + timedelta(days=d, hours=h) for d, h, _ in drives]
    robots = ["courier" if k % 4 == 2 else "wildcat" for k in range(len(drives))]
    sessions = _planned(
        "village", seed, starts, [d[2] for d in drives], robots, [k % 8 == 5 for k in range(24)]
    )
    # On one drive something lies over the lenses for some metres.
    hidden = replace(sessions[15], lens=Lens(covered_from_m=200.0, covered_to_m=208.0))
    sessions = (*sessions[:15], hidden, *sessions[16:])
    return Campaign("village", seed, 700, False, sessions, 0.4, size, "village")


def _begbroke(seed: int, size: Size) -> Campaign:
    """107 laps in two months, 7 h to 19 h local; at standard size begbroke24h's daytime laps."""
    if size is Size.STANDARD:
        whole = _begbroke24h(seed, size)
        laps = tuple(lap for lap in whole.sessions if by_day(lap.start))
        return replace(whole, name="begbroke", sessions=laps)
    rng = np.random.default_rng([seed, 0xBE6])
    starts = _spread(rng, datetime(2025, 6, 1, tzinfo=UTC), 61, 107, (6.0, 18.0))
    sessions = _planned(
        "begbroke", seed, starts, _dealt(rng, 107), ["wildcat"] * 107, [False] * 107
    )
    sessions = _under(Rainfall(seed), sessions)
    return Campaign("begbroke", seed, 700, False, sessions, 0.25, size, "begbroke")


def _begbroke24h(seed: int, size: Size) -> Campaign:
    """Regular starts day and night, 6 August to 5 September; it rains as in August 2013."""
    count = 140 if size is Size.FULL else 80
    rng = np.random.default_rng([seed, 0x24])
    first = datetime(2025, 8, 6, tzinfo=UTC)
    minutes = np.arange(count) * 30 * 24 * 60 / count + rng.uniform(-12, 12, count) + 15
    starts = [first + timedelta(minutes=round(float(m))) for m in minutes]
    day = [by_day(start) for start in starts]
    of_day, of_night = iter(_dealt(rng, sum(day))), iter(_dealt(rng, count - sum(day)))
    weathers = [next(of_day if light else of_night) for light in day]
    sessions = _planned("begbroke24h", seed, starts, weathers, ["wildcat"] * count, [False] * count)
    sessions = _under(_dry_august(seed, tuple(starts)), sessions)
    return Campaign("begbroke24h", seed, 700, False, sessions, 0.25, size, "begbroke24h")


def _keble(seed: int, size: Size) -> Campaign:
    """On a bicycle through crowds, many junctions and own loops, over three months."""
    count = 25 if size is Size.FULL else 10
    rng = np.random.default_rng([seed, 0x4EB])
    starts = _spread(rng, datetime(2025, 5, 1, tzinfo=UTC), 90, count, (8.0, 16.0))
    sessions = _planned(
        "keble", seed, starts, _dealt(rng, count), ["bicycle"] * count, [False] * count
    )
    sessions = _under(Rainfall(seed), sessions)
    return Campaign("keble", seed, 2200, True, sessions, 1.0, size, "keble")


def _oxford(seed: int, size: Size) -> Campaign:
    """Through the town in summer, both directions, behind other vehicles."""
    rng = np.random.default_rng([seed, 0x0F0])
    starts = _spread(rng, datetime(2025, 6, 10, tzinfo=UTC), 60, 10, (8.0, 18.0))
    sessions = _planned(
        "oxford", seed, starts, _dealt(rng, 10), ["wildcat"] * 10, [k % 2 == 1 for k in range(10)]
    )
    sessions = _under(Rainfall(seed), sessions)
    length = 7600 if size is Size.FULL else 3000
    return Campaign("oxford", seed, length, False, sessions, 0.9, size, "oxford", 0.65)


# Hours (UTC) of the weekly drives of a year, one after another: no season meets one hour alone.
_WEEKLY_HOURS = (9.0, 16.5, 12.0, 21.5, 7.5, 18.0, 14.0, 1.5)
# Share of winter weeks whose drive finds snow: eight days of Oxford's winter.
_SNOWY = 8 / 90


def _year(seed: int, size: Size) -> Campaign:
    """A drive a week for a year round a small town, at all hours; it rains as in Oxford."""
    rng = np.random.default_rng([seed, 0x3E5])
    first = datetime(2025, 3, 3, tzinfo=UTC)
    starts = [
        first + timedelta(days=7 * k, hours=_WEEKLY_HOURS[k % len(_WEEKLY_HOURS)])
        for k in range(52)
    ]
    weathers = _dealt(rng, 52)
    plans = _planned("year", seed, starts, weathers, ["wildcat"] * 52, [False] * 52)
    plans = _under(Rainfall(seed), plans)
    winter = [plan.number for plan in plans if plan.start.month in {12, 1, 2}]
    snowy = set(rng.choice(winter, max(1, round(_SNOWY * len(winter))), replace=False).tolist())
    sessions = tuple(
        replace(plan, weather="snow", rain_mm_h=None) if plan.number in snowy else plan
        for plan in plans
    )
    return Campaign("year", seed, 200, False, sessions, 0.4, size, "year")


# Drives of the month on each day, and of these by the robot with the other camera.
MONTH_ROBOTS, _COURIERS = 10, 3


def _month(seed: int, size: Size) -> Campaign:
    """Ten robots, each once a day for thirty days, round a hamlet; it rains as in Oxford."""
    count = 30 * MONTH_ROBOTS
    rng = np.random.default_rng([seed, 0x30D])
    first = datetime(2025, 9, 1, tzinfo=UTC)
    minutes = (np.arange(count) + 0.5) * 24 * 60 / MONTH_ROBOTS + rng.uniform(-60, 60, count)
    starts = [first + timedelta(minutes=round(float(m))) for m in minutes]
    # Each day deals the robots to the hours in another order.
    robots = [
        "courier" if one < _COURIERS else "wildcat"
        for _ in range(30)
        for one in rng.permutation(MONTH_ROBOTS)
    ]
    plans = _planned("month", seed, starts, _dealt(rng, count), robots, [False] * count)
    sessions = _under(Rainfall(seed), plans)
    return Campaign("month", seed, 150, False, sessions, 0.4, size, "month")


def _wet(seed: int, size: Size) -> Campaign:
    """A stress, never averaged with months: three of four drives in rain of 1 mm/h on.

    Rates are spread over those of Oxford's rain beyond 1 mm/h; every sixth drive is at night.
    """
    count = 24
    first = datetime(2025, 9, 1, tzinfo=UTC)
    starts = [
        first + timedelta(days=k, hours=22.5 if k % 6 == 5 else 9 + k % 8) for k in range(count)
    ]
    wet = [k for k in range(count) if k % 4]
    rng = np.random.default_rng([seed, 0x3E7])
    shares = 0.018 * (rng.permutation(len(wet)) + 0.5) / len(wet)
    rates = dict(zip(wet, rates_exceeded(shares).tolist(), strict=True))
    weathers = ["rain" if k in rates else "overcast" for k in range(count)]
    plans = _planned("wet", seed, starts, weathers, ["wildcat"] * count, [False] * count)
    sessions = tuple(replace(plan, rain_mm_h=rates.get(plan.number)) for plan in plans)
    return Campaign("wet", seed, 700, False, sessions, 0.25, size, "wet")


def _covered(seed: int, size: Size) -> Campaign:
    """The drives of `wet` behind an unwiped pane 40 mm before the lenses."""
    wet = _wet(seed, size)
    pane = Lens(glass=Glass(distance_mm=40.0))
    sessions = tuple(replace(plan, lens=pane) for plan in wet.sessions)
    return replace(wet, name="covered", home="covered", sessions=sessions)


# Numbers of the estate's drives: that of the map, one on the same ring, those beside it.
MAPPED, AGAIN, BESIDE = 0, 1, [3, 2]


def estate(seed: int, size: Size = Size.STANDARD, fronts: Fronts | None = None) -> Campaign:
    """Rings between equal fronts, one of them mapped, the other one next to it.

    Args:
        seed: of the town.
        size: makes no difference.
        fronts: how they repeat; None for every 37.5 m.
    """
    fronts, first = fronts or Fronts(), datetime(2025, 7, 14, tzinfo=UTC)
    drives = [
        (0, 8.5, "clear", False), (1, 11.0, "overcast", False), (1, 12.0, "overcast", True),
        (2, 9.0, "clear", True), (3, 17.0, "fair", False), (3, 22.5, "fair", True),
        (4, 10.0, "rain", True), (4, 23.0, "fair", False),
    ]  # fmt: skip
    starts = [first + timedelta(days=d, hours=h) for d, h, _, _ in drives]
    count = len(drives)
    sessions = _planned(
        "estate", seed, starts, [d[2] for d in drives], ["wildcat"] * count, [False] * count
    )
    sessions = tuple(
        replace(plan, beside=drive[3]) for plan, drive in zip(sessions, drives, strict=True)
    )
    length_m = 6 * fronts.spacing_m
    name = f"estate-{fronts.name}"
    return Campaign(name, seed, length_m, False, sessions, 0.2, size, name, fronts=fronts)


def small_loop(
    name: str, seed: int, length_m: float, drives: Sequence[tuple[datetime, str, Lens]]
) -> Campaign:
    """A hamlet's loop with drives of one robot: start, weather and lens each, in order of time."""
    hamlet = campaign_named("hamlet", seed)
    first = hamlet.sessions[0].seed
    sessions = tuple(
        SessionPlan(number, start, weather, "wildcat", False, first + 7919 * number, lens)
        for number, (start, weather, lens) in enumerate(drives)
    )
    return replace(hamlet, name=name, home=name, length_m=length_m, sessions=sessions)


CAMPAIGNS: dict[str, Callable[[int, Size], Campaign]] = {
    "hamlet": _hamlet,
    "village": _village,
    "begbroke": _begbroke,
    "keble": _keble,
    "oxford": _oxford,
    "begbroke24h": _begbroke24h,
    "estate": estate,
    "year": _year,
    "month": _month,
    "wet": _wet,
    "covered": _covered,
}
