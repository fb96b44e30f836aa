"""How hard the simulated town is: what `engram bench --only world` measures and recalls."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from engram.errors import ConfigError
from engram.frontend import StereoPair
from engram.geometry import SE3
from engram.sequences.opening import open_sequence
from engram_lab.town import WORLD_VERSION, SimulatedDrive, campaign_named
from engram_lab.town.calibration import (
    CLIP_FRAMES,
    CLIP_SPACING_M,
    CLIP_STEPS,
    UNSEEN_TOWNS,
    Appearance,
    Places,
    Row,
    appearance,
    appearance_table,
    falloff,
    falloff_table,
    world_hash,
)

if TYPE_CHECKING:
    from rich.table import Table

RECORD = Path(__file__).with_name("world_record.json")
# Of `village`: a clear morning, where its road runs straight between houses, as on the clip.
_SESSION, _FIRST_FRAME = 1, 60


@dataclass(frozen=True, slots=True)
class WorldReport:
    """The calibration table.

    Attributes:
        version, hash: of the present world.
        towns: that rows (a) to (c) pool.
        measured: rows (a), (b), (c), (e), just measured.
        recorded: rows (d), (f), as `benchmarks/world.py` last found them.
        recorded_hash: of the world that these were measured in; None where there is no record.
        recorded_on: which town and how many laps.
        notes: what is missing, and why.
    """

    version: int
    hash: str
    towns: tuple[int, ...]
    measured: tuple[Row, ...]
    recorded: tuple[Row, ...]
    recorded_hash: str | None
    recorded_on: str
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "version": self.version,
            "hash": self.hash,
            "towns": list(self.towns),
            "measured": [row.to_dict() for row in self.measured],
            "recorded": [row.to_dict() for row in self.recorded],
            "recorded_hash": self.recorded_hash,
            "recorded_on": self.recorded_on,
            "notes": list(self.notes),
        }

    def table(self) -> Table:
        """A table for people."""
        from rich.table import Table

        towns = ", ".join(map(str, self.towns))
        table = Table(
            title=f"world {self.version} ({self.hash}), towns {towns}",
            caption="\n".join(self.notes) or None,
        )
        for column in ("row", "what", "value", "", "bounds"):
            table.add_column(column, justify="right" if column == "value" else "left")
        for row in (*self.measured, *self.recorded):
            table.add_row(row.letter, row.what, f"{row.value:.2f}", row.unit, row.verdict)
        return table


def measure_world(
    towns: Sequence[int] = UNSEEN_TOWNS, advance: Callable[[str], None] | None = None
) -> WorldReport:
    """Measures rows (a) to (c) and (e), and recalls (d) and (f); 3 to 5 minutes on one core.

    Args:
        towns: seeds whose places are pooled.
        advance: called with what comes next.

    Raises:
        ConfigError: no town is given.
    """
    if not towns:
        raise ConfigError("no town to measure; give at least one seed")
    tell = advance or (lambda _: None)
    seen: list[Appearance] = []
    for seed in towns:
        tell(f"world: town {seed}")
        seen.append(appearance(Places(seed), tell))
    rows = appearance_table(Appearance.pooled(seen))
    notes: list[str] = []
    clip = load_clip()
    if clip is None:
        notes.append("row (e) needs KITTI 06 under $ENGRAM_DATA: not measured")
    else:
        tell("world: KITTI's camera")
        rows += falloff_table(falloff(town_like_clip(), CLIP_STEPS), falloff(clip, CLIP_STEPS))
    recorded, recorded_hash, recorded_on = read_record()
    if recorded_hash is None:
        notes.append("rows (d) and (f) were not recorded; run benchmarks/world.py --record")
    elif recorded_hash != world_hash():
        notes.append(
            f"WARNING: rows (d) and (f) are of another world ({recorded_hash}); run "
            "benchmarks/world.py --record"
        )
    return WorldReport(
        WORLD_VERSION, world_hash(), tuple(towns), tuple(rows), recorded, recorded_hash,
        recorded_on, tuple(notes),
    )  # fmt: skip


def load_clip() -> list[tuple[SE3, StereoPair]] | None:
    """KITTI 06, frames 0 to 50, with true poses; None where ``$ENGRAM_DATA`` has it not."""
    root = os.environ.get("ENGRAM_DATA")
    odometry = Path(root or "") / "kitti_odometry"
    clip, truth = odometry / "sequences" / "06", odometry / "poses" / "06.txt"
    if not root or not clip.is_dir() or not truth.is_file():
        return None
    poses = [SE3.from_matrix(row.reshape(3, 4)) for row in np.loadtxt(truth)]
    pairs = [pair for pair in open_sequence(clip) if isinstance(pair, StereoPair)]
    return list(zip(poses, pairs, strict=False))[:CLIP_FRAMES]


def town_like_clip() -> list[tuple[SE3, StereoPair]]:
    """As many frames of the town by KITTI's camera, at the clip's spacing."""
    village = campaign_named("village")
    plan = replace(village.session(_SESSION), robot="kitti")
    sessions = (*village.sessions[:_SESSION], plan, *village.sessions[_SESSION + 1 :])
    drive = SimulatedDrive(replace(village, sessions=sessions, spacing_m=CLIP_SPACING_M), _SESSION)
    last = _FIRST_FRAME + CLIP_FRAMES
    poses = drive.world_from_cams()[_FIRST_FRAME:last]
    return list(zip(poses, drive.frames(_FIRST_FRAME, last), strict=True))


def read_record(path: Path = RECORD) -> tuple[tuple[Row, ...], str | None, str]:
    """Rows (d) and (f), the hash of their world, and where they were measured."""
    if not path.exists():
        return (), None, ""
    known = json.loads(path.read_text(encoding="utf-8"))
    return tuple(Row.from_dict(row) for row in known["rows"]), known["hash"], known["on"]


def write_record(rows: Sequence[Row], measured_on: str, path: Path = RECORD) -> None:
    """Keeps rows (d) and (f) with the world that they were measured in."""
    known = {
        "world": WORLD_VERSION,
        "hash": world_hash(),
        "on": measured_on,
        "rows": [row.to_dict() for row in rows],
    }
    path.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
