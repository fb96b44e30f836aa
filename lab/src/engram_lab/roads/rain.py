"""Protocol W: how often and how hard it rains, and what that does to a pane and to rendering.

    python -m engram_lab.roads.rain

Rates over 10⁵ simulated hours against ITU-R P.837-7 for Oxford; cover of a pane after two minutes
of 4 mm/h at 5 m/s, and what changes of it between two frames 50 ms apart; processor time of a pair.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from engram_lab.programs import Figure, command_line, report
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.drive import robot_named
from engram_lab.town.glass import OPEN_GLASS, Pane, WetLens
from engram_lab.town.rainfall import STEP, Rainfall
from engram_lab.town.session import SimulatedDrive

_HOURS = 100_000
_PANES = 12
_RATE_MM_H, _SPEED_M_S = 4.0, 5.0
_IN_RAIN_S, _FRAME_S = 120.0, 0.05
_FRAMES = 40


def rates() -> Iterator[Figure]:
    """Shares of the time beyond three rates."""
    steps_an_hour = round(3600 / STEP.total_seconds())
    found = Rainfall(1).rates_mm_h(steps_an_hour * _HOURS)
    for above, road in ((0.0, 5.66), (1.0, 1.8), (4.0, 0.37)):
        share = 100 * float((found > above).mean())
        yield Figure(f"time in rain above {above:g} mm/h (Oxford {road:g})", share, "%")


def panes() -> Iterator[Figure]:
    """Cover of panes, and the share of them that changes from frame to frame."""
    camera = robot_named("wildcat").camera
    covers, changes = [], []
    for seed in range(_PANES):
        pane = Pane(OPEN_GLASS, camera, [seed])
        for _ in range(round(_IN_RAIN_S / _FRAME_S)):
            pane.advance(_RATE_MM_H, _SPEED_M_S, _FRAME_S)
        lens = WetLens(pane, camera)
        before = lens.mask()
        covers.append(before.mean())
        pane.advance(_RATE_MM_H, _SPEED_M_S, _FRAME_S)
        changes.append((before != lens.mask()).mean())
    yield Figure("cover after two minutes of 4 mm/h at 5 m/s", 100 * float(np.mean(covers)), "%")
    yield Figure("of it new after 50 ms", 100 * float(np.mean(changes)), "%")


def rendering() -> Iterator[Figure]:
    """Processor time of a pair on one core, in rain and dry, its tiles built."""
    hamlet = campaign_named("hamlet")
    for weather in ("overcast", "rain"):
        plan = replace(hamlet.sessions[0], weather=weather)
        drive = SimulatedDrive(replace(hamlet, sessions=(plan,)), 0)
        taken_s = []
        for _ in range(3):
            start_s = time.process_time()
            pairs = list(drive.frames(0, _FRAMES))
            taken_s.append(time.process_time() - start_s)
        yield Figure(f"a pair, {weather}", 1000 * min(taken_s) / len(pairs), "ms")


def main() -> None:
    """Command line."""
    asked = command_line(__doc__).parse_args()
    for part in (rates, panes, rendering):
        report(part(), asked.json, part.__name__)


if __name__ == "__main__":
    main()
