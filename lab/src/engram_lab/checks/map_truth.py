"""Maps a campaign drive after drive, as a user would, and holds the map against the truth.

    engram lab simulate village
    python -m engram_lab.checks.map_truth village --out village.engram
    python -m engram_lab.checks.map_truth village --out few.engram --sessions 0,5,9
    python -m engram_lab.checks.map_truth begbroke24h --out merged4-3.engram --judge
    python -m engram_lab.checks.map_truth trial --seed 303 --out town.engram      # a small town

Reports of each drive what was localised and saved; then, of each kind of edge, how many are off by
more than a metre, and how many join two places: more than 5 m off, and more than three of their own
standard deviations. Such an edge ruins a map; where odometry had lost track in the rain, edges
are far off and say so. Last, of a robot that stands at each of 150 nodes drawn at random and
knows where it is: how many candidates it has, how many of them are elsewhere, and which share of
the nodes that truly are near is among them.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from engram.geometry.se3 import SE3
from engram.graph.basin import DEFAULT_RADIUS_M
from engram.graph.model import EdgeKind
from engram.graph.neighbourhood import Search
from engram.maps.map import Map
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive
from engram_lab.programs import command_line, numbers
from engram_lab.studies.building import EdgeError, edge_errors
from engram_lab.studies.drives import EvaluatedDrive, TrueNodes, drives_of
from engram_lab.town.campaigns import Size, campaign_named
from engram_lab.town.simulating import campaign_folder, campaigns_folder
from engram_lab.trial_towns import trial_town

WRONG_M = 1.0
STANDS, VIEW_GATE_RAD, CERTAIN = 150, float(np.deg2rad(60.0)), np.eye(6) * 0.1**2


def map_all(drives: list[EvaluatedDrive], path: Path) -> None:
    """Adds each drive to the map."""
    for drive in drives:
        report = map_drive(path, open_drive(drive.path), Settings(), RobotOptions())
        found = sum(one.localised for one in report.results)
        frames = f"{found} of {len(report.results)} frames localised"
        print(f"{drive.name:45} {report.saved} nodes saved, {frames}", flush=True)


def judge(drives: list[EvaluatedDrive], path: Path) -> int:
    """Prints the wrong edges by kind; returns how many join two places."""
    truths = {drive.session.id: drive.truth() for drive in drives}
    by_kind: dict[EdgeKind, list[EdgeError]] = {}
    with Map.open(path) as opened:
        true = TrueNodes(opened, truths)
        for one in edge_errors(opened.graph.edges, true.pose):
            by_kind.setdefault(one.kind, []).append(one)
        neighbours = what_is_near(opened, true)
    joined: Counter[EdgeKind] = Counter()
    for kind, found in sorted(by_kind.items()):
        errors_m = np.array([one.error_m for one in found])
        joined[kind] = sum(one.joins_places for one in found)
        print(
            f"{kind:10} {len(found):6} edges, {int((errors_m > WRONG_M).sum()):3} wrong by > "
            f"{WRONG_M:.0f} m, {joined[kind]} join two places, worst {errors_m.max():.1f} m"
        )
    print(neighbours)
    return joined.total() - joined[EdgeKind.ODOMETRY]


def what_is_near(opened: Map, true: TrueNodes) -> str:
    """One line about the candidates of a robot that stands at nodes of the map."""
    graph = opened.graph
    stands = np.random.default_rng(0).permutation(len(graph))[:STANDS]
    candidates = elsewhere = near = seen = 0
    for node in stands.tolist():
        pose = true.pose(graph.node(node).id)
        if pose is None:
            continue
        found = graph.neighbourhood(
            node, SE3.identity(), CERTAIN, Search(DEFAULT_RADIUS_M, VIEW_GATE_RAD)
        )
        ids = {graph.node(row).id for row in found.nodes.tolist()}
        truly = true.near(pose, DEFAULT_RADIUS_M)
        candidates, elsewhere = candidates + len(ids), elsewhere + len(ids - truly)
        near, seen = near + len(truly), seen + len(ids & truly)
    count = max(len(stands), 1)
    return (
        f"{candidates / count:.1f} candidates within {DEFAULT_RADIUS_M:.0f} m of a robot, "
        f"{elsewhere / count:.1f} of them elsewhere; {seen / max(near, 1):.1%} of what is near"
    )


def main() -> None:
    """Reads the command line; exits with 1 if an edge joins two places."""
    parser = command_line(__doc__)
    parser.add_argument("campaign")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, help="the map; must not exist yet")
    parser.add_argument("--judge", action="store_true", help="judge a map that is there already")
    parser.add_argument("--campaigns", type=Path, default=campaigns_folder())
    parser.add_argument("--sessions", type=numbers, help="numbers, joined by commas; all without")
    asked = parser.parse_args()
    campaign = (
        trial_town(asked.seed)
        if asked.campaign == "trial"
        else campaign_named(asked.campaign, asked.seed, Size.STANDARD)
    )
    chosen = asked.sessions or range(len(campaign.sessions))
    folder = campaign_folder(asked.campaigns, campaign)
    logs = [folder / f"{campaign.session(number).name}.framelog" for number in chosen]
    if missing := [log for log in logs if not log.exists()]:
        raise SystemExit(f"{missing[0]}: not rendered; run: engram lab simulate {campaign.home}")
    if asked.out.exists() is not asked.judge:
        there = "is there already; name another file, or judge it with --judge"
        raise SystemExit(f"{asked.out}: {'is not there' if asked.judge else there}")
    drives = list(drives_of(logs))
    if not asked.judge:
        map_all(drives, asked.out)
    raise SystemExit(judge(drives, asked.out) > 0)


if __name__ == "__main__":
    main()
