"""[G16] Figs. 7 to 10 on our data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.evaluation.fleet.experiments import SHARED, SINGLE, merged_name
from engram.evaluation.fleet.plan import FORAY_POLICIES, ROBOTS
from engram.evaluation.fleet.results import ArmResult, FoldResult
from engram.evaluation.fleet.trials import COPY, TriedDownload
from engram.measures import Drive, Resamples, SessionSums, failure_sums, route_not_localised
from engram.viewing import Line, Panel, draw_bars, draw_curves

Array = NDArray[np.float64]
_CURVE_AT_M = np.arange(0.0, 50.5, 0.5)
_LEAST_PERCENT = 0.01
_P = "P(X ≥ x), %"


def draw_fleet_figures(out: Path, arms: Sequence[ArmResult]) -> list[Path]:
    """Draws every figure for which results are there; returns the files.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    written: list[Path] = []

    def draw(name: str, panels: Sequence[Panel], title: str) -> None:
        shown = [panel for panel in panels if panel.lines]
        if shown:
            draw_curves(shown, out / name, title)
            written.append(out / name)

    draw("fig07_nodes.png", [_nodes(arm) for arm in arms], "size of the map while it is built")
    draw("fig07_failure.png", [_building(arm) for arm in arms], "failure of held-out drives")
    draw("fig08_failure.png", [_sharing(arm) for arm in arms], "failure of held-out drives")
    draw("fig09_nodes.png", [_robots(arm) for arm in arms], "nodes on the robots")
    draw("fig09_time.png", [_times(arm) for arm in arms], "time of localising, second foray")
    draw("fig09_failure.png", [_in_field(arm) for arm in arms], "failure in the second foray")
    draw("fig09_downloads.png", [_downloads(arm) for arm in arms], "held-out drives in downloads")
    draw("fig10_orders.png", [_orders(arm) for arm in arms], "held-out drives, all orders")
    for arm in arms:
        written += _draw_sizes(out, arm)
    return written


def _title(arm: ArmResult) -> str:
    return f"{arm.plan.drives.name}, arm {arm.arm.letter}: {arm.arm.words}"


def _nodes(arm: ArmResult) -> Panel:
    """Fig. 7a: nodes against time, by counts, of the first fold that has both."""
    lines: list[Line] = []
    for fold in arm.folds:
        single, built = fold.single(), fold.parallel(arm.plan.options.groups)
        if single is None or built is None:
            continue
        x = np.cumsum([fold.time_of([one]).counted_s for one in single])
        lines.append(Line("one agent", x, np.array([one.nodes for one in single], float)))
        for number, sessions in enumerate(built.groups):
            x = np.cumsum([fold.time_of([one]).counted_s for one in sessions])
            y = np.array([one.nodes for one in sessions], float)
            lines.append(Line(f"group {number}", x, y, marks=False))
        slowest = max(one.counted_s for one in built.group_times)
        x = slowest + np.cumsum([0.0] + [one.counted_s for one in built.merge_times])
        y = np.array([built.groups[0][-1].nodes, *(one.nodes for one in built.merges)], float)
        lines.append(Line("merging", x, y))
        break
    return Panel(_title(arm), "s, by counts, on one core", "nodes", lines)


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
    """P(X ≥ x) with a 90 % band over sessions."""
    resamples = Resamples.of(len(drives), seed=seed)
    parts = [failure_sums(one, _CURVE_AT_M) for one in drives]
    below = np.array([part[1] for part in parts])
    bands = [
        resamples.interval(SessionSums(np.array([part[0][k] for part in parts]), below))
        for k in range(len(_CURVE_AT_M))
    ]
    y, low, high = (
        100 * np.array([getattr(band, end) for band in bands])
        for end in ("estimate", "low", "high")
    )
    return Line(label, _CURVE_AT_M, y, low, high, marks=False)


def _robots(arm: ArmResult) -> Panel:
    """Fig. 9a: nodes on each robot, log by log; between the forays it docks."""
    lines = []
    fold = next((one for one in arm.folds if one.in_field("r1", COPY)), None)
    if fold is not None:
        for robot in ROBOTS:
            first = [one.nodes for one in fold.sessions(f"{robot}-first")]
            for policy in FORAY_POLICIES:
                second = [one.nodes for one in fold.in_field(robot, policy)]
                if second:
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
        times
        for fold in arm.folds
        for robot in ROBOTS
        if (times := [one.ms for one in fold.in_field(robot, policy)])
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
    """Held-out drives in downloads for their own hours."""
    lines = [
        _curve(name, [one.drive for _, one in tried], arm.plan.options.seed)
        for name, tried in arm.trials().items()
    ]
    return Panel(_title(arm), "x, m", _P, lines, least_y=_LEAST_PERCENT)


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
            lines.append(Line(label, _CURVE_AT_M, y, marks=False))
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
