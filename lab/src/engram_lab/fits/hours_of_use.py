"""By nodes of which hour drives localised: what a download by time of day (`tod`) can hold.

    python -m engram_lab.fits.hours_of_use MAP…                  # ± 180 minutes
    python -m engram_lab.fits.hours_of_use MAP… --window 60

Nodes are saved only where nothing matches, so that a drive may live on what was saved at quite
another hour. Of the matches that path memory holds, prints how many were with nodes saved within so
many minutes of the clock, on whatever day. Clocks must be UTC.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from engram.graph.model import PathEntryKind
from engram.maps import Map, MapContents
from engram_lab.programs import command_line

_MINUTE_NS = 60 * 10**9
_DAY_MIN = 24 * 60


def minutes_apart(contents: MapContents) -> np.ndarray:
    """(M,) how far apart on the clock each match and the saving of its node were, 0 to 720."""
    saved_ns = {node.id: node.stamp_ns for node in contents.nodes}
    apart_ns = [
        entry.stamp_ns - saved_ns[entry.node]
        for entry in contents.path_entries
        if entry.kind is not PathEntryKind.SAVED
    ]
    apart_min = np.array(apart_ns, np.int64) / _MINUTE_NS % _DAY_MIN
    return np.minimum(apart_min, _DAY_MIN - apart_min)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("maps", nargs="+", type=Path, metavar="MAP")
    parser.add_argument("--window", type=float, default=180.0, help="minutes, either way")
    asked = parser.parse_args()
    matches = near = 0
    for path in asked.maps:
        with Map.open(path) as store:
            apart_min = minutes_apart(store.load())
        within = int((apart_min <= asked.window).sum())
        print(f"{path}: {within} of {len(apart_min)} matches")
        matches, near = matches + len(apart_min), near + within
    print(f"{100 * near / max(1, matches):.1f} % with nodes saved within {asked.window:g} minutes")


if __name__ == "__main__":
    main()
