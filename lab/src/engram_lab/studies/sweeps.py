"""What the sweeps over budgets and map sizes gave, as tables; the figures draw the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from engram_lab.studies.configurations import Configuration, PathKinds, lanes_text
from engram_lab.studies.summary import CampaignResult, ConfigurationResult
from engram_lab.studies.wording import table

# So many map sizes are shown, evenly over those that there are.
_SHOWN_SIZES = 8


def by_map_size(campaign: CampaignResult, policy: str) -> list[ConfigurationResult]:
    """A policy in the map after each training session, smallest first ([L15] Fig. 9).

    Only sizes that every fold has; empty where the whole map was not run.
    """
    whole = campaign.get(policy)
    if whole is None:
        return []
    smaller = [
        one
        for one in campaign.memo.values()
        if one.configuration.sessions is not None
        and replace(one.configuration, sessions=None) == whole.configuration
        and len(one.sessions) == len(whole.sessions)
    ]
    return [*sorted(smaller, key=lambda one: one.configuration.sessions or 0), whole]


def by_lanes(
    campaign: CampaignResult,
    policy: str,
    paths: PathKinds = PathKinds.ALL,
    rounds: int | None = None,
) -> list[ConfigurationResult]:
    """A policy under each number of lanes, fewest first ([L15] Fig. 11).

    Args:
        campaign: all results.
        policy: key of `POLICIES`.
        paths: which entries count in path memory.
        rounds: Nr; None for that of the other figures.
    """
    nr = campaign.rounds if rounds is None else rounds
    found = [
        one
        for one in campaign.memo.values()
        if one.configuration == Configuration(policy, one.configuration.lanes, nr, paths=paths)
    ]
    return sorted(found, key=lambda one: one.configuration.lanes)


def sweep_tables(campaign: CampaignResult) -> list[str]:
    """Markdown lines: failure by lanes and rounds, and by the size of the map."""
    lines: list[str] = []
    for title, measure in (
        ("Route not localised", _not_localised),
        ("P(> 10 m)", _p_gt_10m),
    ):
        lines += _budgets(campaign, title, measure)
    lines += _sizes(campaign)
    return lines


def _budgets(
    campaign: CampaignResult, title: str, measure: Callable[[ConfigurationResult], str]
) -> list[str]:
    found: dict[str, dict[int, ConfigurationResult]] = {}
    for rounds in sorted({one.rounds for one in campaign.memo}):
        behind = f", Nr = {rounds}" if rounds > 1 else ""
        for policy in campaign.policies:
            for paths in PathKinds:
                results = by_lanes(campaign, policy, paths, rounds)
                if len(results) > 1:
                    label = results[0].configuration.label + behind
                    found[label] = {one.configuration.lanes: one for one in results}
    lanes = sorted({one for results in found.values() for one in results})
    if not lanes:
        return []
    head = ["Np", *map(lanes_text, lanes)]
    rows = [
        [label, *(measure(results[one]) if one in results else "–" for one in lanes)]
        for label, results in found.items()
    ]
    return [f"{title} by the number of lanes, %", "", *table(head, rows), ""]


def _sizes(campaign: CampaignResult) -> list[str]:
    """P(> 10 m) in maps of so many sessions; a share of the sizes that there are."""
    found = {policy: by_map_size(campaign, policy) for policy in campaign.policies}
    found = {policy: results for policy, results in found.items() if len(results) > 1}
    if not found:
        return []
    longest = max(found.values(), key=len)
    shown = _evenly(len(longest))
    wanted = [longest[k].configuration.sessions for k in shown]
    head = [
        "sessions in the map (nodes)",
        *(f"{one or 'all'} ({_nodes(longest[k])})" for k, one in zip(shown, wanted, strict=True)),
    ]
    rows = []
    for policy, results in found.items():
        known = {one.configuration.sessions: one for one in results}
        rows.append([policy, *(_p_gt_10m(known[one]) if one in known else "–" for one in wanted)])
    title = f"P(> 10 m) as the map grows, Np = {lanes_text(campaign.few_lanes)}, %"
    return [title, "", *table(head, rows), ""]


def _evenly(count: int) -> Sequence[int]:
    shown = np.linspace(0, count - 1, min(count, _SHOWN_SIZES)).round().astype(int)
    return [int(one) for one in shown]


def _nodes(result: ConfigurationResult) -> int:
    return round(float(np.mean([one.nodes for one in result.sessions])))


def _not_localised(result: ConfigurationResult) -> str:
    return f"{100 * result.not_localised.value:.2f}"


def _p_gt_10m(result: ConfigurationResult) -> str:
    return f"{100 * result.failure(10.0).value:.2f}"
