"""What the two terms of Γ(path) are worth: the prior alone, the likelihood alone, both.

    engram lab evaluate ranking begbroke --no-map-sizes --work study --out results/ranking
    python -m engram_lab.fits.path_terms begbroke --work study

Localises all held-out sessions of a study that is done, in its maps and with its matches, at Np = 2
and Nr = 1: with T = 0, which leaves the prior alone; with T = 10 and a uniform prior; and with
T = 10 and both, as `path-near` is. Prints the route not localised, and differences from the last,
with 90 % intervals over sessions.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.frontend.matching import matcher_hash
from engram.localiser import FrameMatcher
from engram.measures import Drive
from engram.ranking import POLICIES, RankingContext
from engram.ranking.path_near import PathNearPolicy
from engram.robot import Settings, open_map
from engram_lab.intervals import Resamples, SessionSums, difference, not_localised_sums
from engram_lab.programs import command_line
from engram_lab.studies.building import read_built_map
from engram_lab.studies.configurations import Configuration
from engram_lab.studies.drives import open_campaign
from engram_lab.studies.held_out import localise_held_out
from engram_lab.studies.memo import MatchMemo
from engram_lab.studies.running import Plan, RankingOptions, make_plan
from engram_lab.town.simulating import campaigns_folder


class LikelihoodAlone(PathNearPolicy):
    """Γ(path-near) of a robot that was nowhere yet: π is uniform."""

    name = "path-near, likelihood alone"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return super().rank(replace(context, reference=None))


POLICIES[LikelihoodAlone.name] = LikelihoodAlone
TERMS = {
    "prior alone (T = 0)": Configuration("path-near", T=0),
    "likelihood alone (T = 10, uniform prior)": Configuration(LikelihoodAlone.name),
    "both (T = 10)": Configuration("path-near"),
}


def held_out_drives(plan: Plan) -> list[list[Drive]]:
    """How every held-out session went with each of `TERMS`."""
    config, found = plan.settings.localiser.matcher, []
    for fold in plan.folds:
        training = [plan.drives.drives[number] for number in fold.training]
        with open_map(read_built_map(plan.map_path(fold)).path) as opened:
            for session in fold.held_out:
                drive = plan.drives.drives[session]
                memo = MatchMemo(
                    FrameMatcher(opened.frames, config),
                    plan.work / f"memo-{drive.key}.matches.npz",
                    matcher_hash(config),
                )
                runs = localise_held_out(
                    opened,
                    drive,
                    drive.frames(),
                    training,
                    list(TERMS.values()),
                    plan.settings,
                    memo,
                    plan.options.relocaliser,
                )
                found.append([Drive(runs.step_m, matched) for matched in runs.matched])
                print(f"\r{len(found)} sessions", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return found


def report(drives: list[list[Drive]]) -> None:
    """Prints a line per term."""
    resamples = Resamples.of(len(drives))
    sums: dict[str, SessionSums] = {
        name: not_localised_sums([one[row] for one in drives]) for row, name in enumerate(TERMS)
    }
    both = sums["both (T = 10)"]
    for name, one in sums.items():
        lost, more = resamples.interval(one), resamples.interval(difference(one, both))
        print(
            f"{name:42} {lost.estimate:6.2%} ({lost.low:.2%} … {lost.high:.2%}), "
            f"{100 * more.estimate:+.2f} ({100 * more.low:+.2f} … {100 * more.high:+.2f}) points"
        )


def main() -> None:
    """See the module's docstring."""
    parser = command_line(__doc__)
    parser.add_argument("campaign", help="one that was rendered and studied")
    parser.add_argument("--work", type=Path, required=True, help="the study's --work")
    asked = parser.parse_args()
    drives = open_campaign(asked.campaign, campaigns_folder())
    plan = make_plan(drives, Settings(), RankingOptions(), asked.work)
    if not all(plan.map_path(fold).exists() for fold in plan.folds):
        raise SystemExit(
            f"{plan.work} does not hold the maps of all {len(plan.folds)} folds; run "
            f"`engram lab evaluate ranking {asked.campaign} --work {asked.work}` first"
        )
    report(held_out_drives(plan))


if __name__ == "__main__":
    main()
