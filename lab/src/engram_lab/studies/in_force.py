"""What a study runs by: read from what runs, and held against the settings that it was given."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

from engram.cli.settings import AllSettings
from engram.config import config_hash, to_dict
from engram.errors import ConfigError
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.localiser.attempts import Matcher
from engram.localiser.localiser import InForce, Localiser
from engram.localiser.settings import METHOD_VERSION
from engram.odometry.motion import GapFiller
from engram.robot.robot import Robot
from engram.robot.settings import Settings
from engram_lab.studies.configurations import BY_TRUTH
from engram_lab.studies.drives import DriveSet, EvaluatedDrive

# Settings by key with its tables, "localiser.recent.T", as plain values.
Values: TypeAlias = dict[str, Any]
# The budget and the policy of a robot: what every study varies.
VARIED = ("drive.ranking", "drive.lanes", "drive.rounds")
# All that studies read of the table `drive`: their drives are frame logs, opened as they are, and
# how the lost are found is an option of the studies' own.
OF_DRIVE = (*VARIED, "drive.threads")
# What stands beside every table.
_NAMES = {
    "localiser.neighbourhood": "neighbourhood",
    "localiser.path_entries": "path entries",
    "localiser.recent.T": "T",
    "localiser.recent.T_unit": "T by",
    "localiser.guide_below_m": "guided below m",
    "localiser.success": "success",
    "localiser.acceptance.rule": "rule",
    "frontend.descriptor": "features",
    "frontend.landmarks": "landmarks",
    "method": "method",
    "world": "world",
}
# A lost robot's attempts are matched once for all, with the whole matcher.
_BOUNDS_OF_THE_LOST = {
    "localiser.lost_max_samples": "max_samples",
    "localiser.lost_max_hypotheses": "max_hypotheses",
}


def by_key(config: Any, table: str = "") -> Values:
    """Every setting of a configuration at any depth, by its key."""
    return dict(_flat(to_dict(config), f"{table}." if table else ""))


def _flat(values: Mapping[str, Any], tables: str) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{tables}{name}.")
        else:
            yield tables + name, value


def of_localiser(
    localiser: Localiser, gaps: GapFiller, drive: EvaluatedDrive, matcher: Matcher | None
) -> Values:
    """What a held-out drive is localised by.

    Args:
        matcher: what makes its matches; None for the localiser itself.
    """
    found = {**_of(localiser.in_force), **by_key(gaps.config, "gaps")}
    if matcher is not None and localiser.relocaliser is not None:
        whole = localiser.config.matcher
        found |= {key: getattr(whole, name) for key, name in _BOUNDS_OF_THE_LOST.items()}
    return {
        **found,
        "frontend.descriptor": str(drive.descriptor),
        "frontend.landmarks": drive.landmarks or FrontendConfig().landmarks,
        "front-end": drive.frontend,
        "odometry": drive.odometry,
        "method": METHOD_VERSION,
        "world": drive.world,
    }


def of_robot(robot: Robot) -> Values:
    """What a robot that maps localises by."""
    return _of(robot.in_force)


def _of(known: InForce) -> Values:
    budget = known.budget
    asked = {"ranking": known.policy, "lanes": budget.lanes, "rounds": budget.rounds}
    return {
        **{f"drive.{name}": value for name, value in asked.items()},
        **by_key(known.config, "localiser"),
    }


def of_revision(configuration: Mapping[str, Any]) -> Values:
    """What a map keeps of how its newest revision was made: by mapping, merging or downloading."""
    found = dict(_flat(configuration.get("settings", {}), ""))
    for table in ("merge", "download"):
        found |= dict(_flat(configuration.get(table, {}), f"{table}."))
    known = by_key(AllSettings())
    return {key: value for key, value in found.items() if key in known}


def common(several: Iterable[Mapping[str, Any]]) -> Values:
    """What runs that should be alike have in force; where they are not, all their values."""
    found: dict[str, list[Any]] = {}
    for one in several:
        for key, value in one.items():
            values = found.setdefault(key, [])
            if value not in values:
                values.append(value)
    return {
        key: some[0] if len(some) == 1 else " and ".join(map(str, some))
        for key, some in found.items()
    }


def in_words(known: Mapping[str, Any]) -> str:
    """What is in force, for the line below a table; empty where nothing is known."""
    parts = [f"{words} {known[key]}" for key, words in _NAMES.items() if known.get(key) is not None]
    return f"In force: {', '.join(parts)}." if parts else ""


def columns(known: Mapping[str, Any]) -> Values:
    """What is in force, for the rows of a table."""
    return {words.replace(" ", "_"): known.get(key) for key, words in _NAMES.items()}


def rows(known: Mapping[str, Any], settings: AllSettings, about: Mapping[str, Any]) -> list[Values]:
    """A row per setting and version in force, next to what the settings say."""
    given, other = by_key(settings), differing(known, settings)
    return [
        {
            **about,
            "setting": key,
            "in_force": value,
            "given": given.get(key),
            "differs": "yes" if key in other else "",
        }
        for key, value in sorted(known.items())
    ]


def exceptions(known: Mapping[str, Any], settings: AllSettings) -> Iterator[str]:
    """What of the settings is not in force, for people."""
    other = differing(known, settings)
    varied = [f"`{key} = {other[key][1]}`" for key in VARIED if key in other]
    if varied:
        yield f"varied by the study itself: {', '.join(varied)} of the settings"
    rest = {key: values for key, values in other.items() if key not in VARIED}
    if rest:
        changed = ", ".join(f"`{key} = {have}` ({said})" for key, (have, said) in rest.items())
        yield f"set by the study itself, the settings' value in brackets: {changed}"


def unused(settings: AllSettings, used: Collection[str]) -> Iterator[str]:
    """Tables and settings that were changed and that a study does not read, for people.

    Args:
        used: names of the tables that it reads, and keys of settings that it reads of others.
    """
    changed = differing(by_key(settings), AllSettings())
    unread = [key for key in changed if key not in used and _table(key) not in used]
    partly = {_table(one) for one in used if "." in one}
    if told := dict.fromkeys(
        key if _table(key) in partly else f"[{_table(key)}]" for key in unread
    ):
        yield f"- Not used by this study: {', '.join(f'`{one}`' for one in told)}."


def _table(key: str) -> str:
    return key.partition(".")[0]


def check_logs(settings: Settings, drives: DriveSet) -> None:
    """Refuses settings of front-end and odometry, unless the drives' logs were made by them."""
    kind, asked = drives.drives[0].descriptor, settings.frontend.descriptor
    if asked not in {Settings().frontend.descriptor, kind}:
        raise ConfigError(
            f"frontend.descriptor is {asked}, and {drives.drives[0].path} has {kind}: leave it "
            f"out, or extract the drives with {asked}"
        )
    fitted, usual = (one.for_descriptor(kind) for one in (settings, Settings()))
    if drives.drives[0].landmarks == fitted.frontend.landmarks:
        # The logs were made with more of them, and are read so.
        frontend = replace(fitted.frontend, landmarks=usual.frontend.landmarks)
        fitted = replace(fitted, frontend=frontend)
    hashes = {
        "frontend": Frontend(fitted.frontend).hash,
        "odometry": config_hash(fitted.odometry),
    }
    for table, wanted in hashes.items():
        changed = differing(by_key(getattr(fitted, table), table), usual)
        others = [one for one in drives.drives if getattr(one, table) != wanted]
        if changed and others:
            key, (value, _) = next(iter(changed.items()))
            raise ConfigError(
                f"{key} is {value}, but {others[0].path} was made with other settings of the "
                f"{table}, and a study does not make its drives again: leave it out, or make "
                "them with the same --config"
            )


def check_lost(settings: Settings, relocaliser: str | None) -> None:
    """Refuses bounds of lost robots' attempts where matches are made once for all of them."""
    changed = differing(by_key(settings.localiser, "localiser"), Settings())
    for key in _BOUNDS_OF_THE_LOST:
        if relocaliser not in (None, BY_TRUTH) and key in changed:
            raise ConfigError(
                f"{key} is {changed[key][0]}, but a study with the relocaliser {relocaliser} "
                "matches each pair once, whether lost or not, with all of localiser.matcher: "
                "leave it out"
            )


def differing(in_force: Mapping[str, Any], settings: Settings) -> dict[str, tuple[Any, Any]]:
    """What is in force and is not as the settings say, each with what they say."""
    given = by_key(settings)
    return {
        key: (value, given[key])
        for key, value in in_force.items()
        if key in given and given[key] != value
    }
