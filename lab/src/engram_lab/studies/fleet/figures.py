"""[G16] Figs. 7 to 10 on our data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.measures import Drive, route_not_localised
from engram_lab.charts import Line, Panel, draw_bars, draw_curves
from engram_lab.intervals import Resamples
from engram_lab.studies.fleet.experiments import SHARED, SINGLE, merged_name
from engram_lab.studies.fleet.plan import FORAY_POLICIES, ROBOTS
from engram_lab.studies.fleet.results import ArmResult, FoldResult, Time
from engram_lab.studies.fleet.steps import TriedDownload
from engram_lab.studies.pages import CURVE_AT_M, failure_line

Array = NDArray[np.float64]
_LEAST_PERCENT = 0.01
_P = "P(X ≥ x), %"


def draw_fleet_figures(out: Path, arms: Sequence[ArmResult]) -> list[Path]:
    """Draws every requested figure for which results are there; returns the files.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    written: list[Path] = []

    def draw(number: int, name: str, panel: Callable[[ArmResult], Panel], title: str) -> None:
        panels = [panel(arm) for arm in arms if arm.asked(number)]
        shown = [one for one in panels if one.lines]
        if shown:
            path = out / f"fig{number:02d}_{name}.png"
            draw_curves(shown, path, title)
            written.append(path)

    draw(7, "nodes", _nodes, "size of the map while it is built")
    draw(7, "failure", _building, "failure of held-out drives")
    draw(8, "failure", _sharing, "failure of held-out drives")
    draw(9, "nodes", _robots, "nodes on the robots")
    draw(9, "time", _times, "time of localising, second foray")
    draw(9, "failure", _in_field, "failure in the second foray")
    draw(9, "downloads", _downloads, "held-out drives in downloads")
    draw(10, "orders", _orders, "held-out drives, all orders")
    for arm in arms:
        if arm.asked(9):
            written += _draw_sizes(out, arm)
    return written


def _title(arm: ArmResult) -> str:
    return f"{arm.plan.drives.name}, arm {arm.arm.letter}: {arm.arm.words}"


def _nodes(arm: ArmResult) -> Panel:
    """Fig. 7a: nodes against time, by counts, of the first fold that has both."""
    lines: list[Line] = []
    for fold in arm.folds if arm.stages else ():
        single, built = fold.single(), fold.parallel(arm.plan.options.groups)
        if single is None or built is None:
            continue
        x = np.cumsum(_counted_s(fold.time_of([one]) for one in single))
        lines.append(Line("one agent", x, np.array([one.nodes for one in single], float)))
        for number, sessions in enumerate(built.groups):
            x = np.cumsum(_counted_s(fold.time_of([one]) for one in sessions))
            y = np.array([one.nodes for one in sessions], float)
            lines.append(Line(f"group {number}", x, y, marks=False))
        merges = np.cumsum(_counted_s(built.merge_times))
        x = _counted_s(built.group_times).max() + np.array([0.0, *merges])
        y = np.array([built.groups[0][-1].nodes, *(one.nodes for one in built.merges)], float)
        lines.append(Line("merging", x, y))
        break
    return Panel(_title(arm), "s, by counts, on one core", "nodes", lines)


def _counted_s(times: Iterable[Time]) -> Array:
    return np.array([one.counted_s for one in times], np.float64)


def _building(arm: ArmResult) -> Panel:
    """Fig. 7b."""
    groups = arm.plan.options.groups
    names = {"one agent": SINGLE, f"{groups} groups merged": merged_name(groups, groups - 1)}
    return _held_out_panel(arm, names)


def _sharing(arm: ArmResult) -> Panel:
    """Fig. 8."""
    return _held_out_panel(arm, {**{one: one for one in ROBOTS}, "shared": SHARED})


def _held_out_panel(arm: ArmResult, names: dict[str, str]) -> Panel:
    found = arm.held_out(*names.values())
    lines = []
    for label, one in zip(names, found or [], strict=False):
        lines.append(_curve(label, one.drives, arm.plan.options.seed))
    return Panel(_title(arm), "x, m", _P, lines, least_y=_LEAST_PERCENT)


def _curve(label: str, drives: Sequence[Drive], seed: int) -> Line:
    return failure_line(label, drives, Resamples.of(len(drives), seed=seed))


