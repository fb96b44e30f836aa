"""Where ranking pays: the table by experiences, attempts and time, from kept rows."""

from __future__ import annotations

import csv
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lab.tests.evaluation.campaigns import few_options, write_campaign

from engram.errors import ConfigError
from engram.localiser.settings import LocaliserConfig
from engram.maps.map import open_map
from engram.robot.settings import Settings
from engram_lab.studies.budgets import (
    BudgetOptions,
    cell_rows,
    holm,
    in_a_sentence,
    in_short,
    saving_everything,
    sign_flip_p,
    time_rows,
    write_budgets,
)
from engram_lab.studies.configurations import UNLIMITED
from engram_lab.studies.running import make_plan, run


def made_up(far_m: dict[tuple[str, str, str], list[float]]) -> list[dict]:
    """Rows by experiences, attempts and policy: metres beyond 10 m, of 100 m a drive."""
    return [
        {
            "campaign": "made-up",
            "drive": f"drive {number}",
            "experiences": 9 if size == "all" else int(size),
            "all": "yes" if size == "all" else "",
            "policy": policy,
            "attempts": attempts,
            "driven_m": 100.0,
            "far_m": metres,
            "attempts_per_frame": float(attempts),
            "rank_ms": 0.1 if policy == "distance" else 0.3,
            "attempt_ms": 0.2,
        }
        for (size, attempts, policy), several in far_m.items()
        for number, metres in enumerate(several)
    ]


WORSE, BETTER = [20.0] * 12, [4.0] * 12
ROWS = made_up(
    {
        ("2", "1", "distance"): [5.0] * 12,
        ("2", "1", "recall"): [5.0] * 6 + [6.0] * 3 + [4.0] * 3,
        ("20", "1", "distance"): WORSE,
        ("20", "1", "recall"): BETTER,
        ("20", "4", "distance"): BETTER,
        ("20", "4", "recall"): [4.5] * 12,
        ("all", "1", "distance"): WORSE,
        ("all", "1", "recall"): [1.0] * 12,
    }
)


def test_cells_compare_with_distance_on_the_same_drives() -> None:
    cells = {(one["experiences"], one["attempts"], one["policy"]): one for one in cell_rows(ROWS)}
    assert cells["20", "1", "distance"]["p_gt_10m"] == pytest.approx(0.2)
    assert "p" not in cells["20", "1", "distance"]
    ours = cells["20", "1", "recall"]
    assert ours["minus_distance"] == pytest.approx(-0.16)
    assert ours["ratio"] == pytest.approx(5.0)
    assert ours["p"] == pytest.approx(2 / 2**12)
    assert ours["p_holm"] == pytest.approx(4 * ours["p"])  # the least of four
    assert ours["against_distance"] == "better"
    assert cells["20", "4", "recall"]["against_distance"] == "worse"
    assert cells["2", "1", "recall"]["against_distance"] == "no difference shown"


def test_the_sentence_says_from_where_on_and_how_often_it_costs() -> None:
    assert in_a_sentence(cell_rows(ROWS)) == (
        "`recall` is better than `distance` in 2 of 4 cells, from 20 experiences on with 1 attempt "
        "a frame; the greatest ratio is 20.0, with all of them and 1 attempt. It is worse in 1."
    )
    alike = made_up({("2", "1", "distance"): [5.0] * 3, ("2", "1", "recall"): [5.0] * 3})
    assert "in none of 1 cells. It is worse in 0." in in_a_sentence(cell_rows(alike))


def test_at_equal_time_each_policy_has_the_most_attempts_that_fit() -> None:
    found = {(one["experiences"], one["policy"], one["ms"]): one for one in time_rows(ROWS)}
    assert ("20", "distance", 0.25) not in found  # ranking and one attempt are 0.3 ms
    assert found["20", "distance", 0.5]["attempts"] == "1"
    assert found["20", "distance", 1.0]["attempts"] == "4"
    assert found["20", "recall", 1.0]["attempts"] == "1"  # ranking and four are 1.1 ms
    assert found["20", "recall", 2.0]["cost_ms"] == pytest.approx(1.1)
    unknown = [{**row, "attempt_ms": None} for row in ROWS]
    assert time_rows(unknown) == []


