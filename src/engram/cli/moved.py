"""Names that moved, which for one release answer with the new, and those of another package."""

from __future__ import annotations

from collections.abc import Collection

VERBS = {
    "extract": "engram record",
    "explain": "engram localise MAP DRIVE --explain FRAME",
    "seal": "engram check MAP --seal",
    "blame": "engram show MAP NODE",
    "simulate": "engram lab simulate",
    "evaluate": "engram lab evaluate",
    "bench": "engram lab bench",
    "relocalise": "engram lab relocalise",
    "places": "engram lab places",
}

_RANKING = {"--policy": "--ranking"}
_DRIVE = {"--start": "--recorded-at", "--fov": "--field-of-view"}
_FEATURES = {"--descriptor": "--features"}
_MERGE = {
    "--policy": "--set merge.ranking=NAME",
    "--lanes": "--set merge.lanes=N",
    "--rounds": "--set merge.rounds=N",
    "--relocaliser": "--set merge.relocaliser=NAME",
    "--sure-inliers": "--set merge.sure_inliers=N",
}
OPTIONS = {
    "doctor": _DRIVE,
    "drive info": _DRIVE,
    "drive calibration": _DRIVE,
    "map": {**_RANKING, **_DRIVE, **_FEATURES},
    "localise": {**_RANKING, **_DRIVE, "--frame": "--explain", "--top": "--explain … --json"},
    "record": {**_DRIVE, **_FEATURES},
    "view": {**_DRIVE, "--save": "--view"},
    "agent enrol": {"--name": "--robot"},
    "merge": _MERGE,
    "build": {
        **_MERGE,
        "--best-order": "--order best",
        "--best-first": "--order best-first",
        "--judge-at": "--set build.max_gap_m=METRES",
        "--seed": "--grouping random:SEED",
    },
    "download": {
        "--policy": "--select",
        "--region": "--near",
        "--start": "--depart",
        "--end": "--arrive",
        "--window": "--set download.window_min=MINUTES",
        "--epoch": "--set download.epoch_min=MINUTES",
        "--best": "--set download.best_percent=PERCENT",
        "--buffer": "--set download.buffer_min=MINUTES",
        "--latitude": "--set download.latitude_deg=DEGREES",
        "--radius": "--set download.radius_m=METRES",
    },
}
_AUTHOR = {"--author": "set ENGRAM_AUTHOR in the environment"}
GONE = {
    "map": {"--deadline": "a map made against the clock is different every time; use --rounds"},
    "localise": {
        "--every": "--pictures spreads about 20 pictures over the drive",
        "--preload": "images are decoded ahead; engram lab bench, of engram-lab, times stages",
    },
    **dict.fromkeys(("merge", "build", "tag", "revert", "vocabulary"), _AUTHOR),
}
# What the laboratory brings, a distribution of its own.
LABORATORY = ("demo", "lab")
_INSTALL = "engram-lab, which is not installed; from a checkout of Engram: pip install ./lab"
# Other spellings of a verb, which stay.
SPELLINGS = {"localize": "localise"}


def moved_verb(name: str, known: Collection[str]) -> str | None:
    """What to type in place of an old verb; None if it is no old verb."""
    if name in known or name not in VERBS:
        return None
    answer = f"`engram {name}` is now `{VERBS[name]}`"
    if VERBS[name].startswith("engram lab") and "lab" not in known:
        answer += f"; it comes with {_INSTALL}"
    return answer


def brought_verb(name: str, known: Collection[str]) -> str | None:
    """Where to get a verb of the laboratory that is not installed; None for other names."""
    if name in known or name not in LABORATORY:
        return None
    return f"`engram {name}` comes with {_INSTALL}"


def moved_option(verb: str | None, option: str) -> str | None:
    """What to type in place of an old option; None if it is no old option."""
    if why := GONE.get(verb or "", {}).get(option):
        return f"`engram {verb}` no longer takes {option}: {why}"
    if new := OPTIONS.get(verb or "", {}).get(option):
        return f"`engram {verb}`: {option} is now {new}"
    return None
