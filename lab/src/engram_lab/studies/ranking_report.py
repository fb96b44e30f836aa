"""[L15]'s experiments on our data: tables, comparisons, a page and Figs. 9 to 13."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from engram.errors import InputError
from engram.robot import Settings
from engram_lab.intervals import Resamples, SessionSums, excess_ratio, ratio
from engram_lab.studies.configurations import (
    EVERYTHING,
    UNLIMITED,
    Configuration,
    lanes_text,
)
from engram_lab.studies.in_force import VARIED, exceptions, in_words, unused
from engram_lab.studies.in_force import rows as in_force_rows
from engram_lab.studies.pages import (
    COMPARED,
    Row,
    chosen,
    compared,
    make_folder,
    pivot,
    plain_table,
    rated,
    table,
    write_study,
)
from engram_lab.studies.ranking_figures import draw_figures
from engram_lab.studies.ranking_rows import (
    few_lanes_results,
    labelled,
    policy_rows,
    rows_by_size,
    session_rows,
    summary_rows,
)
from engram_lab.studies.running import Plan
from engram_lab.studies.summary import CampaignResult, ConfigurationResult, collect
from engram_lab.truth import TRUTH_SUFFIX

# Shares as low as this differ by less than anyone would notice: added to both sides of ratios to
# the oracle.
_NEGLIGIBLE = 0.005
_BEST_KNOWN = "recall"
# Tables of the settings that make maps and localise held-out drives.
_USED = {one.name for one in fields(Settings)} | {"drive"}
# So many map sizes are shown, evenly over those that there are.
_SHOWN_SIZES = 8
_NO_TRUTH = (
    "Not every drive has its truth: no pose errors, no false successes. The truth of NAME.framelog "
    f"is NAME{TRUTH_SUFFIX} next to it, in TUM format."
)
_POLICY_COLUMNS = {
    "label": "policy",
    "p_gt_10m": "P(> 10 m)",
    "p_gt_5m": "P(> 5 m)",
    "share_not_localised": "route not localised",
    "excess_not_localised": "excess over the oracle",
    "longest_gap_m": "longest gap, m",
    "attempts_per_frame": "attempts per frame",
    "ms_as_on_a_robot": "ms per frame",
    "false_successes": "false successes",
    "median_error_m": "median error, m",
    "median_error_deg": "°",
    "beats_distance": "beats distance",
}
# What a terminal shows of them.
_FEW_COLUMNS = ("label", "share_not_localised", "p_gt_10m", "beats_distance")


@dataclass(frozen=True, slots=True)
class Report:
    """What was written of a study.

    Attributes:
        files: the files.
        text: the main result, for a terminal.
    """

    files: list[Path]
    text: str


def write_report(out: Path, plans: Sequence[Plan]) -> Report:
    """Everything that an evaluation of ranking policies leaves in its folder.

    Args:
        out: the folder; made if need be, files in it are replaced.
        plans: one per campaign.

    Raises:
        InputError: nothing was run of a campaign, or the folder cannot be written.
        StorageFullError: no space is left.
        MissingExtraError: Matplotlib is not installed; the tables are written by then.
    """
    campaigns = [_with_results(plan) for plan in plans]
    make_folder(out)
    rows = [row for one in campaigns for row in summary_rows(one)]
    comparisons = [row for one in campaigns for row in comparison_rows(one)] + pooled_rows(
        campaigns
    )
    tables = {
        "in_force": [row for one in campaigns for row in _in_force_rows(one)],
        "summary": rows,
        "sessions": [row for one in campaigns for row in session_rows(one)],
        "comparisons": comparisons,
    }
    files = write_study(
        out,
        tables,
        _page(campaigns, rows, comparisons),
        [plan.configuration() for plan in plans],
        lambda folder: draw_figures(folder, campaigns, rows),
    )
    return Report(files, "\n".join(line for one in campaigns for line in _in_short(one, rows)))


def _in_short(campaign: CampaignResult, rows: Sequence[Row]) -> Iterator[str]:
    few = {name: _POLICY_COLUMNS[name] for name in _FEW_COLUMNS}
    yield from (f"{campaign.name}: {_protocol(campaign)}", "")
    yield from plain_table(policy_rows(campaign, labelled(campaign, rows)), few)
    yield ""


def _with_results(plan: Plan) -> CampaignResult:
    found = collect(plan)
    if not found.memo and not found.live:
        raise InputError(
            f"of {plan.drives.name} nothing was run with these options in {plan.work}; give "
            "--work, --folds, --seed and the settings as when it was run, or leave out "
            "--report-only"
        )
    return found


# -- what the paper claims


def comparison_rows(campaign: CampaignResult) -> list[Row]:
    """Pairs of configurations on the same sessions: shares, differences and ratios."""
    return [{"campaign": campaign.name, **row} for row in _comparisons(campaign)]


def _comparisons(campaign: CampaignResult) -> Iterator[Row]:
    resamples, few = campaign.resamples, campaign.few_lanes

    def pair(
        what: str, a: ConfigurationResult | None, b: ConfigurationResult | None, paper: str = ""
    ) -> Iterator[Row]:
        if a is not None and b is not None and a is not b:
            yield compared(what, a.not_localised, b.not_localised, resamples, paper)

    nearest, bound, near = (campaign.get(name) for name in ("distance", "oracle", "path-near"))
    if nearest is not None and bound is not None:
        for result in few_lanes_results(campaign):
            if result.configuration.policy in {"path", "path-near"}:
                label = result.configuration.label
                sums = nearest.not_localised, result.not_localised
                excess = excess_ratio(*sums, bound.not_localised)
                what = f"`distance` ÷ `{label}`, Np = {few}"
                paper = "5×" if label == "path" else ""
                yield rated(f"{what}: excess over the oracle", excess, resamples, paper)
                yield rated(f"{what}: route not localised", ratio(*sums), resamples)
                far = ratio(nearest.failure(10.0), result.failure(10.0))
                yield rated(f"{what}: P(> 10 m)", far, resamples)
    for policy in ("path", "path-near"):
        name = f"`{policy}`"
        yield from pair(
            f"{name} at Np = 2 against `distance` at Np = 4",
            campaign.get(policy, 2), campaign.get("distance", 4), "equal",
        )  # fmt: skip
        yield from pair(
            f"{name} against `distance`, Np unlimited",
            campaign.get(policy, UNLIMITED), campaign.get("distance", UNLIMITED), "equal",
        )  # fmt: skip
    yield from pair(
        f"`path-near` with T = 0 against T = {campaign.T}",
        campaign.get("path-near", T=0), near, "worse",
    )  # fmt: skip
    ours = campaign.get(_BEST_KNOWN)
    for other in ("path", "path-near", "distance", "bandit"):
        yield from pair(f"`{_BEST_KNOWN}` against `{other}`", ours, campaign.get(other))
    if ours is not None and bound is not None:
        to_bound = ratio(ours.not_localised, bound.not_localised, _NEGLIGIBLE)
        what = f"`{_BEST_KNOWN}` ÷ `oracle`: route not localised, 0.5 % added to both"
        yield rated(what, to_bound, resamples)
    for policy, paper in (("distance", "rises"), ("path-near", "falls 4×"), (_BEST_KNOWN, "")):
        whole, first = campaign.get(policy), campaign.get(policy, sessions=1)
        if whole is not None and first is not None:
            fall = ratio(first.failure(10.0), whole.failure(10.0))
            what = f"`{policy}`: P(> 10 m) in the smallest map ÷ in the largest (Fig. 9)"
            yield rated(what, fall, resamples, paper)
    everything = campaign.memo.get(EVERYTHING)
    near_by = 0 if everything is None else sum(one.near for one in everything.sessions)
    if everything is not None and near_by:
        seen = sum(one.near_seen for one in everything.sessions)
        what = "nodes truly within 8 m and 60° of a localised robot that are candidates"
        yield {"what": what, "share_a": seen / near_by}
    yield from _as_on_a_robot(campaign)


def _as_on_a_robot(campaign: CampaignResult) -> Iterator[Row]:
    """Guided and unmemoised runs against the memoised, unguided ones of the same sessions."""
    for policy in campaign.policies:
        live = campaign.live.get(Configuration(policy, campaign.few_lanes, campaign.rounds))
        memo = campaign.get(policy)
        if live is not None and memo is not None:
            names = {one.session for one in live.sessions}
            same = [one for one in memo.sessions if one.session in names]
            beside = ConfigurationResult(memo.configuration, same)
            what = f"`{policy}` as on a robot against unguided, {len(same)} sessions"
            resamples = Resamples.of(len(same), seed=campaign.seed)
            yield compared(what, live.not_localised, beside.not_localised, resamples)


def pooled_rows(campaigns: Sequence[CampaignResult]) -> list[Row]:
    """All sessions of several campaigns together: whom our policy beats."""
    rows, ours = [], [one.get(_BEST_KNOWN) for one in campaigns]
    for other in ("path-near", "distance", "bandit"):
        pairs = [
            (a.not_localised, b.not_localised)
            for a, b in zip(ours, (one.get(other) for one in campaigns), strict=True)
            if a is not None and b is not None
        ]
        if len(campaigns) > 1 and len(pairs) == len(campaigns):
            a, b = (_together([pair[side] for pair in pairs]) for side in (0, 1))
            resamples = Resamples.of(len(a.numerator), seed=campaigns[0].seed)
            row = compared(f"`{_BEST_KNOWN}` against `{other}`", a, b, resamples)
            rows.append({"campaign": "pooled", **row})
    return rows


def _together(sums: Sequence[SessionSums]) -> SessionSums:
    return SessionSums(
        np.concatenate([one.numerator for one in sums]),
        np.concatenate([one.denominator for one in sums]),
    )


# -- the page


def _page(
    campaigns: Sequence[CampaignResult], rows: Sequence[Row], comparisons: Sequence[Row]
) -> Iterator[str]:
    for campaign in campaigns:
        own, beside = labelled(campaign, rows), in_words(campaign.in_force())
        yield from (f"## {campaign.name}", "", *_left_out(campaign), _protocol(campaign), "")
        yield from _exceptions(campaign)
        yield from table(policy_rows(campaign, own), _POLICY_COLUMNS, beside)
        yield from table(chosen(comparisons, campaign=campaign.name), COMPARED, beside)
        for column, title in (
            ("share_not_localised", "Route not localised"),
            ("p_gt_10m", "P(> 10 m)"),
        ):
            swept = [
                {**row, "label": f"{row['label']}, Nr = {row['rounds']}", column: row[column]}
                for row in chosen(own, map_sessions=None, T=campaign.T, radius="search")
            ]
            plain = [
                {k: v for k, v in row.items() if not k.endswith(("_low", "_high"))} for row in swept
            ]
            yield from (f"{title} by the number of lanes", "")
            yield from table(pivot(plain, "label", "lanes", column), beside=beside)
        yield from _sizes(campaign, own, beside)
        if not campaign.with_truth:
            yield from (_NO_TRUTH, "")
    if pooled := chosen(comparisons, campaign="pooled"):
        beside = "\n".join(dict.fromkeys(in_words(one.in_force()) for one in campaigns))
        yield from ("## All sessions pooled", "", *table(pooled, COMPARED, beside))


def _in_force_rows(campaign: CampaignResult) -> Iterator[Row]:
    """What the maps were made by, and what held-out drives were localised by."""
    runs = {
        "maps": campaign.maps_in_force,
        "held out": campaign.in_force(),
        "held out, as on a robot": campaign.in_force("live"),
    }
    for name, known in runs.items():
        yield from in_force_rows(known, campaign.tables, {"campaign": campaign.name, "of": name})


def _exceptions(campaign: CampaignResult) -> Iterator[str]:
    """What of the settings does not hold."""
    drive, maps = campaign.tables.drive, campaign.maps_in_force
    yield (
        "- Ranking and budget are varied; those of the settings are "
        f"`{drive.ranking}`, Np = {drive.lanes}, Nr = {drive.rounds}."
    )
    if maps:
        policy, lanes, rounds = (maps.get(key) for key in VARIED)
        yield f"- Maps were made with `{policy}`, Np = {lanes}, Nr = {rounds}."
    for line in exceptions(campaign.in_force(), campaign.tables):
        yield f"- Held-out drives, {line}."
    yield from unused(campaign.tables, _USED)
    yield ""


def _protocol(campaign: CampaignResult) -> str:
    count = max((len(one.sessions) for one in campaign.memo.values()), default=0)
    driven = max((one.driven_m.sum() for one in campaign.memo.values()), default=0.0)
    found_again = "no relocalisation" if campaign.relocaliser is None else campaign.relocaliser
    budget = f"Np = {lanes_text(campaign.few_lanes)}, Nr = {campaign.rounds}, T = {campaign.T}"
    return (
        f"{budget}; {count} held-out sessions, {driven / 1e3:.1f} km, unguided, {found_again}; "
        "90 % intervals over sessions"
    )


def _left_out(campaign: CampaignResult) -> list[str]:
    """What was run on some sessions only: tables compare on the same sessions."""
    fewer: dict[str, list[int]] = {}
    for one, sessions in campaign.left_out.items():
        what = f"Np = {one.lanes_text}" if one.sessions is None else "Fig. 9"
        fewer.setdefault(f"{one.label} ({what})", []).append(sessions)
    if not fewer:
        return []
    said = ", ".join(f"{what} on {min(counts)}" for what, counts in fewer.items())
    every = max((len(one.sessions) for one in campaign.memo.values()), default=0)
    return [
        f"Not in these tables, since not run on the same {every} sessions: {said}. The same "
        "command without --only-folds completes them; --only-folds shows the folds that have them.",
        "",
    ]


def _sizes(campaign: CampaignResult, own: Sequence[Row], beside: str) -> Iterator[str]:
    """P(> 10 m) in maps of so many sessions; a share of the sizes that there are."""
    grown = rows_by_size(campaign, own)
    sizes = sorted({row["map_sessions"] for row in grown if row["map_sessions"] is not None})
    if not sizes:
        return
    shown = np.linspace(0, len(sizes) - 1, min(len(sizes), _SHOWN_SIZES)).round().astype(int)
    wanted = {sizes[k] for k in shown} | {None}
    some = [
        {
            "policy": row["policy"],
            "map": f"{row['map_sessions'] or 'all'} ({row['nodes']:.0f})",
            "p_gt_10m": row["p_gt_10m"],
        }
        for row in grown
        if row["map_sessions"] in wanted
    ]
    yield from ("P(> 10 m) as the map grows: sessions in the map (nodes)", "")
    yield from table(pivot(some, "policy", "map", "p_gt_10m"), beside=beside)
