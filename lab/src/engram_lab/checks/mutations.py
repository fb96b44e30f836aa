"""What damaged and hostile maps, drives and hand-ins do to their readers.

    python -m engram_lab.checks.mutations --cases 20000 --out mutations.jsonl
    python -m engram_lab.checks.mutations --case 1234        # one of them again, with all details

Each case is a change of a sound file, drawn by its number, and read in a child in every way that
users read it. Crashes, hangs (10 s; of texts 2 s), more than 1 GB (of texts 200 MB), exceptions
that are not Engram's own, code of the file that ran, and changes that no check sees are faults.
Results go to a file as they come; the same command continues where it stopped.
"""

from __future__ import annotations

import gc
import json
import os
import random
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import cv2

from engram_lab.mutations import case as cases
from engram_lab.mutations import files, handins
from engram_lab.mutations.case import Case, Change, Samples, Subject, make_samples
from engram_lab.mutations.forks import OF_TEXTS, Held, Outcome, Tell, Trial, held, read, tried
from engram_lab.programs import Figure, command_line, report

TEXTS: dict[str, Change] = {
    "text of a calibration": cases.of_a_calibration,
    "text of settings": cases.of_settings,
    "name of a zone": cases.of_a_zone,
}
CHANGES: dict[str, Change] = {
    "bytes of a map": files.bytes_of_a_map,
    "bytes of a map with a log": files.bytes_of_a_map_with_a_log,
    "bytes of a log": files.bytes_of_a_log,
    "rows of a map": files.rows_of_a_map,
    "sealed rows of a map": files.sealed_rows_of_a_map,
    "blobs of a map": files.blobs_of_a_map,
    "many rows of a map": files.many_rows,
    "schema": files.schema_of_a_file,
    "bytes of a drive": files.bytes_of_a_drive,
    "rows of a drive": files.rows_of_a_drive,
    "pages of a hand-in": handins.pages,
    "rows of a hand-in": handins.rows,
    "manifests": handins.manifests,
    **TEXTS,
}
# Share of the cases that are merged, which takes longer than all else.
_MERGED = 0.25
FAULTS = frozenset(Outcome) - {Outcome.READ, Outcome.REFUSED}


class Harness:
    """Sound files, and what they hold."""

    def __init__(self, folder: Path, changes: Mapping[str, Change] = CHANGES) -> None:
        self._folder = folder
        self._changes = changes
        self._samples: Samples = make_samples(folder)
        self._held: dict[str, Held] = {
            path.name: held(path)
            for path in (
                self._samples.town,
                self._samples.logged,
                self._samples.framelog,
                self._samples.flight,
            )
        }

        self._warm_up()
        gc.collect()
        gc.freeze()  # children neither walk nor copy what the parent made

    def trial(self, number: int, seed: int) -> tuple[str, Trial]:
        """One case: the kind of the change, and its result."""
        kind = list(self._changes)[number % len(self._changes)]
        with tempfile.TemporaryDirectory(dir=self._folder) as folder:
            chance = random.Random(f"{seed} {number}")
            work = partial(self._read, self._changes[kind], Path(folder), chance)
            return kind, tried(work, Path(folder), OF_TEXTS if kind in TEXTS else None)

    def _warm_up(self) -> None:
        """Reads every sound file once, so that children find modules and statements loaded."""
        kept = self._samples
        sound = (
            Case(Subject.MAP, "", path=kept.town),
            Case(Subject.DRIVE, "", path=kept.framelog),
            Case(Subject.DRIVE, "", path=kept.flight),
            Case(Subject.HANDIN, "", manifest=kept.manifest, parts=kept.parts),
        )
        for case in sound:
            with tempfile.TemporaryDirectory(dir=self._folder) as folder:
                copy = case.path and Path(shutil.copy(case.path, folder))
                if not read(replace(case, path=copy), Path(folder), merges=True):
                    raise AssertionError(f"a sound {case.subject} does not pass its check")

        for case in cases.sound(self._folder):
            if not read(case, self._folder, merges=False):
                raise AssertionError(f"the sound {case.what} is refused")

    def _read(
        self, change: Change, folder: Path, chance: random.Random, tell: Tell
    ) -> tuple[Outcome, str]:
        case = change(self._samples, folder, chance)
        tell(case.what)
        before = None if case.path is None else held(case.path)
        passed = read(case, folder, merges=chance.random() < _MERGED)
        if passed and before is not None and not case.sealed:
            lost = self._unseen(case, before)
            if lost:
                return Outcome.UNSEEN, lost
        return Outcome.READ if passed else Outcome.REFUSED, ""

    def _unseen(self, case: Case, now: Held) -> str:
        """The tables that hold something else than before, though the check passed."""
        assert case.path is not None
        sound = self._held[case.path.name]
        return ", ".join(name for name in sound if now.get(name) != sound[name])


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--case", type=int, help="only this one, with its details")
    parser.add_argument("--texts", action="store_true", help="only calibrations, settings, zones")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="one JSON line for each case, resumable")
    asked = parser.parse_args()
    cv2.setNumThreads(0)  # a child of a fork has no other threads
    known = _known(asked.out)
    numbers = [asked.case] if asked.case is not None else range(len(known), asked.cases)
    with tempfile.TemporaryDirectory() as folder:
        harness = Harness(Path(folder), TEXTS if asked.texts else CHANGES)
        for number in numbers:
            kind, trial = harness.trial(number, asked.seed)
            record = {"number": number, "kind": kind, **asdict(trial)}
            known.append(record)
            if asked.out is not None:
                with asked.out.open("a") as out:
                    out.write(json.dumps(record) + "\n")
            if trial.outcome in FAULTS or asked.case is not None:
                print(json.dumps(record, indent=1), flush=True)
    counted = Counter(one["outcome"] for one in known)
    report([Figure(str(one), counted[one]) for one in Outcome], asked.json, "mutations")
    sys.exit(any(counted[one] for one in FAULTS))


def _known(out: Path | None) -> list[dict[str, object]]:
    if out is None or not out.exists():
        return []
    return [json.loads(line) for line in out.read_text().splitlines()]


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
