"""Small towns that nothing else is judged on: `confidence` is fitted on some, tried on others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from engram.frontend.frame import BRIEF
from engram.localiser.settings import METHOD_VERSION
from engram.monitor import QUIET, Monitor
from engram.robot.settings import Settings
from engram_lab.misplaced import Street
from engram_lab.studies.drives import EvaluatedDrive, campaign_logs, drives_of
from engram_lab.town.campaigns import Campaign, SessionPlan, campaign_named
from engram_lab.town.simulating import campaign_folder, campaigns_folder, simulate

FITTED_TOWNS = (301, 302)
HELD_OUT_TOWNS = (403, 404)
LOOP_M = 200.0
_NIGHT_FROM_H = 21
_FIRST_DAY = datetime(2025, 7, 14, tzinfo=UTC)
# Day, hour (UTC), weather and robot of each drive; two by night, one of them in rain.
_DRIVES = (
    (0, 8.5, "clear", "wildcat"), (0, 17.0, "clear", "courier"), (1, 11.0, "overcast", "wildcat"),
    (1, 22.5, "fair", "wildcat"), (2, 10.0, "showers", "courier"), (2, 23.0, "rain", "wildcat"),
)  # fmt: skip

# Later drives of such a town: six more the usual way round, then three against it.
_LATER = (
    (3, 9.5, "fair", "wildcat", False), (3, 14.0, "overcast", "wildcat", False),
    (4, 16.0, "broken", "wildcat", False), (5, 11.0, "showers", "wildcat", False),
    (6, 12.0, "clear", "courier", False), (6, 22.0, "fair", "wildcat", False),
    (7, 9.0, "clear", "wildcat", True), (8, 10.0, "overcast", "wildcat", True),
    (8, 16.5, "fair", "wildcat", True),
)  # fmt: skip


def longer_trial_town(seed: int) -> Campaign:
    """The same town with nine more drives, the last three of them in the opposite direction."""
    town = trial_town(seed)
    first = town.sessions[0]
    later = tuple(
        SessionPlan(number, _FIRST_DAY + timedelta(days=day, hours=hour), weather, robot, reverse,
                    first.seed + 7919 * number)
        for number, (day, hour, weather, robot, reverse) in enumerate(_LATER, len(town.sessions))
    )  # fmt: skip
    return replace(town, sessions=(*town.sessions, *later))


def trial_town(seed: int) -> Campaign:
    """Six drives around one loop, in all kinds of light, by two kinds of robots."""
    hamlet = campaign_named("hamlet", seed)
    sessions = tuple(
        replace(
            plan, start=_FIRST_DAY + timedelta(days=day, hours=hour), weather=weather, robot=robot
        )
        for plan, (day, hour, weather, robot) in zip(hamlet.sessions, _DRIVES, strict=True)
    )
    return replace(hamlet, name="trial", home="trial", length_m=LOOP_M, sessions=sessions)


def light_of(plan: SessionPlan) -> str:
    """Weather of a drive, and whether it is by day."""
    return f"{plan.weather}, {'night' if plan.start.hour >= _NIGHT_FROM_H else 'day'}"


# Each map is built from some drives, and localises another.
STREETS = (((0, 3), 1), ((2,), 0), ((2,), 4), ((1,), 2))
# The same by night, in maps of the day, and in rain by night.
BY_NIGHT = (((2,), 3), ((1,), 3), ((0, 3), 5))


def streets(
    towns: Sequence[int],
    settings: Settings,
    lost_rounds: int,
    monitor: Monitor = QUIET,
    which: Sequence[tuple[tuple[int, ...], int]] = STREETS,
) -> Iterator[tuple[str, Street]]:
    """The streets of some towns by name; renders and maps what is not there yet.

    Args:
        towns: seeds.
        settings: the configuration of maps and robots.
        lost_rounds: budget of a lost robot.
        monitor: hears of what is rendered.
        which: numbers of the drives that are mapped, and of the one that is localised.
    """
    for seed in towns:
        drives = drives_in(seed, settings, monitor)
        for mapped, live in which:
            yield _street(seed, drives, mapped, seed, drives[live], settings, lost_rounds)


def all_streets(
    towns: Sequence[int], settings: Settings, lost_rounds: int, monitor: Monitor = QUIET
) -> Iterator[tuple[SessionPlan, str, Street]]:
    """Each map of each town with every drive that it was not built from; see `streets`.

    Yields:
        The plan of the drive, the name of the street, the street.
    """
    for seed in towns:
        drives, plans = drives_in(seed, settings, monitor), trial_town(seed).sessions
        for mapped in dict.fromkeys(mapped for mapped, _ in STREETS):
            for live in range(len(drives)):
                if live not in mapped:
                    yield (
                        plans[live],
                        *_street(seed, drives, mapped, seed, drives[live], settings, lost_rounds),
                    )


def other_towns(
    towns: Sequence[int], settings: Settings, lost_rounds: int, monitor: Monitor = QUIET
) -> Iterator[tuple[str, Street]]:
    """The same with a drive of the next town in the map of each: nothing can be found there."""
    for seed, other in zip(towns, [*towns[1:], *towns[:1]], strict=True):
        if seed != other:
            drives = drives_in(seed, settings, monitor)
            live = drives_in(other, settings, monitor)[0]
            yield _street(seed, drives, (2,), other, live, settings, lost_rounds)


def town_pairs(towns: Sequence[int], settings: Settings) -> Iterator[tuple[str, Street]]:
    """Each map of each town with every drive of every town that it was not built from."""
    for seed in towns:
        drives = drives_in(seed, settings, QUIET)
        for other in towns:
            shown = drives_in(other, settings, QUIET)
            for mapped in dict.fromkeys(mapped for mapped, _ in STREETS):
                for number, live in enumerate(shown):
                    if seed != other or number not in mapped:
                        yield _street(seed, drives, mapped, other, live, settings, 1)


def towns_folder(settings: Settings) -> Path:
    """Where the towns stand as seen with a kind of features."""
    kind = settings.frontend.descriptor
    return campaigns_folder() if kind == BRIEF else campaigns_folder() / kind


def drives_in(seed: int, settings: Settings, monitor: Monitor = QUIET) -> Sequence[EvaluatedDrive]:
    """The drives of a town; renders what is not there yet."""
    folder, town = towns_folder(settings), trial_town(seed)
    simulate(town, folder, settings=settings, monitor=monitor)
    return drives_of(campaign_logs(town, folder))


def _street(
    seed: int, drives: Sequence[EvaluatedDrive], mapped: tuple[int, ...],
    other: int, live: EvaluatedDrive, settings: Settings, lost_rounds: int,
) -> tuple[str, Street]:  # fmt: skip
    name = "".join(map(str, mapped))
    folder = campaign_folder(towns_folder(settings), trial_town(seed))
    path = folder / f"map{name}-{METHOD_VERSION}.engram"
    some, same = [drives[k] for k in mapped], seed == other
    street = Street(path, some, live, settings, lost_rounds, same_town=same)
    return f"{seed}/{name}/{other}-{live.name[:3]}", street
