"""[L15] Figs. 9 to 13 on our data, and what each policy costs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from engram.measures import FORMULAS, Estimator
from engram_lab.charts import Line, Panel, draw_bars, draw_curves
from engram_lab.studies.configurations import UNLIMITED, Configuration, PathKinds, lanes_text
from engram_lab.studies.curves import failure_line, row_line
from engram_lab.studies.pages import Row, chosen
from engram_lab.studies.ranking_rows import labelled, policy_rows, rows_by_size
from engram_lab.studies.summary import CampaignResult

# Unlimited lanes stand one step behind the last number.
_BEYOND = 20.0
# A policy has one colour in all figures, whichever others are drawn beside it.
POLICY_COLOURS = {
    "distance": "C0",
    "path-near": "C1",
    "path": "C2",
    "random": "C3",
    "oracle": "C4",
    "time-of-day": "C5",
    "bag-of-words": "C6",
    "collaborative": "C7",
    "nearest-of-each": "C8",
    "bandit": "C9",
    "recall": "black",
}
_LOOKS = {policy: (colour, "-") for policy, colour in POLICY_COLOURS.items()} | {
    Configuration("path-near", paths=kinds).label: (POLICY_COLOURS["path-near"], "--")
    for kinds in PathKinds
}


def draw_figures(out: Path, campaigns: Sequence[CampaignResult], rows: Sequence[Row]) -> list[Path]:
    """Draws every figure for which results are there; returns the files.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    written: list[Path] = []
    own = {one.name: labelled(one, rows) for one in campaigns}

    def draw(name: str, panels: Sequence[Panel], title: str) -> None:
        shown = [panel for panel in panels if panel.lines]
        if shown:
            draw_curves(shown, out / name, title, _LOOKS)
            written.append(out / name)

    few = ", ".join(sorted(set(map(_budget, campaigns))))
    rounds = ", ".join(sorted({f"Nr = {one.rounds}" for one in campaigns}))
    memory = ", ".join(sorted({f"T = {one.T}" for one in campaigns}))
    sizes = [_map_size(one, own[one.name]) for one in campaigns]
    draw("fig09_map_size.png", sizes, f"failure as the map grows, {few}")
    draw("fig10_candidates.png", list(map(_lap, campaigns)), "candidates along an ordinary lap")
    for name, column, label in (
        ("lanes", "p_gt_10m", "P(no match for > 10 m), %"),
        ("lanes_not_localised", "share_not_localised", "route not localised, %"),
        ("lanes_against_distance", "minus_distance", "route not localised less distance's, points"),
    ):
        panels = [_lanes(one, own[one.name], column, label) for one in campaigns]
        title = f"failure against the number of lanes, {rounds}, {memory}"
        draw(f"fig11_{name}.png", panels, title)
    for estimator, scaled in (*((one, False) for one in Estimator), (Estimator.LOST, True)):
        name = f"fig12_curves_{estimator.value}{'_scaled' if scaled else ''}.png"
        panels = [_curves(c, twice, estimator, scaled) for twice in (1, 2) for c in campaigns]
        formula = FORMULAS[estimator] + (" · share of route not localised" if scaled else "")
        draw(name, panels, f"failure curves, {rounds}; P(X ≥ x) = {formula}")
    swept = [_sensitivity(one, own[one.name]) for one in campaigns]
    draw("fig13_T.png", swept, f"sensitivity of path-near to T, {few}")
    for one in campaigns:
        written += _draw_costs(out, one, own[one.name])
    return written


def _budget(campaign: CampaignResult) -> str:
    return f"Np = {lanes_text(campaign.few_lanes)}, Nr = {campaign.rounds}"


