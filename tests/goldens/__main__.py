"""Make or check the goldens, or measure time against another checkout; see the package."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

from tests.goldens import results, timing

ISAS = ("generic", "v3", "v4")
# All are compared with one golden: not every pair of the two needs a run.
THREADS = {"generic": [["--no-threads"]], "v3": [[]], "v4": [[], ["--no-threads"]]}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.goldens")
    verbs = parser.add_subparsers(dest="verb", required=True)
    for verb in ("make", "check"):
        one = verbs.add_parser(verb)
        one.add_argument("--only", metavar="GROUP[/CASE]")
        one.add_argument("--isa", choices=ISAS)
        one.add_argument("--no-threads", action="store_true")
        if verb == "check":
            one.add_argument("--all", action="store_true", help="all instruction sets and threads")
    timed = verbs.add_parser("time")
    timed.add_argument("--against", type=Path, required=True, metavar="CHECKOUT")
    timed.add_argument("--blocks", type=int, default=30)
    timed.add_argument("--frames", type=int, default=100, help="of a block")
    worker = verbs.add_parser("worker")
    worker.add_argument("--frames", type=int, required=True)
    given = parser.parse_args()
    if given.verb == "worker":
        return timing.work(given.frames)
    if given.verb == "time":
        return timing.compare(given.against, given.blocks, given.frames)
    if given.verb == "check" and given.all:
        return check_all(given.only)
    if given.isa is not None and os.environ.get("ENGRAM_ISA") != given.isa:
        return run_again(given.isa)
    return run(given.verb, given.only, threads=not given.no_threads)


def run_again(isa: str) -> int:
    """The core chooses its instruction set when it is loaded."""
    command = [sys.executable, "-m", "tests.goldens", *sys.argv[1:]]
    return subprocess.run(command, env={**os.environ, "ENGRAM_ISA": isa}, check=False).returncode


def check_all(only: str | None) -> int:
    wrong = 0
    for isa in ISAS:
        asked = [sys.executable, "-c", "from engram import _core"]
        env = {**os.environ, "ENGRAM_ISA": isa}
        if subprocess.run(asked, env=env, capture_output=True, check=False).returncode:
            print(f"{isa}: skipped, this processor has it not")
            continue
        for threads in THREADS[isa]:
            command = [sys.executable, "-m", "tests.goldens", "check", *threads]
            command += ["--only", only] if only else []
            wrong += subprocess.run(command, env=env, check=False).returncode != 0
    return int(wrong > 0)


def run(verb: str, only: str | None, *, threads: bool) -> int:
    from tests.goldens.cases import GROUPS, DrivesMissingError, computed
    from tests.goldens.checking import differences
    from tests.goldens.through import CODE, ISA

    group_name, _, case = (only or "").partition("/")
    if group_name and group_name not in GROUPS:
        raise SystemExit(f"no group {group_name!r}; there are: {', '.join(GROUPS)}")
    if verb == "make" and case:
        raise SystemExit("a group is made as a whole: name no case")
    print(f"{CODE}, {ISA}, {'with' if threads else 'without'} threads", flush=True)
    wrong = 0
    for name in [group_name] if group_name else GROUPS:
        started = time.perf_counter()
        try:
            with computed(name, threads=threads, only=case or None) as found:
                if verb == "make":
                    cases = {one: made.to_dict() for one, made in found.cases.items()}
                    results.write(name, {"inputs": found.inputs, "cases": cases})
                    lines, note = [], f"{len(cases)} cases written"
                else:
                    lines, note = differences(name, found)
        except DrivesMissingError as error:
            lines, note = [], f"skipped: {error}"
        print(f"  {name}: {note} ({time.perf_counter() - started:.1f} s)", flush=True)
        for line in lines:
            print(f"  {line}", flush=True)
        wrong += len(lines)
    if verb == "make":
        results.write("fingerprint", dict(results.fingerprint()))
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
