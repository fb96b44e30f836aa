"""What the paper claims, beside what was measured: a page in Markdown (issue's "must reach")."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from engram_lab.intervals import Resamples, SessionSums, beats, difference, excess_ratio, ratio
from engram_lab.studies.configurations import (
    EVERYTHING,
    UNLIMITED,
    Configuration,
    PathKinds,
    Radius,
    lanes_text,
)
from engram_lab.studies.summary import CampaignResult, ConfigurationResult
from engram_lab.studies.sweeps import sweep_tables
from engram_lab.studies.wording import Row, against, percent, table, times

# Shares as low as this differ by less than anyone would notice: added to both sides of ratios to
# the oracle.
_NEGLIGIBLE = 0.005
_BEST_KNOWN = "recall"


def claims_page(campaigns: Sequence[CampaignResult]) -> str:
    """The tables of all campaigns, as Markdown. Intervals are 90 %, by bootstrap over sessions."""
    lines: list[str] = []
    for campaign in campaigns:
        lines += [f"## {campaign.name}", "", *_left_out(campaign)]
        lines += [*_policies(campaign), "", *_claims(campaign), ""]
        lines += [*sweep_tables(campaign), *_guided(campaign)]
        if not campaign.with_truth:
            lines += [
                "The drives have no truth beside them: no pose errors, no false successes.",
                "",
            ]
    return "\n".join([*lines, *_pooled(campaigns)])


def _pooled(campaigns: Sequence[CampaignResult]) -> list[str]:
    """All sessions of several campaigns together: whom our policy beats."""
    if len(campaigns) < 2:
        return []
    rows, ours = [], [one.get(_BEST_KNOWN) for one in campaigns]
    for other in ("path-near", "distance", "bandit"):
        theirs = [one.get(other) for one in campaigns]
        pairs = [
            (a, b) for a, b in zip(ours, theirs, strict=True) if a is not None and b is not None
        ]
        if len(pairs) < len(campaigns):
            continue
        a, b = (_together([pair[side].not_localised for pair in pairs]) for side in (0, 1))
        resamples = Resamples.of(len(a.numerator), seed=campaigns[0].seed)
        rows.append((f"`{_BEST_KNOWN}` against `{other}`", against(resamples, a, b)))
    if not rows:
        return []
    names = ", ".join(one.name for one in campaigns)
    return [
        "## All sessions pooled",
        "",
        *table((f"Np = {campaigns[0].few_lanes}: {names}", "measured"), rows),
        "",
    ]


def _together(sums: Sequence[SessionSums]) -> SessionSums:
    return SessionSums(
        np.concatenate([one.numerator for one in sums]),
        np.concatenate([one.denominator for one in sums]),
    )


def _left_out(campaign: CampaignResult) -> list[str]:
    """What was run on some sessions only: tables compare on the same sessions."""
    fewer: dict[str, list[int]] = {}
    for one, sessions in campaign.left_out.items():
        what = f"Np = {one.lanes_text}" if one.sessions is None else "Fig. 9"
        fewer.setdefault(f"{one.label} ({what})", []).append(sessions)
    if not fewer:
        return []
    told = ", ".join(f"{what} on {min(counts)}" for what, counts in fewer.items())
    all_sessions = max((len(one.sessions) for one in campaign.memo.values()), default=0)
    return [
        f"Not in these tables, since not run on the same {all_sessions} sessions: {told}. The same "
        "command without --only-folds completes them; --only-folds shows the folds that have them.",
        "",
    ]


def _policies(campaign: CampaignResult) -> list[str]:
    """All policies at the few lanes, losers too."""
    head = (
        "policy",
        "P(> 10 m)",
        "P(> 5 m)",
        "route not localised",
        "excess over the oracle",
        "longest gap",
        "attempts per frame",
        "ms per frame",
        "false successes",
        "median error",
        "beats distance",
    )
    rows = []
    bound, nearest = campaign.get("oracle"), campaign.get("distance")
    live = {one.policy: result for one, result in campaign.live.items()}
    for result in _few_lanes_results(campaign):
        policy = result.configuration.policy
        resamples, missed = campaign.resamples, result.not_localised
        plain = result.configuration.label == policy
        rows.append(
            (
                result.configuration.label,
                percent(resamples.interval(result.failure(10.0))),
                f"{100 * result.failure(5.0).value:.2f} %",
                percent(resamples.interval(missed)),
                "–"
                if bound is None
                else percent(resamples.interval(difference(missed, bound.not_localised))),
                f"{result.longest_gap_m:.0f} m",
                f"{result.attempts_per_frame:.2f}",
                f"{live[policy].step_ms:.1f}" if policy in live and plain else "–",
                _false(result),
                _error(result),
                "–"
                if nearest is None or result is nearest
                else ("yes" if beats(result.drives, nearest.drives) else "no"),
            )
        )
    count = max((len(one.sessions) for one in campaign.memo.values()), default=0)
    driven = max((one.driven_m.sum() for one in campaign.memo.values()), default=0.0)
    found_again = "no relocalisation" if campaign.relocaliser is None else campaign.relocaliser
    title = (
        f"Np = {lanes_text(campaign.few_lanes)}, Nr = {campaign.rounds}, T = 10; "
        f"{count} held-out sessions, {driven / 1e3:.1f} km, unguided, {found_again}"
    )
    return [title, "", *table(head, rows)]


def _few_lanes_results(campaign: CampaignResult) -> list[ConfigurationResult]:
    """Every policy, and the variants of the path policies."""
    found = [campaign.get(policy) for policy in campaign.policies]
    found += [
        campaign.get(policy, **variant)
        for policy in ("path-near", "path")
        for variant in ({"radius": Radius.BASIN}, {"paths": PathKinds.MATCHED})
    ]
    return [one for one in found if one is not None]


def _claims(campaign: CampaignResult) -> list[str]:
    rows = [*_path_claims(campaign), *_many_lanes(campaign), *_memory(campaign), *_recall(campaign)]
    rows += [*_growth(campaign), *_errors(campaign), *_seen(campaign)]
    rows += [*_order(campaign)]
    return table(("what", "paper", "must", "aim", "measured"), rows)


def _path_claims(campaign: CampaignResult) -> Iterable[Row]:
    nearest, bound = campaign.get("distance"), campaign.get("oracle")
    if nearest is None or bound is None:
        return
    few = campaign.few_lanes
    for result in _few_lanes_results(campaign):
        if result.configuration.policy not in {"path-near", "path"}:
            continue
        label = result.configuration.label
        excess = excess_ratio(nearest.not_localised, result.not_localised, bound.not_localised)
        raw = ratio(nearest.not_localised, result.not_localised)
        far = ratio(nearest.failure(10.0), result.failure(10.0))
        main = label == "path-near"
        yield (
            f"`distance` ÷ `{label}`, Np = {few}: excess over the oracle of route not localised",
            "5×" if main else "–",
            "3×, low end > 1.5×" if main else "reported",
            "5×" if main else "",
            f"{times(campaign.resamples.interval(excess))}; raw "
            f"{times(campaign.resamples.interval(raw))}; P(> 10 m) "
            f"{times(campaign.resamples.interval(far))}",
        )


def _many_lanes(campaign: CampaignResult) -> Iterable[Row]:
    path, nearest = campaign.get("path-near", 2), campaign.get("distance", 4)
    if path is not None and nearest is not None:
        yield (
            "`path-near` at Np = 2 against `distance` at Np = 4, route not localised",
            "equal",
            "equal or better",
            "",
            _against(campaign, path, nearest),
        )
    better, compared = [], []
    for lanes in sorted({one.lanes for one in campaign.memo}):
        a, b = campaign.get("path-near", lanes), campaign.get("distance", lanes)
        if a is None or b is None:
            continue
        gap = campaign.resamples.interval(difference(a.not_localised, b.not_localised))
        compared.append(a.configuration.lanes_text)
        if gap.estimate <= 0 or gap.low <= 0:
            better.append(a.configuration.lanes_text)
    if compared:
        yield (
            "`path-near` against `distance` at every Np",
            "better",
            "better or within the interval",
            "",
            f"at {len(better)} of {len(compared)}: Np = {', '.join(better) or '–'}",
        )
    a, b = campaign.get("path-near", UNLIMITED), campaign.get("distance", UNLIMITED)
    if a is not None and b is not None:
        yield ("both at unlimited Np", "equal", "equal", "", _against(campaign, a, b))


def _memory(campaign: CampaignResult) -> Iterable[Row]:
    usual, without = campaign.get("path-near"), campaign.get("path-near", T=0)
    if usual is None or without is None:
        return
    yield (
        "T = 0 against T = 10 for `path-near`, route not localised",
        "clearly worse",
        "worse, interval clear of 0",
        "",
        _against(campaign, without, usual),
    )
    some = [one for T in (5, 10, 20, 50, 100, 200) if (one := campaign.get("path-near", T=T))]
    for name, values in (
        ("route not localised", [one.not_localised.value for one in some]),
        ("P(> 10 m)", [one.failure(10.0).value for one in some]),
    ):
        spread = f"{max(values) / min(values):.2f}" if min(values) > 0 else "– (0 is reached)"
        yield (f"max ÷ min over T = 5…200, {name}", "flat", "≤ 1.3", "", spread)


def _recall(campaign: CampaignResult) -> Iterable[Row]:
    ours, bound = campaign.get(_BEST_KNOWN), campaign.get("oracle")
    if ours is None or bound is None:
        return
    to_bound = ratio(ours.not_localised, bound.not_localised, _NEGLIGIBLE)
    yield (
        f"`{_BEST_KNOWN}`: (route not localised + 0.5 %) ÷ (oracle's + 0.5 %)",
        "–",
        "≤ 1.6",
        "≤ 1.2",
        times(campaign.resamples.interval(to_bound)),
    )
    for other in ("path-near", "distance", "bandit"):
        result = campaign.get(other)
        if result is not None:
            must = "interval clear of 0 on the pooled sessions" if other == "bandit" else "better"
            yield (
                f"`{_BEST_KNOWN}` against `{other}`",
                "–",
                must,
                "",
                _against(campaign, ours, result),
            )
    nearest = campaign.get("distance")
    if nearest is not None:
        shares = [
            _share(campaign.resamples.interval(one.failure(10.0)).high, nearest.failure(10.0).value)
            for one in (ours, bound)
        ]
        share = f"{shares[0]} (the oracle's: {shares[1]})"
        what = f"P(> 10 m): upper end of `{_BEST_KNOWN}`'s interval ÷ `distance`'s mean"
        yield (what, "–", "≤ 0.25", "≤ 0.067", share)


def _share(high: float, mean: float) -> str:
    if mean > 0:
        return f"{high / mean:.3f}"
    return "– (both 0)" if high == 0 else "∞"


def _growth(campaign: CampaignResult) -> Iterable[Row]:
    for policy in ("distance", "path-near", _BEST_KNOWN):
        whole, first = campaign.get(policy), campaign.get(policy, sessions=1)
        if whole is None or first is None:
            continue
        fall = ratio(first.failure(10.0), whole.failure(10.0))
        paper = {"distance": "rises", "path-near": "falls 4×"}.get(policy, "–")
        must = "–" if policy == "distance" else "falls ≥ 2×"
        yield (
            f"`{policy}`: P(> 10 m) in the smallest map ÷ in the largest (Fig. 9)",
            paper,
            must,
            "" if policy == "distance" else "4×",
            times(campaign.resamples.interval(fall)),
        )


def _errors(campaign: CampaignResult) -> Iterable[Row]:
    if not campaign.with_truth:
        return
    results = [one for p in campaign.policies if (one := campaign.get(p)) is not None]
    worst = max(results, key=lambda one: one.false_share or 0.0, default=None)
    if worst is not None and worst.false_share is not None:
        yield (
            "false successes (> 1 m or > 5°), worst policy",
            "not told",
            "< 0.1 %",
            "0",
            f"{_false(worst)} (`{worst.configuration.policy}`)",
        )


def _seen(campaign: CampaignResult) -> Iterable[Row]:
    """Whether the neighbourhood sees every experience of the place (SPEC §3.1)."""
    result = campaign.memo.get(EVERYTHING)
    near = 0 if result is None else sum(one.near for one in result.sessions)
    if result is None or near == 0:
        return
    seen = sum(one.near_seen for one in result.sessions)
    what = "nodes truly within 8 m and 60° of a localised robot that are candidates"
    yield (what, "–", "≥ 95 %", "", f"{100 * seen / near:.2f} %")


def _order(campaign: CampaignResult) -> Iterable[Row]:
    """Whether the guided, unmemoised runs put the policies in the order of the memoised ones."""
    pairs = _guided_and_not(campaign)
    if len(pairs) < 2:
        return
    by_live = sorted(pairs, key=lambda pair: pair[0].not_localised.value)
    by_memo = sorted(pairs, key=lambda pair: pair[1].not_localised.value)
    text = ", ".join(_missed(live) for live, _ in by_live)
    if by_live != by_memo:
        text += "; memoised: " + ", ".join(_missed(memo) for _, memo in by_memo)
    what = f"route not localised guided and unmemoised, {len(pairs[0][0].sessions)} sessions"
    yield (what, "–", "order as memoised", "", text)


def _guided(campaign: CampaignResult) -> list[str]:
    """The product as it runs on a robot beside the memoised, unguided runs of the same sessions."""
    pairs = _guided_and_not(campaign)
    if not pairs:
        return []
    resamples = Resamples.of(len(pairs[0][0].sessions), seed=campaign.seed)
    head = (
        "policy",
        "route not localised",
        "unguided",
        "P(> 10 m)",
        "unguided",
        "false successes",
        "unguided",
        "ms per frame",
    )
    rows = [
        (
            live.configuration.policy,
            *(percent(resamples.interval(one.not_localised)) for one in (live, memo)),
            *(f"{100 * one.failure(10.0).value:.2f} %" for one in (live, memo)),
            *(_false(one) for one in (live, memo)),
            f"{live.step_ms:.1f}",
        )
        for live, memo in pairs
    ]
    title = f"Guided and without memo, as on a robot: {len(pairs[0][0].sessions)} sessions"
    return [title, "", *table(head, rows), ""]


def _guided_and_not(
    campaign: CampaignResult,
) -> list[tuple[ConfigurationResult, ConfigurationResult]]:
    """Of each policy that was run live, these runs and the memoised ones of the same sessions."""
    pairs = []
    for policy in campaign.policies:
        live, memo = (
            campaign.live.get(Configuration(policy, campaign.few_lanes, campaign.rounds)),
            campaign.get(policy),
        )
        if live is not None and memo is not None:
            names = {one.session for one in live.sessions}
            same = [one for one in memo.sessions if one.session in names]
            pairs.append((live, ConfigurationResult(memo.configuration, same)))
    return pairs


def _missed(result: ConfigurationResult) -> str:
    return f"{result.configuration.policy} {100 * result.not_localised.value:.2f} %"


def _against(campaign: CampaignResult, a: ConfigurationResult, b: ConfigurationResult) -> str:
    return against(campaign.resamples, a.not_localised, b.not_localised)


def _false(result: ConfigurationResult) -> str:
    count, share = result.false_successes, result.false_share
    return "–" if count is None or share is None else f"{count} ({100 * share:.3f} %)"


def _error(result: ConfigurationResult) -> str:
    errors = result.errors
    if not len(errors.offset_m):
        return "–"
    degrees = float(np.rad2deg(np.median(errors.turn_rad)))
    return f"{100 * float(np.median(errors.offset_m)):.1f} cm, {degrees:.2f}°"