def _lines(rows: Sequence[Row], x: str, column: str) -> list[Line]:
    """One line per label that has several points."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row["label"], []).append(row)
    return [
        row_line(label, some, [row[x] for row in some], column)
        for label, some in found.items()
        if len(some) > 1 and all(column in row for row in some)
    ]


def _map_size(campaign: CampaignResult, own: Sequence[Row]) -> Panel:
    """[L15] Fig. 9: P(> 10 m) against nodes, after each training session."""
    lines = _lines(rows_by_size(campaign, own), "nodes", "p_gt_10m")
    # The first map, of one drive, misses ten times as much as the next.
    label = "P(no match for > 10 m), %"
    return Panel(campaign.name, "nodes in the map", label, lines, least_y=0.1)


def _lap(campaign: CampaignResult) -> Panel:
    """[L15] Fig. 10: |Y| and how many of it could succeed, along one lap."""
    lap = campaign.lap
    if lap is None:
        return Panel(campaign.name, "", "", [])
    lines = [
        Line("candidates |Y|", lap.driven_m, lap.candidates.astype(np.float64), marks=False),
        Line("that match", lap.driven_m, lap.succeeded.astype(np.float64), marks=False),
    ]
    return Panel(f"{campaign.name}, {lap.name}", "driven, m", "nodes", lines)


def _lanes(campaign: CampaignResult, own: Sequence[Row], column: str, label: str) -> Panel:
    """[L15] Fig. 11: failure against Np; differences are paired."""
    swept = chosen(own, rounds=campaign.rounds, T=campaign.T, radius="search", map_sessions=None)
    if column == "minus_distance":
        swept = chosen(swept, paths=campaign.paths.value)
    placed = [{**row, "x": _place(row["lanes"])} for row in swept]
    placed.sort(key=lambda row: row["x"])
    lines = [
        replace(one, loose_end=bool(one.x[-1] == _BEYOND)) for one in _lines(placed, "x", column)
    ]
    places = sorted({float(x) for line in lines for x in line.x})
    ticks = [(x, "∞" if x == _BEYOND else f"{x:.0f}") for x in places]
    signed = column == "minus_distance"
    return Panel(campaign.name, "Np", label, lines, ticks, signed=signed)


def _place(lanes: str) -> float:
    return _BEYOND if lanes == lanes_text(UNLIMITED) else float(lanes)


def _curves(campaign: CampaignResult, twice: int, estimator: Estimator, scaled: bool) -> Panel:
    """[L15] Fig. 12: P(X ≥ x), under the few lanes or twice as many."""
    lanes = twice * campaign.few_lanes
    results = [campaign.get(policy, lanes) for policy in campaign.policies]
    lines = [
        failure_line(
            one.configuration.policy, one.drives, campaign.resamples, estimator, scaled=scaled
        )
        for one in results
        if one is not None
    ]
    title = f"{campaign.name}, Np = {lanes_text(lanes)}"
    return Panel(title, "x, m", "P(X ≥ x), %", lines, least_y=0.01)


def _sensitivity(campaign: CampaignResult, own: Sequence[Row]) -> Panel:
    """[L15] Fig. 13: T."""
    lanes = lanes_text(campaign.few_lanes)
    some = chosen(own, label="path-near", lanes=lanes, rounds=campaign.rounds, map_sessions=None)
    some.sort(key=lambda row: row["T"])
    places = list(range(len(some)))
    ticks = [(float(x), str(row["T"])) for x, row in zip(places, some, strict=True)]
    columns = {"P(> 10 m)": "p_gt_10m", "route not localised": "share_not_localised"}
    if len(some) < 2:  # path-near was not run, or with one T
        return Panel(campaign.name, "T", "%", [], ticks)
    lines = [row_line(label, some, places, column) for label, column in columns.items()]
    return Panel(campaign.name, "T", "%", lines, ticks)


def _draw_costs(out: Path, campaign: CampaignResult, own: Sequence[Row]) -> list[Path]:
    """Attempts, time, false successes and pose errors of all policies at the few lanes."""
    rows = [row for row in policy_rows(campaign, own) if row["label"] == row["policy"]]
    if not rows:
        return []
    bars = []
    for title, column, scale in (
        ("attempts per frame", "attempts_per_frame", 1.0),
        ("ms per frame (guided, no memo)", "ms_as_on_a_robot", 1.0),
        ("false successes", "false_successes", 1.0),
        ("median error, cm", "median_error_m", 100.0),
    ):
        known = [(row["policy"], scale * row[column]) for row in rows if row[column] is not None]
        if known:
            bars.append((title, known))
    path = out / f"costs_{campaign.name}.png"
    draw_bars(bars, path, f"{campaign.name}, {_budget(campaign)}")
    return [path]
