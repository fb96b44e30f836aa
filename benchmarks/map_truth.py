"""Maps a campaign drive after drive, as a user would, and holds the map against the truth.

    engram simulate village
    python benchmarks/map_truth.py village --out village.engram        # two minutes a dozen drives
    python benchmarks/map_truth.py village --out few.engram --sessions 0,5,9

Tells of each drive what was localised and saved; then, of each kind of edge, how many are wrong by
more than a metre, and how many join two places: more than 5 m off, and more than three of their own
standard deviations. Such an edge spoils a map for good; where odometry had lost track in the rain,
edges are far off and say so.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import numpy as np

from engram.cli.simulation import campaigns_folder
from engram.drive import MapOptions, OpenMap, Settings, campaign_folder, map_drive, open_drive
from engram.evaluation.drives import EvaluatedDrive, drives_of
from engram.evaluation.starting import TrueNodes
from engram.experience.model import EdgeKind
from engram.localiser import Position
from engram.simulation import Size, campaign_named
from engram.store import MapStore

WRONG_M, OTHER_PLACE_M = 1.0, 5.0


def map_all(drives: list[EvaluatedDrive], path: Path) -> None:
    """Adds each drive to the map."""
    for drive in drives:
        report = map_drive(path, open_drive(drive.path), Settings(), MapOptions())
        print(f"{drive.name:45} {report.text().splitlines()[0]}", flush=True)


def judge(drives: list[EvaluatedDrive], path: Path) -> int:
    """Prints the wrong edges by kind; returns how many join two places."""
    truths = {drive.session.id: drive.truth() for drive in drives}
    errors: dict[EdgeKind, list[float]] = {}
    joined: Counter[EdgeKind] = Counter()
    with OpenMap(MapStore.open(path)) as opened:
        true = TrueNodes(opened, truths)
        for edge in opened.graph.edges:
            a, b = true.pose(edge.a), true.pose(edge.b)
            if a is None or b is None:
                continue
            error = (edge.a_from_b.inverse() @ (a.inverse() @ b)).distance_m
            errors.setdefault(edge.kind, []).append(error)
            sigma_m = Position(edge.a, edge.a_from_b, edge.covariance).sigma_m
            joined[edge.kind] += error > max(OTHER_PLACE_M, 3 * sigma_m)
    for kind, found in sorted(errors.items()):
        wrong = np.array(found) > WRONG_M
        print(
            f"{kind:10} {len(found):6} edges, {int(wrong.sum()):3} wrong by > {WRONG_M:.0f} m, "
            f"{joined[kind]} join two places, worst {max(found):.1f} m"
        )
    return joined.total() - joined[EdgeKind.ODOMETRY]


def main() -> None:
    """Reads the command line; exits with 1 if an edge joins two places."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("campaign")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, help="the map; must not exist yet")
    parser.add_argument("--campaigns", type=Path, default=campaigns_folder())
    parser.add_argument("--sessions", help="numbers, joined by commas; all without")
    asked = parser.parse_args()
    campaign = campaign_named(asked.campaign, asked.seed, Size.STANDARD)
    chosen = range(len(campaign.sessions))
    if asked.sessions:
        chosen = [int(one) for one in asked.sessions.split(",")]
    folder = campaign_folder(asked.campaigns, campaign)
    logs = [folder / f"{campaign.session(number).name}.framelog" for number in chosen]
    if missing := [log for log in logs if not log.exists()]:
        raise SystemExit(f"{missing[0]}: not rendered; run: engram simulate {campaign.home}")
    if asked.out.exists():
        raise SystemExit(f"{asked.out}: is there already; name another file")
    drives = list(drives_of(logs))
    map_all(drives, asked.out)
    raise SystemExit(judge(drives, asked.out) > 0)


if __name__ == "__main__":
    main()
