"""The tidy table of the ranking study: a row per configuration and fold; pooled ones say all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from engram.measures import Estimator
from engram_lab.intervals import Interval, Resamples, difference
from engram_lab.studies.configurations import (
    UNLIMITED,
    Configuration,
    Radius,
    lanes_text,
)
from engram_lab.studies.in_force import columns
from engram_lab.studies.pages import Row, chosen
from engram_lab.studies.summary import CampaignResult, ConfigurationResult

_AT_M = (5.0, 10.0)
_USUAL = {"mode": "memo", "fold": "all"}


def summary_rows(campaign: CampaignResult) -> list[Row]:
    """One row per configuration and fold, and one of all folds pooled, with 90 % intervals."""
    rows = []
    for mode, results in (("memo", campaign.memo), ("live", campaign.live)):
        for result in results.values():
            rows += [
                _row(campaign, mode, result.of_fold(fold), str(fold))
                for fold in sorted({one.fold for one in result.sessions})
            ]
            pooled = _row(campaign, mode, result, "all")
            rows.append(pooled | _intervals(campaign, result))
            if mode == "memo":
                rows[-1] |= _beside_others(campaign, result)
    return rows


def session_rows(campaign: CampaignResult) -> list[Row]:
    """One row per configuration and session, in the whole map."""
    return [
        {
            "session": session.session,
            **_row(
                campaign,
                mode,
                ConfigurationResult(result.configuration, [session]),
                str(session.fold),
            ),
        }
        for mode, results in (("memo", campaign.memo), ("live", campaign.live))
        for result in results.values()
        if result.configuration.sessions is None
        for session in result.sessions
    ]


def _row(campaign: CampaignResult, mode: str, result: ConfigurationResult, fold: str) -> Row:
    configuration, errors = result.configuration, result.errors
    known = len(errors.offset_m) > 0
    return {
        "campaign": campaign.name,
        "policy": configuration.policy,
        "lanes": configuration.lanes_text,
        "rounds": configuration.rounds,
        "T": campaign.T_of(configuration),
        "radius": configuration.radius.value,
        "paths": (configuration.paths or campaign.paths).value,
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
        "median_error_m": float(np.median(errors.offset_m)) if known else None,
        "median_error_deg": float(np.rad2deg(np.median(errors.turn_rad))) if known else None,
        "successes": result.successes,
        "p_gt_5m": result.failure(5.0).value,
        **{
            f"p_gt_{at_m:.0f}m_{estimator.value}": result.failure(at_m, estimator).value
            for estimator in (Estimator.GAP, Estimator.LOST)
            for at_m in _AT_M
        },
        "longest_gap_m": result.longest_gap_m,
        "candidates_per_frame": float(np.mean([one.candidates for one in result.sessions])),
        "nodes": float(np.mean([one.nodes for one in result.sessions])),
        "step_ms_without_matching": result.step_ms if mode == "memo" else None,
        **{name: value for name, value in columns(result.in_force).items() if name != "T"},
    }


def _intervals(campaign: CampaignResult, result: ConfigurationResult) -> Row:
    resamples = Resamples.of(len(result.sessions), seed=campaign.seed)
    found: Row = {}
    for name, sums in (
        ("p_gt_10m", result.failure(10.0)),
        ("share_not_localised", result.not_localised),
    ):
        interval = resamples.interval(sums)
        found |= {f"{name}_low": interval.low, f"{name}_high": interval.high}
    return found


def _beside_others(campaign: CampaignResult, result: ConfigurationResult) -> Row:
    """Excess over the oracle, and the paired difference from `distance`, under the same budget."""
    mine = result.configuration
    plain = Configuration("oracle", mine.lanes, mine.rounds, sessions=mine.sessions)
    bound = campaign.memo.get(plain)
    nearest = campaign.memo.get(replace(plain, policy="distance"))
    row: Row = {}
    if bound is not None:
        row["excess_not_localised"] = result.not_localised.value - bound.not_localised.value
        row["excess_p_gt_10m"] = result.failure(10.0).value - bound.failure(10.0).value
    if nearest is not None:
        gap = campaign.resamples.interval(difference(result.not_localised, nearest.not_localised))
        row["minus_distance"] = gap.estimate
        row |= {"minus_distance_low": gap.low, "minus_distance_high": gap.high}
    return row


def few_lanes_results(campaign: CampaignResult) -> list[ConfigurationResult]:
    """Every policy, and the variants of the path policies."""
    found = [campaign.get(policy) for policy in campaign.policies]
    found += [
        campaign.get(policy, **variant)
        for policy in ("path-near", "path")
        for variant in ({"radius": Radius.BASIN}, {"paths": campaign.paths.other})
    ]
    return [one for one in found if one is not None]


def labelled(campaign: CampaignResult, rows: Sequence[Row]) -> list[Row]:
    """The memoised rows of all folds, by what is unusual about them."""
    labels = {
        (one.policy, one.radius.value, (one.paths or campaign.paths).value): one.label
        for one in campaign.memo
    }
    return [
        {**row, "label": labels[row["policy"], row["radius"], row["paths"]]}
        for row in chosen(rows, campaign=campaign.name, **_USUAL)
    ]


def policy_rows(campaign: CampaignResult, own: Sequence[Row]) -> list[Row]:
    """All policies at the few lanes, losers too."""
    timed = {one.policy: result.step_ms for one, result in campaign.live.items()}
    rows = []
    for result in few_lanes_results(campaign):
        one = result.configuration
        (row,) = chosen(
            own, label=one.label, lanes=one.lanes_text, rounds=one.rounds, T=campaign.T,
            map_sessions=None,
        )  # fmt: skip
        ms = timed.get(one.policy) if one.label == one.policy else None
        rows.append({**row, "ms_as_on_a_robot": ms, "beats_distance": _verdict(row)})
    return rows


_VERDICTS = {True: "yes", False: "no", None: "no difference shown"}


def _verdict(row: Row) -> str:
    """Whether a policy misses less of the route than `distance` (method §8)."""
    if row["label"] == "distance" or "minus_distance" not in row:
        return ""
    gap = Interval(*(row[f"minus_distance{end}"] for end in ("", "_low", "_high")))
    return _VERDICTS[gap.lower]


def rows_by_size(campaign: CampaignResult, own: Sequence[Row]) -> list[Row]:
    """The rows at the few lanes, by the number of sessions in the map ([L15] Fig. 9)."""
    few = chosen(
        own, lanes=lanes_text(campaign.few_lanes), rounds=campaign.rounds, T=campaign.T,
        radius="search", paths=campaign.paths.value,
    )  # fmt: skip
    return sorted(few, key=lambda row: row["map_sessions"] or UNLIMITED)
