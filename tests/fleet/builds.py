"""Builds of small maps, and what goes wrong with them."""

from __future__ import annotations

import signal

from engram.fleet.build.building import BuildOptions, build_map
from engram.fleet.build.orders import JudgeOptions
from engram.monitor import QUIET, Monitor
from engram.robot.settings import RobotOptions, Settings

from .robots import OPTIONS


def options(**changes: object) -> BuildOptions:
    mapping = RobotOptions(relocaliser="exhaustive")
    values = {"workers": 2, "groups": 2, "mapping": mapping, "merging": OPTIONS} | changes
    return BuildOptions(**values)


def build(centre, logs, names="abc", monitor=QUIET, keep=False, **changes):
    """Builds a centre from drives of `logs`."""
    drives = [logs[name] for name in names]
    return build_map(centre, drives, Settings(), options(**changes), keep=keep, monitor=monitor)


def judge(*drives: str, **changes: object) -> JudgeOptions:
    localising = RobotOptions(relocaliser="exhaustive", lanes=1, rounds=8)
    return JudgeOptions(list(drives), **({"judge_at_m": 3.0, "localising": localising} | changes))


def in_this_process(work, tasks, workers, monitor, done):
    """In place of `run_in_processes`, where workers are not what is tested."""
    for name, task in tasks.items():
        done(name, work(task, monitor), 0)
        monitor.check()


class KilledError(Exception):
    """What lies on the disk is as if the process had been killed here."""


def killed(*_: object, **__: object) -> None:
    raise KilledError


class Interrupting(Monitor):
    """Presses Ctrl-C after so many frames."""

    def __init__(self, frames: int) -> None:
        self.left = frames

    def advance(self, word: str = "") -> None:
        self.left -= 1
        if self.left == 0:
            signal.raise_signal(signal.SIGINT)
