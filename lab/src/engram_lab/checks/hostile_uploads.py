"""What hostile and broken robots upload, against a centre: no server error, no harm to its map.

    python -m engram_lab.checks.hostile_uploads --uploads 1000

Changed hand-ins (pages, rows under right checksums, manifests), bodies that are not what their
names say, the parts of another robot, names that are paths, and bombs. Admission runs in its own
process with its limits, as in service. Prints the answers by status, and the ends of the hand-ins.
"""

from __future__ import annotations

import random
import sys
import tempfile
from pathlib import Path

from engram_lab.programs import Figure, command_line, report


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--uploads", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    # Here, as each process of admission loads this module itself.
    from engram_lab.mutations.case import make_samples
    from engram_lab.mutations.handins import Site

    with tempfile.TemporaryDirectory() as folder:
        samples = make_samples(Path(folder))
        site = Site(Path(folder), samples)
        for number in range(asked.uploads):
            site.upload(random.Random(f"{asked.seed} {number}"))
        faults = site.faults()
        answers, states = site.answers, site.states()
    figures = [Figure(f"answers {code}", answers[code]) for code in sorted(answers)]
    figures += [Figure(f"hand-ins {state}", states[state]) for state in sorted(states)]
    figures.append(Figure("faults of the map, and files left behind", len(faults)))
    report(figures, asked.json, f"{asked.uploads} hostile uploads")
    for fault in faults:
        print(fault)
    sys.exit(any(code >= 500 for code in answers) or bool(faults))


if __name__ == "__main__":
    main()
