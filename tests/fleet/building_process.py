"""Builds a map in groups, saying so, until somebody kills it."""

from __future__ import annotations

import multiprocessing
import sys
import threading
from pathlib import Path

from engram.fleet.build.building import build_map
from engram.monitor import Monitor
from engram.processes import end_with_parent
from engram.robot.settings import Settings

from .builds import options

# Longer than any test waits; yet a test that fails leaves nothing for ever.
_LONG_S = 600.0


def wait_long() -> None:
    end_with_parent()
    print("waiting", flush=True)
    threading.Event().wait(_LONG_S)


class Telling(Monitor):
    def advance(self, word: str = "") -> None:
        print(word, flush=True)


def main(centre: str = "", *drives: str) -> None:
    if centre:
        build_map(Path(centre), drives, Settings(), options(), monitor=Telling())
        return
    multiprocessing.get_context("spawn").Process(target=wait_long).start()


if __name__ == "__main__":
    main(*sys.argv[1:])
