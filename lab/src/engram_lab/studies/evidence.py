"""Every study that a figure in README and docs rests on: one table, and what plans and runs it.

    engram lab evaluate all --plan                     # what is done, stale or missing
    engram lab evaluate all --out results --hours 1    # the same command continues

A study is a row of `STUDIES`: commands that leave tables in a folder of its own. Its manifest
stands next to them: versions, commands, seeds, settings in force, machine and time. Results are
stale where the method, the world or the commands have changed since.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import runpy
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

from engram import __version__
from engram.cli import main
from engram.cli.settings import AllSettings
from engram.config import to_dict
from engram.errors import ConfigError, InputError
from engram.localiser.settings import METHOD_VERSION
from engram.processes import end_with_parent
from engram_lab.studies.building import write_json
from engram_lab.studies.drives import campaign_logs
from engram_lab.studies.in_force import by_key
from engram_lab.studies.plan import alone_in, writing
from engram_lab.town.campaigns import WORLD_VERSION, campaign_named
from engram_lab.town.simulating import campaigns_folder


@dataclass(frozen=True, slots=True)
class Study:
    """One study.

    Attributes:
        commands: command lines in their order. `{out}` stands for the study's folder, `{campaigns}`
            for that of rendered drives, `{data}` for the real images, `{settings}` for the studies'
            settings files; a `*` for what is there. What the nth command prints is kept as `n.txt`.
        minutes: on two cores, rendering included; an estimate.
        tables: names in its folder of what the repository keeps (`engram_lab.studies.pages`).
        pages: documents and reports that state its figures.
        campaigns: what it renders, or finds rendered.
        real: whether it reads the real images that ENGRAM_DATA names.
        town: whether it depends on the simulated world.
        resumes: whether a stopped command continues where it was.
    """

    commands: tuple[str, ...]
    minutes: int
    tables: tuple[str, ...]
    pages: tuple[str, ...]
    campaigns: tuple[str, ...] = ()
    real: bool = False
    town: bool = True
    resumes: bool = False


_CHECKS = "python -m engram_lab.checks."
_EVALUATE = "engram lab evaluate "
_POLICIES = "distance,path,recall,oracle"
_SWEPT = "--lanes 1,2,4,8,0 --rounds 1 --live-folds 0"
_STUDIED = ("summary.csv", "sessions.csv", "in_force.csv", "configuration.json")
_FIRST_40 = ",".join(map(str, range(40)))
_FIRST_25 = ",".join(map(str, range(25)))
# Of the town in which false joins are planted.
_LAPS = ("3", "13", "23", "33")
_TOWN_2 = f"{{campaigns}}/begbroke24h-standard-seed2-v{WORLD_VERSION}"


def _conditions(kind: str) -> tuple[str, ...]:
    """In maps of both lights, of the morning, and of the night."""
    return tuple(
        "python -m engram_lab.studies.conditions --maps {out}/maps --towns 507,508 "
        f"--kind {kind} --mapped {mapped} --csv {{out}}/conditions.csv"
        for mapped in ("0,2", "0", "2")
    )


# In the order in which they are worth their time.
STUDIES: Mapping[str, Study] = {
    "real-images": Study(
        (f"{_CHECKS}accuracy --json {{out}}/figures.json",),
        1,
        ("figures.json",),
        ("README.md", "docs/evidence.md", "lab/reports/performance.md"),
        real=True,
        town=False,
    ),
    "robot-needs": Study(
        (f"{_CHECKS}robot_needs --json {{out}}/figures.json",),
        8,
        ("figures.json",),
        ("README.md", "docs/eyes.md"),
        real=True,
        town=False,
    ),
    "bench": Study(
        ("engram lab bench --json",),
        2,
        ("1.txt",),
        ("docs/evidence.md",),
        town=False,
    ),
    # Towns that no setting and no constant was chosen on.
    "conditions": Study(
        _conditions("brief"),
        25,
        ("conditions.csv",),
        ("docs/evidence.md", "lab/reports/conditions.md"),
    ),
    "conditions-net": Study(
        _conditions("net"), 30, ("conditions.csv",), ("lab/reports/conditions.md",)
    ),
    # The first 25 of eighty drives; the papers' own sizes are in "ranking-whole".
    "ranking": Study(
        (
            f"engram lab simulate begbroke24h --sessions {_FIRST_25}",
            f"{_EVALUATE}ranking begbroke24h --first 25 --policies {_POLICIES} {_SWEPT} "
            "--only-folds 0 --relocaliser truth --out {out}",
        ),
        30,
        _STUDIED,
        ("lab/reports/ranking.md",),
        campaigns=("begbroke24h",),
        resumes=True,
    ),
    "starved": Study(
        (
            f"engram lab simulate begbroke24h --sessions {_FIRST_25}",
            f"{_EVALUATE}ranking begbroke24h --first 25 --policies {_POLICIES} {_SWEPT} "
            "--only-folds 0 --config {settings}/starved.toml --relocaliser truth --out {out}",
        ),
        40,
        (*_STUDIED, "maps.csv"),
        ("lab/reports/ranking.md",),
        campaigns=("begbroke24h",),
        resumes=True,
    ),
    # Six dry drives of a town, and four in rain of 1.5 to 5.5 mm/h.
    "ranking-wet": Study(
        (
            "engram lab simulate wet",
            f"{_EVALUATE}ranking wet --policies {_POLICIES} {_SWEPT} --only-folds 0,2 "
            "--relocaliser truth --out {out}",
        ),
        30,
        _STUDIED,
        ("lab/reports/ranking-elsewhere.md",),
        campaigns=("wet",),
        resumes=True,
    ),
    **{
        f"ranking-{campaign}": Study(
            (
                f"engram lab simulate {campaign}",
                f"{_EVALUATE}ranking {campaign} --policies {_POLICIES} {_SWEPT} "
                "--only-folds 0,4 --relocaliser truth --out {out}",
            ),
            40,
            _STUDIED,
            ("lab/reports/ranking-elsewhere.md",),
            campaigns=(campaign,),
            resumes=True,
        )
        for campaign in ("keble", "oxford")
    },
    "ranking-whole": Study(
        (
            "engram lab simulate begbroke24h",
            f"{_EVALUATE}ranking begbroke24h --policies {_POLICIES} {_SWEPT} "
            "--relocaliser truth --out {out}",
        ),
        240,
        _STUDIED,
        ("lab/reports/ranking.md",),
        campaigns=("begbroke24h",),
        resumes=True,
    ),
    "year": Study(
        (
            "engram lab simulate year",
            "python -m engram_lab.studies.year --out {out}",
        ),
        60,
        ("drives.csv",),
        ("docs/papers.md",),
        campaigns=("year",),
        resumes=True,
    ),
    "month": Study(
        (
            "engram lab simulate month",
            "python -m engram_lab.studies.month --out {out}",
        ),
        90,
        ("drives.csv",),
        ("lab/reports/retention.md",),
        campaigns=("month",),
        resumes=True,
    ),
    "budgets": Study(
        (
            f"engram lab simulate begbroke24h --sessions {_FIRST_25}",
            f"{_EVALUATE}budgets begbroke24h --first 25 --only-folds 0,1 "
            "--policies distance,recall --sizes 2,5,10 --attempts 1,2,4 --out {out}",
        ),
        60,
        ("sessions.csv", "cells.csv", "times.csv", "configuration.json"),
        ("docs/ranking.md",),
        campaigns=("begbroke24h",),
        resumes=True,
    ),
    "fleet": Study(
        (
            f"engram lab simulate begbroke24h --sessions {_FIRST_25}",
            f"{_EVALUATE}fleet begbroke24h --first 25 --tried 5 --groups 4 --arms A,B "
            "--experiments 7,9 --only-folds 0 --out {out}",
        ),
        40,
        _STUDIED,
        ("docs/papers.md", "lab/reports/fleet.md", "lab/reports/downloads.md"),
        campaigns=("begbroke24h",),
        resumes=True,
    ),
    "fleet-as-published": Study(
        (
            f"engram lab simulate begbroke24h --sessions {_FIRST_25}",
            f"{_EVALUATE}fleet begbroke24h --first 25 --config {{settings}}/starved-fleet.toml "
            "--tried 5 --groups 4 --experiments 7,9 --only-folds 0 --out {out}",
        ),
        30,
        _STUDIED,
        ("lab/reports/fleet-as-published.md",),
        campaigns=("begbroke24h",),
        resumes=True,
    ),
    "fleet-whole": Study(
        (
            "engram lab simulate begbroke24h",
            f"{_EVALUATE}fleet begbroke24h --tried 5 --groups 4,2,8 --arms A,B "
            "--experiments 7,8,9 --out {out}",
            f"{_EVALUATE}fleet begbroke24h --tried 5 --arms B --experiments 10 "
            "--out {out}/orders",
        ),
        300,
        _STUDIED,
        ("lab/reports/fleet.md",),
        campaigns=("begbroke24h",),
        resumes=True,
    ),
    "saving": Study(
        (f"{_EVALUATE}faults --only saving --towns 405,406,407,408 --json",),
        60,
        ("1.txt",),
        ("lab/reports/constants.md",),
    ),
    "cameras": Study(
        (
            f"{_EVALUATE}faults --only lenses --towns 401,405 --json",
            f"{_EVALUATE}faults --only mountings --towns 401 --json",
        ),
        30,
        ("1.txt", "2.txt"),
        ("lab/reports/fleet-checks.md",),
    ),
    "directions": Study(
        (
            f"{_EVALUATE}faults --only directions --towns 401 --live 6,7,8,13,14 --json",
            "engram lab simulate oxford",
            f"{_EVALUATE}faults --only directions --campaign oxford --mapped 0,1 --live 8,9 --json",
        ),
        60,
        ("1.txt", "3.txt"),
        ("lab/reports/fleet-checks.md",),
        campaigns=("oxford",),
    ),
    "dreams": Study(
        (f"{_EVALUATE}faults --only dreams --towns 405 --json",),
        60,
        ("1.txt",),
        ("lab/reports/fleet-checks.md",),
    ),
    "lookalikes": Study(
        (f"{_EVALUATE}faults --only equal-fronts --live 3 --json",),
        30,
        ("1.txt",),
        ("lab/reports/lookalikes.md",),
    ),
    "eyes": Study(
        (f"{_CHECKS}eyes --kinds brief,net --out {{out}}/eyes",),
        30,
        ("eyes.csv",),
        ("docs/eyes.md", "lab/reports/eyes.md"),
        real=True,
    ),
    "peers": Study(
        (f"{_EVALUATE}peers --out {{out}}",),
        20,
        ("peers.csv", "configuration.json"),
        ("docs/compare.md",),
        real=True,
        resumes=True,
    ),
    "confidence": Study(
        ("python -m engram_lab.fits.confidence --shipped --held-out 405,406,407",),
        60,
        ("1.txt",),
        ("lab/reports/trust.md",),
    ),
    "repair": Study(
        (
            f"engram lab simulate begbroke24h --seed 2 --sessions {','.join(_LAPS)}",
            *(f"engram map {{out}}/town.engram {_TOWN_2}/0{lap:0>2}-*.framelog" for lap in _LAPS),
            f"{_CHECKS}repair {{out}}/town.engram --campaign begbroke24h@2 --plant 20",
        ),
        30,
        ("6.txt",),
        ("lab/reports/trust.md",),
    ),
    "faults": Study(
        (f"{_EVALUATE}faults --trials 1012 --work {{out}}/trials.jsonl --out {{out}}/faults.md",),
        45,
        ("faults.md",),
        ("docs/evidence.md", "lab/reports/faults.md"),
        real=True,
        resumes=True,
    ),
    "scale": Study(
        (
            f"{_EVALUATE}scale --sizes 7500,100000,1000000 --maps {{out}}/maps "
            "--out {out}/scale.md --json",
        ),
        40,
        ("1.txt", "scale.md"),
        ("docs/evidence.md", "lab/reports/performance.md"),
        town=False,
    ),
    "hand-ins": Study(
        (f"{_CHECKS}hand_ins --json {{out}}/figures.json",),
        15,
        ("figures.json",),
        ("docs/evidence.md",),
        town=False,
    ),
    "doctor": Study(
        (f"{_CHECKS}doctor --work {{out}}/trials.jsonl",),
        60,
        ("1.txt",),
        ("lab/reports/doctor.md",),
        real=True,
        resumes=True,
    ),
    "centre": Study(
        (
            f"{_CHECKS}centre_load --agents 50 --nodes 20000 --minutes 6 --forays 4 "
            "--json {out}/figures.json",
        ),
        8,
        ("figures.json",),
        ("docs/centre.md",),
        town=False,
    ),
    "weak-spots": Study(
        (
            f"engram lab simulate begbroke24h --sessions {_FIRST_40}",
            "python -m engram_lab.studies.weak_spots begbroke24h --drives 32 --mapped 1 --from 24 "
            "--maps {out}/maps --json {out}/figures.json",
        ),
        20,
        ("figures.json", "2.txt"),
        ("lab/reports/weak-spots.md",),
        campaigns=("begbroke24h",),
        resumes=True,
    ),
    "kills": Study(
        (f"{_CHECKS}kill_mapping {{data}}/kitti_odometry/sequences/06 --kills 50",),
        15,
        ("1.txt",),
        ("docs/evidence.md",),
        real=True,
        town=False,
    ),
    "power-cuts": Study(
        (f"{_CHECKS}power_cuts --cuts 2000 --json {{out}}/figures.json",),
        12,
        ("figures.json",),
        ("docs/evidence.md",),
        town=False,
    ),
    "mutations": Study(
        (
            f"{_CHECKS}mutations --cases 20000 --out {{out}}/cases.jsonl "
            "--json {out}/figures.json",
        ),
        60,
        ("figures.json",),
        ("docs/evidence.md",),
        town=False,
        resumes=True,
    ),
}


@dataclass(frozen=True, slots=True)
class Manifest:
    """How a study was run: what its tables say holds of these versions and no others.

    Attributes:
        source: commit of the checkout that ran it; empty for an installed package.
        settings: every default in force, by key; a command's own options, `--config` and seeds
            among them, stand in `commands`.
        ran: how many of the commands were run to their end.
        seconds: spent on it, in all its pieces.
    """

    study: str
    commands: tuple[str, ...]
    method: int
    world: int
    engram: str = ""
    source: str = ""
    machine: str = ""
    started: str = ""
    settings: dict[str, Any] = field(default_factory=dict)
    ran: int = 0
    seconds: float = 0.0

    @staticmethod
    def now(name: str, commands: tuple[str, ...] = ()) -> Manifest:
        """Of a study that begins; without commands it is one of the table."""
        return Manifest(
            name,
            commands or STUDIES[name].commands,
            METHOD_VERSION,
            WORLD_VERSION,
            __version__,
            _source(),
            f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
            datetime.now(UTC).isoformat(timespec="seconds"),
            by_key(AllSettings()),
        )

    @property
    def is_done(self) -> bool:
        """Whether all commands were run to their end."""
        return self.ran == len(self.commands)

    @property
    def is_current(self) -> bool:
        """Whether today's method, world and commands would give the same."""
        study = STUDIES.get(self.study)
        return (
            study is not None
            and self.method == METHOD_VERSION
            and (self.world == WORLD_VERSION or not study.town)
            and self.commands == study.commands
        )


