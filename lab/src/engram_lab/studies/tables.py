"""The tables of an evaluation as CSV."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from engram_lab.intervals import Estimator, Resamples
from engram_lab.studies.configurations import Configuration
from engram_lab.studies.summary import CampaignResult, ConfigurationResult

_AT_M = (5.0, 10.0)


def summary_rows(campaign: CampaignResult) -> list[dict[str, Any]]:
    """One row per configuration and fold, and one of all folds pooled, with 90 % intervals."""
    rows = []
    for mode, results in (("memo", campaign.memo), ("live", campaign.live)):
        for result in results.values():
            bound = campaign.memo.get(_bound(result.configuration)) if mode == "memo" else None
            rows += [
                _row(campaign, mode, result.of_fold(fold), str(fold), None, None)
                for fold in sorted({one.fold for one in result.sessions})
            ]
            resamples = Resamples.of(len(result.sessions), seed=campaign.seed)
            rows.append(_row(campaign, mode, result, "all", resamples, bound))
    return rows


def _bound(configuration: Configuration) -> Configuration:
    """The oracle under the same budget, in the same map."""
    plain = Configuration("oracle", configuration.lanes, configuration.rounds)
    return replace(plain, sessions=configuration.sessions)


def session_rows(campaign: CampaignResult) -> list[dict[str, Any]]:
    """One row per configuration and session, in the whole map."""
    rows = []
    for mode, results in (("memo", campaign.memo), ("live", campaign.live)):
        for result in results.values():
            if result.configuration.sessions is not None:
                continue
            for session in result.sessions:
                alone = ConfigurationResult(result.configuration, [session])
                row = _row(campaign, mode, alone, str(session.fold), None, None)
                rows.append({"session": session.session, "nodes": session.nodes, **row})
    return rows


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Writes a table in one step; columns are the keys of all rows."""
    columns = dict.fromkeys(name for row in rows for name in row)
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    with draft.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(columns))
        writer.writeheader()
        writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    draft.replace(path)


def _row(
    campaign: CampaignResult,
    mode: str,
    result: ConfigurationResult,
    fold: str,
    resamples: Resamples | None,
    bound: ConfigurationResult | None,
) -> dict[str, Any]:
    configuration = result.configuration
    errors = result.errors
    row: dict[str, Any] = {
        "campaign": campaign.name,
        "policy": configuration.policy,
        "lanes": configuration.lanes_text,
        "rounds": configuration.rounds,
        "T": configuration.T,
        "radius": configuration.radius.value,
        "paths": configuration.paths.value,
        "map_sessions": configuration.sessions,
        "mode": mode,
        "fold": fold,
        "sessions": len(result.sessions),
        "frames": result.frames,
        "driven_m": float(result.driven_m.sum()),
        "p_gt_10m": result.failure(10.0).value,
        "share_not_localised": result.not_localised.value,
        "attempts_per_frame": result.attempts_per_frame,
        "ms_per_frame": result.step_ms if mode == "live" else None,
        "false_successes": result.false_successes,
        "median_error_m": float(np.median(errors.offset_m)) if len(errors.offset_m) else None,
        "median_error_deg": float(np.rad2deg(np.median(errors.turn_rad)))
        if len(errors.turn_rad)
        else None,
        "successes": result.successes,
        "p_gt_5m": result.failure(5.0).value,
        **{
            f"p_gt_{at_m:.0f}m_{estimator.value}": result.failure(at_m, estimator).value
            for estimator in (Estimator.GAP, Estimator.LOST)
            for at_m in _AT_M
        },
        "longest_gap_m": result.longest_gap_m,
        "candidates_per_frame": _mean(result, "candidates"),
        "nodes": float(np.mean([one.nodes for one in result.sessions])),
        "step_ms_without_matching": result.step_ms if mode == "memo" else None,
    }
    if resamples is not None:
        row |= _intervals(result, resamples)
    if bound is not None:
        row["excess_not_localised"] = result.not_localised.value - bound.not_localised.value
        row["excess_p_gt_10m"] = result.failure(10.0).value - bound.failure(10.0).value
    return row


def _intervals(result: ConfigurationResult, resamples: Resamples) -> dict[str, float]:
    found: dict[str, float] = {}
    for name, sums in (
        ("p_gt_10m", result.failure(10.0)),
        ("share_not_localised", result.not_localised),
    ):
        interval = resamples.interval(sums)
        found[f"{name}_low"], found[f"{name}_high"] = interval.low, interval.high
    return found


def _mean(result: ConfigurationResult, name: str) -> float:
    return float(np.mean([getattr(one, name) for one in result.sessions]))


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else value