def _robots(arm: ArmResult) -> Panel:
    """Fig. 9a: nodes on each robot, log by log; between the forays it docks."""
    lines = []
    fold = next((one for one in arm.folds if one.forays()), None)
    if fold is not None:
        for robot in ROBOTS:
            first = [one.nodes for one in fold.sessions(f"{robot}-first")]
            for policy in FORAY_POLICIES:
                second = [one.nodes for one in fold.in_field(robot, policy)]
                y = np.array([*first, *second], float)
                x = np.arange(1, len(y) + 1, dtype=float)
                lines.append(Line(f"{robot}, {policy}", x, y))
    return Panel(_title(arm), "log", "nodes", lines)


def _times(arm: ArmResult) -> Panel:
    """Fig. 9b: ms per frame of the second foray's logs, mean over robots and folds."""
    lines = []
    for policy in FORAY_POLICIES:
        series = _series(arm, policy)
        if len(series):
            first = len(arm.folds[0].plan.forays(arm.folds[0].fold)["r1"][0])
            x = first + 1 + np.arange(series.shape[1], dtype=float)
            lines.append(Line(policy, x, series.mean(axis=0)))
    return Panel(_title(arm), "log", "ms per frame", lines)


def _series(arm: ArmResult, policy: str) -> Array:
    """(robots × folds, logs) ms per frame; (0, 0) where no foray was driven yet."""
    driven = [
        [one.ms for one in fold.in_field(robot, policy)]
        for fold in arm.folds
        if fold.forays()
        for robot in ROBOTS
    ]
    logs = min((len(one) for one in driven), default=0)
    return np.array([one[:logs] for one in driven]).reshape(len(driven), logs)


def _in_field(arm: ArmResult) -> Panel:
    """Fig. 9c."""
    lines = []
    for policy in FORAY_POLICIES:
        drives = [one.drive for one in arm.forays(policy)]
        if drives:
            lines.append(_curve(policy, drives, arm.plan.options.seed))
    return Panel(_title(arm), "x, m", _P, lines, least_y=_LEAST_PERCENT)


def _downloads(arm: ArmResult) -> Panel:
    """Held-out drives in downloads for their own hours; not every policy has one for every drive.

    Without bands: of seven curves they would hide each other. Paired intervals are in `report.md`.
    """
    trials = arm.trials()
    most = max((len(tried) for tried in trials.values()), default=0)
    lines, drives = [], f"{most} drives"
    for name, tried in trials.items():
        curve = _curve(name, [one.drive for _, one in tried], arm.plan.options.seed)
        lines.append(replace(curve, low=None, high=None))
        if len(tried) < most and name in FORAY_POLICIES:
            drives += f", {name} {len(tried)}"
    return Panel(f"{_title(arm)}\n{drives}", "x, m", _P, lines, least_y=1)


def _orders(arm: ArmResult) -> Panel:
    """Fig. 10: one curve per order, and the chosen one."""
    fold: FoldResult = arm.folds[0]
    found = fold.orders()
    lines = []
    if found is not None:
        for place, one in enumerate(found["orders"][::-1]):
            y = 100 * np.array(one["reported"])
            last = place == len(found["orders"]) - 1
            label = "chosen on validation" if last else "other orders"
            lines.append(Line(label, CURVE_AT_M, y, marks=False))
    return Panel(_title(arm), "x, m", _P, lines, least_y=_LEAST_PERCENT)


def _draw_sizes(out: Path, arm: ArmResult) -> list[Path]:
    """Nodes, bytes, failure and time of the downloads."""
    trials = {name: [one for _, one in some] for name, some in arm.trials().items()}
    if not trials:
        return []
    measures: dict[str, Callable[[Sequence[TriedDownload]], float]] = {
        "nodes, % of the centre's": lambda some: 100 * _mean(x.nodes / x.of_nodes for x in some),
        "MB": lambda some: _mean(x.size_bytes / 1e6 for x in some),
        "route not localised, %": lambda some: 100 * route_not_localised([x.drive for x in some]),
        "ms per localisation": lambda some: _mean(x.ms for x in some),
    }
    bars = [
        (what, [(name, measure(some)) for name, some in trials.items()])
        for what, measure in measures.items()
    ]
    path = out / f"downloads_{arm.plan.drives.name}_{arm.arm.letter}.png"
    draw_bars(bars, path, f"{_title(arm)}; downloads for the hour of each held-out drive")
    return [path]


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))