MANIFEST = "manifest.json"
# Settings files of studies.
SETTINGS = Path(__file__).with_name("settings")


def read_manifest(folder: Path) -> Manifest | None:
    """What was run of a study; None where nothing was."""
    path = folder / MANIFEST
    if not path.exists():
        return None
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        return Manifest(**{**known, "commands": tuple(known["commands"])})
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(
            f"{path}: is not a study's manifest ({error}); remove its folder, and the same command "
            "runs the study again"
        ) from error


def _source() -> str:
    """The commit of this checkout, with a plus where files differ from it."""
    told = subprocess.run(
        ["git", "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    return told.stdout.strip() if told.returncode == 0 else ""


class State(StrEnum):
    """How far a study is."""

    DONE = "done"
    BEGUN = "begun"
    STALE = "stale"
    MISSING = "missing"
    NO_DATA = "needs ENGRAM_DATA"

    @staticmethod
    def of(name: str, out: Path) -> State:
        """By the manifest in a folder of results."""
        known = read_manifest(out / name)
        if known is not None and not known.is_current:
            return State.STALE
        if known is not None and known.is_done:
            return State.DONE
        if STUDIES[name].real and not os.environ.get("ENGRAM_DATA"):
            return State.NO_DATA
        return State.MISSING if known is None else State.BEGUN


@dataclass(frozen=True, slots=True)
class Planned:
    """One row of a plan.

    Attributes:
        minutes: still to be spent: what the last whole run took, else the estimate, less what was
            spent already.
        rendered: drives of its campaigns that are rendered, and how many there are.
    """

    name: str
    state: State
    minutes: float
    rendered: tuple[int, int]

    @staticmethod
    def of(name: str, out: Path) -> Planned:
        """A study as it stands in a folder of results."""
        study, state, known = STUDIES[name], State.of(name, out), read_manifest(out / name)
        logs = [
            path
            for campaign in study.campaigns
            for path in campaign_logs(campaign_named(campaign), campaigns_folder())
        ]
        there = sum(path.exists() for path in logs)
        minutes = float(study.minutes)
        if known is not None and known.is_done:
            minutes = 0.0 if state is State.DONE else known.seconds / 60
        elif state is State.BEGUN and known is not None and study.resumes:
            minutes = max(minutes - known.seconds / 60, minutes / 10)
        return Planned(name, state, minutes, (there, len(logs)))

    @property
    def to_run(self) -> bool:
        """Whether it is to be run, and can be."""
        return self.state not in {State.DONE, State.NO_DATA}

    def row(self) -> dict[str, str]:
        """Its cells, for `plain_table`."""
        there, of = self.rendered
        return {
            "study": self.name,
            "state": self.state.value,
            "minutes": f"{self.minutes:.0f}",
            "drives": f"{there} of {of}" if of else "",
            "pages": ", ".join(Path(one).name for one in STUDIES[self.name].pages),
        }


COLUMNS = {
    "study": "study",
    "state": "state",
    "minutes": "minutes left",
    "drives": "drives rendered",
    "pages": "for",
}


def plan(out: Path, only: Collection[str] = ()) -> list[Planned]:
    """Every study, or some by name, in the order of the table."""
    if unknown := sorted(set(only) - set(STUDIES)):
        raise ConfigError(f"no study {unknown[0]!r}; the studies are {', '.join(STUDIES)}")
    return [Planned.of(name, out) for name in STUDIES if not only or name in only]


def fitting(planned: Sequence[Planned], hours: float | None) -> Iterator[tuple[str, float | None]]:
    """The studies that are run in so many hours, each with the seconds that it has at most.

    In their order, those that fit whole; then the first of the others that resumes has what is
    left. Without a limit all are run to their end.
    """
    left = None if hours is None else 60 * hours
    too_long: str | None = None
    for one in planned:
        if not one.to_run:
            continue
        if left is None:
            yield one.name, None
        elif one.minutes <= left:
            left -= one.minutes
            yield one.name, None
        elif too_long is None and STUDIES[one.name].resumes:
            too_long = one.name
    if too_long is not None and left is not None and left >= 1:
        yield too_long, 60 * left


def run_study(name: str, out: Path, within_s: float | None = None) -> bool:
    """Runs what is missing of one study; a stale one is set aside, never written over.

    Args:
        within_s: seconds after which it is interrupted; the next run resumes.

    Returns:
        Whether it is done.

    Raises:
        InputError: a command failed; what it printed is in its file.
    """
    folder = out / name
    known = read_manifest(folder)
    if known is not None and not known.is_current:
        aside = known.started.replace(":", "")[:17] or "before"
        folder.rename(out / f"{name}.{aside}.method{known.method}")
        known = None
    if known is None:
        known = Manifest.now(name)
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder, known)
    before, began = known.seconds, time.monotonic()
    for number in range(known.ran, len(known.commands)):
        left_s = None if within_s is None else within_s - (time.monotonic() - began)
        status = run_command(known.commands[number], folder, f"{number + 1}.txt", left_s)
        known = replace(
            known,
            ran=number + (status == 0),
            seconds=round(before + time.monotonic() - began, 1),
        )
        _write(folder, known)
        if status is None:
            return False
        if status != 0:
            raise InputError(
                f"{name}: exit status {status} of: {known.commands[number]}\n"
                f"What it printed is in {folder}/{number + 1}.txt; the same command tries again"
            )
    return True


def _write(folder: Path, manifest: Manifest) -> None:
    write_json(folder / MANIFEST, to_dict(manifest))


def run_command(line: str, folder: Path, printed: str, within_s: float | None) -> int | None:
    """Runs a command line in a process that does not outlive this one.

    Returns:
        Its exit status; None where its time was over.
    """
    words = words_of(line, folder)
    # Started afresh: a forked child would share this process's threads half way through.
    process = multiprocessing.get_context("spawn").Process(
        target=_run_here, args=(words, folder / printed)
    )
    process.start()
    try:
        process.join(within_s)
        return process.exitcode
    finally:
        if process.exitcode is None:
            assert process.pid is not None
            os.kill(process.pid, signal.SIGINT)
            process.join(_GRACE_S)
            process.kill()
            process.join()


# An interrupted study finishes a drive; killed, it repeats that one.
_GRACE_S = 30.0


def words_of(line: str, folder: Path) -> list[str]:
    """The words of a study's command, its places filled in."""
    data = os.environ.get("ENGRAM_DATA", "")
    words: list[str] = []
    for word in shlex.split(line):
        filled = word.format(out=folder, campaigns=campaigns_folder(), data=data, settings=SETTINGS)
        path = Path(filled)
        words += map(str, sorted(path.parent.glob(path.name))) if "*" in word else [filled]
    return words


def _run_here(words: list[str], printed: Path) -> None:
    """The whole of a process: one command, whose output goes to a file."""
    end_with_parent()
    with printed.open("wb") as file:
        os.dup2(file.fileno(), 1)
    if words[0] == "engram":
        sys.argv = words
        main()
        return
    module = words[words.index("-m") + 1]
    sys.argv = words[words.index("-m") + 1 :]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def run_all(
    out: Path,
    only: Collection[str] = (),
    hours: float | None = None,
    tell: Callable[[str], None] = print,
) -> list[str]:
    """Runs what is stale or missing, alone in its folder; the same call continues.

    Returns:
        The studies that failed; the others were run all the same.
    """
    failed = []
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        with alone_in(out):
            for name, within_s in list(fitting(plan(out, only), hours)):
                tell(f"{name} …")
                try:
                    done = run_study(name, out, within_s)
                except InputError as error:
                    failed.append(name)
                    tell(str(error))
                    continue
                tell(f"{name}: {'done' if done else 'its time is over; it continues next time'}")
    return failed
