"""Two robots drive a hamlet through a few days; another drive is localised on a tight budget."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError
from engram.localiser.localisation import Localisation
from engram.maps.map import open_map
from engram.monitor import QUIET, Monitor
from engram.robot.localisers import session_of_drive
from engram.robot.mapping import MapReport, map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_on, summarise
from engram.sequences.opening import open_drive
from engram.viewing.drawings import plot_map, save, subplots
from engram.viewing.matches import MatchShower, PictureWriter
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.session import SimulatedDrive
from engram_lab.town.simulating import simulate

_CAMPAIGN = "hamlet"
_POLICIES = ("distance", "path-near")
# One attempt, or one after another up to four: what counts is which experience is tried first.
_ATTEMPTS = (1, 4)
# The place that is shown in every condition, as a share of the drive.
_SHOWN_AT = 0.35


@dataclass(slots=True)
class DemoReport:
    """What the demo did."""

    out: Path
    conditions: list[str] = field(default_factory=list)
    mapped: list[MapReport] = field(default_factory=list)
    localised: dict[str, dict[int, dict[str, Any]]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """What ``demo --json`` prints."""
        return {
            "out": str(self.out),
            "conditions": self.conditions,
            "mapped": [report.to_dict() for report in self.mapped],
            "localised": self.localised,
        }


def run_demo(out: Path, monitor: Monitor = QUIET, workers: int = 2) -> DemoReport:
    """Renders the drives, maps all but the last, localises the last, and draws pictures.

    What an earlier run has rendered is not rendered again.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made: {error.strerror}") from error
    campaign = campaign_named(_CAMPAIGN)
    drives = [SimulatedDrive(campaign, i) for i in range(len(campaign.sessions))]
    report = DemoReport(out)
    report.conditions = [_condition(drive) for drive in drives]
    rendered = simulate(campaign, out, workers=workers, monitor=monitor)
    logs = [Path(file) for file in rendered.files]
    map_path = out / f"{_CAMPAIGN}.engram"
    map_path.unlink(missing_ok=True)
    for log, condition in zip(logs[:-1], report.conditions, strict=False):
        sequence = open_drive(log)
        with monitor.stage(f"map: {condition}", len(sequence)) as part:
            mapped = map_drive(map_path, sequence, Settings(), RobotOptions(), part)
        report.mapped.append(mapped)
    thorough = {}
    for policy in _POLICIES:
        runs = {
            most: _localise(map_path, logs[-1], policy, most, out, monitor) for most in _ATTEMPTS
        }
        report.localised[policy] = {most: summarise(found) for most, found in runs.items()}
        thorough[policy] = runs[max(_ATTEMPTS)]
    _draw(report, map_path, thorough, drives)
    return report


def _condition(drive: SimulatedDrive) -> str:
    plan = drive.plan
    return f"{plan.start:%a %H:%M}, {plan.weather}, {plan.robot}"


def _localise(
    map_path: Path, log: Path, policy: str, most: int, out: Path, monitor: Monitor
) -> list[Localisation]:
    sequence = open_drive(log)
    options = RobotOptions(ranking=policy, lanes=1, rounds=most)
    with (
        open_map(map_path) as opened,
        robot_on(opened, sequence, Settings(), options) as robot,
        monitor.stage(f"localise: {policy}, {most} a frame", len(sequence)) as part,
    ):
        shower = MatchShower(opened, robot.graph, session_of_drive(sequence))
        writer = PictureWriter(out / f"matches_{policy}_{most}", 40, shower)
        results, at_m = [], 0.0
        for frame, found in enumerate(robot.drive(sequence, part)):
            results.append(found)
            at_m += found.motion.moved_m
            assert robot.last is not None
            writer.see(robot.last, found, frame, at_m)
        return results


def _draw(
    report: DemoReport,
    map_path: Path,
    results: dict[str, list[Localisation]],
    drives: list[SimulatedDrive],
) -> None:
    _draw_attempts(results, report.out / "attempts.png")
    plot_map(map_path, report.out / "map_from_above.png")
    shown = _one_place(drives, report.conditions)
    cv2.imwrite(str(report.out / "one_place.png"), shown)


def _draw_attempts(results: dict[str, list[Localisation]], path: Path) -> None:
    """The attempts that each frame took, one line per policy."""
    figure, (axes,) = subplots(1, width=9, height=3.2)
    for policy, found in results.items():
        counts = [one.attempts for one in found]
        axes.step(np.arange(len(counts)), counts, where="mid", label=policy, linewidth=1.2)
    axes.set_xlabel("live frame")
    axes.set_ylabel("match attempts")
    axes.set_ylim(0, None)
    axes.set_title("Attempts per frame, last drive")
    axes.legend(fontsize=8)
    save(figure, path)


def _one_place(drives: list[SimulatedDrive], conditions: list[str]) -> NDArray[np.uint8]:
    """The same place in each drive, with its condition below."""
    tiles = []
    for drive, condition in zip(drives, conditions, strict=True):
        at = int(_SHOWN_AT * len(drive))
        pair = next(iter(drive.frames(at, at + 1)))
        tile = cv2.resize(pair.left, (512, 384))
        tile = cv2.copyMakeBorder(tile, 0, 28, 0, 0, cv2.BORDER_CONSTANT, value=(0,))
        place = (8, 384 + 19)
        cv2.putText(tile, condition, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255,), 1, cv2.LINE_AA)
        tiles.append(tile)
    rows = [np.hstack(tiles[i : i + 3]) for i in range(0, len(tiles), 3)]
    return np.vstack(rows)
