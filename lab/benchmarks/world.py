"""Rows (d) and (f) of the simulated town's calibration; the rest is `engram bench --only world`.

    python benchmarks/world.py --out /tmp/month              # renders, maps, localises; resumable
    python benchmarks/world.py --out /tmp/month --record     # and keeps the result in the package

A loop of 0.15 km, 40 laps of `begbroke24h` (8,600 pairs, 15 to 25 minutes of one core on a quiet
machine), then five folds over the laps with every candidate attempted. Interrupted, the same
command goes on.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from engram_lab.bench.world import RECORD, write_record
from engram_lab.studies.month import month, month_table
from engram_lab.town.calibration import world_hash
from engram_lab.town.simulating import simulate


def main() -> None:
    """Measures, prints, and records on demand."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="where laps and maps are kept")
    parser.add_argument("--seed", type=int, default=1, help="of the town")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--record", action="store_true", help=f"write {RECORD.name}")
    asked = parser.parse_args()
    campaign = month(asked.seed)
    print(simulate(campaign, asked.out, workers=asked.workers).text(), flush=True)
    rows = month_table(asked.out, campaign, asked.workers, lambda word: print(word, flush=True))
    for row in rows:
        print(f"{row.letter}  {row.what:45} {row.value:7.1f} {row.unit:3} {row.verdict}")
    print(f"world {world_hash()}")
    if asked.record:
        write_record(rows, f"town {asked.seed}, {len(campaign.sessions)} laps")


if __name__ == "__main__":
    main()
