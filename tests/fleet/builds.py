"""Builds of small maps, and what goes wrong with them."""

from __future__ import annotations

import signal
from contextlib import contextmanager

from engram.fleet.build import BuildOptions, JudgeOptions, build_map
from engram.fleet.build.group_mapping import map_group
from engram.fleet.merge.gate import GateOptions
from engram.robot import MapOptions, Settings

from .robots import OPTIONS


def options(**changes: object) -> BuildOptions:
    mapping = MapOptions(relocaliser="exhaustive")
    values = {"workers": 2, "groups": 2, "mapping": mapping, "merging": OPTIONS} | changes
    return BuildOptions(**values)


def build(centre, logs, names="abc", progress=None, keep=False, **changes):
    """Builds a centre from drives of `logs`."""
    shown = {} if progress is None else {"progress": progress}
    drives = [logs[name] for name in names]
    return build_map(centre, drives, Settings(), options(**changes), keep=keep, **shown)


def judge(*drives: str, **changes: object) -> JudgeOptions:
    localising = GateOptions(relocaliser="exhaustive", lanes=1, rounds=8)
    return JudgeOptions(list(drives), **({"judge_at_m": 3.0, "localising": localising} | changes))


def map_in_this_process(tasks, place, workers, advance, check, mapped):
    """In place of `map_groups`, where workers are not what is tested."""
    for task in tasks:
        mapped(map_group(task, place(task.number), advance))
        check()


def interrupting(frames):
    """A progress bar that presses Ctrl-C after so many steps."""
    count = 0

    def progress(what, total):
        @contextmanager
        def shown():
            def advance(word):
                nonlocal count
                count += 1
                if count == frames:
                    signal.raise_signal(signal.SIGINT)

            yield advance

        return shown()

    return progress