@given(st.lists(st.sampled_from([-3.0, -1.0, 0.0, 0.5, 2.0]), max_size=8))
def test_the_exact_test_counts_all_signs(gaps: list[float]) -> None:
    sums = [abs(np.dot(signs, gaps)) for signs in product((-1, 1), repeat=len(gaps))]
    wanted = np.mean(np.array(sums) >= abs(sum(gaps)) - 1e-9) if gaps else 1.0
    assert sign_flip_p(np.array(gaps)) == pytest.approx(wanted)


def test_many_drives_are_drawn_and_give_nearly_the_same() -> None:
    gaps = np.random.default_rng(0).normal(0.5, 1.0, 14)
    drawn = sign_flip_p(np.concatenate([gaps, [1e-12]]))
    assert drawn == pytest.approx(sign_flip_p(gaps), abs=0.01)


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_holm_corrects_in_order_and_never_less_than_the_p_itself(p: list[float]) -> None:
    corrected = holm(p)
    assert all(p[k] <= corrected[k] <= 1.0 for k in range(len(p)))
    order = np.argsort(p, kind="stable")
    assert all(np.diff(np.array(corrected)[order]) >= 0)
    assert min(corrected) == pytest.approx(min(1.0, len(p) * min(p)))


def test_holms_own_example() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])


def test_sizes_beyond_the_drives_count_as_all() -> None:
    options = BudgetOptions(policies=("distance", "recall"), lanes=(1, 4), rounds=(1,))
    wanted = options.wanted(8, LocaliserConfig())
    assert {one.sessions for one in wanted} == {None, 2, 5}
    assert len(wanted) == 3 * (1 + 2 * 2)
    assert sum(one.lanes == UNLIMITED for one in wanted) == 3
    with pytest.raises(ConfigError, match="distance must be one of them"):
        BudgetOptions(policies=("recall",))
    with pytest.raises(ConfigError, match="sizes are"):
        BudgetOptions(sizes=(0,))


def test_a_small_campaign_runs_to_its_tables(tmp_path: Path) -> None:
    campaign = write_campaign(tmp_path / "logs", looks=(0, 0, 0, 0))
    options = BudgetOptions(
        policies=("distance", "recall"),
        lanes=(1, 2),
        rounds=(1,),
        folds=2,
        live_folds=0,
        build=few_options().build,
        sizes=(1, 40),
    )
    plan = make_plan(campaign, saving_everything(Settings()), options, tmp_path / "work")
    run(plan)
    with open_map(plan.map_path(plan.folds[0])) as opened:
        by_drive = np.bincount(
            [opened.graph.session_number(one.session) for one in opened.graph.nodes]
        )
    # The same road in the same light: the second drive saves as much as the first.
    assert by_drive.min() > 0.7 * by_drive.max()
    files = write_budgets(tmp_path / "out", [plan])
    with (tmp_path / "out/sessions.csv").open() as file:
        rows = list(csv.DictReader(file))
    # Four held-out drives, two sizes, two policies with two budgets and everything.
    assert len(rows) == 4 * 2 * (2 * 2 + 1)
    assert {one["experiences"] for one in rows} == {"1", "2"}
    assert all(float(one["rank_ms"]) > 0 for one in rows)
    assert float(rows[0]["attempt_ms"]) > 0
    text = (tmp_path / "out/report.md").read_text()
    assert text.startswith("# Where ranking pays\n\n`recall` is ")
    shown = list(in_short(tmp_path / "out/cells.csv"))
    assert shown[0] == text.splitlines()[2]
    lines = [line for line in shown if line.startswith("|")]
    assert lines[0] == "| experiences | policy | 1 | 2 |"
    assert [line[:7].split("|")[1].strip() for line in lines[2:]] == ["1"] * 2 + ["all"] * 2
    assert {path.name for path in files} >= {"cells.csv", "times.csv", "sessions.csv"}
    run(plan)  # nothing is left to run
    assert write_budgets(tmp_path / "again", [plan])
    assert (tmp_path / "again/cells.csv").read_bytes() == (tmp_path / "out/cells.csv").read_bytes()


def test_nothing_run_is_reported_as_such(tmp_path: Path) -> None:
    campaign = write_campaign(tmp_path / "logs", looks=(0, 0))
    options = BudgetOptions(rounds=(1,), folds=2, live_folds=0)
    plan = make_plan(campaign, Settings(), options, tmp_path / "work")
    with pytest.raises(ConfigError, match="nothing was run of this study yet"):
        write_budgets(tmp_path / "out", [plan])
