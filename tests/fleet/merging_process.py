"""Merges a robot's map into a centre, saying so, until somebody kills it."""

from __future__ import annotations

import sys
from pathlib import Path

from engram.fleet.merge.merging import merge
from engram.maps import writer

from .robots import OPTIONS


def main(centre: str, robot: str) -> None:
    writer._BATCH_BYTES = 100_000  # so that a merge is written in several transactions
    print("merging", flush=True)
    merge(Path(centre), [Path(robot)], OPTIONS)
    print("merged", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
