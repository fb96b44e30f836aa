"""The result of a trial, and the file of all trials: a line of JSON each."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from engram.errors import ConfigError
from engram.localiser import METHOD_VERSION
from engram_lab.studies.faults.staging import DRAW

MADE_BY = f"method {METHOD_VERSION}, draw {DRAW}"


@dataclass(slots=True)
class Trial:
    """Result of one trial.

    Attributes:
        number: of the trial.
        fault: a kind of `KINDS`.
        clip: name of the clip.
        start: number of the first frame of the fault.
        strength: of the fault.
        frames, fixes: how many there were.
        false: fixes that are false.
        events: runs of false fixes.
        worst_m: largest error of a fix, m; in another town 10 km.
        again: frames from the start of the fault until the first right fix; None if never.
        expected: frames that were shown and have a right fix where nothing is wrong.
        lost: those of them without a right fix.
        driven_m: true length of the drive.
        refused: findings of the doctor that are fatal.
        nodes, edges: what the drive added to the map, mapped with ``--force``; None where it was
            not mapped.
        joined: edges among them that join two places, without those of odometry.
        joined_odometry: those of odometry.
        worst_edge_m: the largest error of those edges, m.
        map_refused: why mapping without ``--force`` refuses the drive.
        made_by: versions of the method, and of what the number means; "" of earlier versions.
    """

    number: int
    fault: str
    clip: str
    start: int
    strength: float
    frames: int = 0
    fixes: int = 0
    false: int = 0
    events: int = 0
    worst_m: float = 0.0
    again: int | None = None
    expected: int = 0
    lost: int = 0
    driven_m: float = 0.0
    refused: list[str] = field(default_factory=list)
    nodes: int | None = None
    edges: int | None = None
    joined: int = 0
    joined_odometry: int = 0
    worst_edge_m: float = 0.0
    map_refused: list[str] = field(default_factory=list)
    made_by: str = ""


def default_file(folder: Path) -> Path:
    """Where the trials of these versions are kept in a folder."""
    return folder / f"trials-{METHOD_VERSION}-{DRAW}.jsonl"


def read_trials(file: Path) -> list[Trial]:
    """The trials of a file; a line that a killed run left unfinished is left out."""
    if not file.exists():
        return []
    lines = file.read_text(encoding="utf-8").splitlines()
    rows: list[dict[str, Any]] = [json.loads(line) for line in lines if line.endswith("}")]
    return [Trial(**row) for row in rows]


class TrialFile:
    """A file of trials that is added to.

    Args:
        path: the file; made if there is none.

    Raises:
        ConfigError: it holds trials of other versions.
    """

    def __init__(self, path: Path) -> None:
        made = read_trials(path)
        others = {one.made_by or "an earlier version" for one in made} - {MADE_BY}
        if others:
            raise ConfigError(
                f"{path}: holds trials of {' and '.join(sorted(others))}, new ones are of "
                f"{MADE_BY}; name another file with --work, or report these with --report-only"
            )
        self.numbers = {one.number for one in made}
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not path.read_bytes().endswith(b"\n"):
            self._write("")  # ends the line that a killed run left unfinished

    def add(self, trial: Trial) -> None:
        """Writes one trial."""
        self._write(json.dumps(asdict(trial)))

    def _write(self, line: str) -> None:
        with self._path.open("a", encoding="utf-8") as out:
            out.write(f"{line}\n")
