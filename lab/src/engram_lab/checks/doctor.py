"""Whether the doctor finds what is wrong with a drive, and is quiet where nothing is.

python -m engram_lab.checks.doctor                    # rendered clips, and real ones of ENGRAM_DATA
python -m engram_lab.checks.doctor --report           # only the table of what was run

Limits were set on the clips of `clips.SETTING`; these are others, twenty drives of each of five
rigs. Each drive is shown as it is, at rest, and with each fault at a strength drawn log-uniformly
from its stated least one on. Results go to a file as they come; the same command continues where it
stopped.
"""

from __future__ import annotations

import itertools
import json
import os
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from platformdirs import user_cache_path

import engram
from engram.doctor.examination import Facts
from engram.doctor.table import Diagnosis, Severity
from engram.frontend.frame import StereoPair
from engram.frontend.frontend import SMALLEST_SIDE_PX
from engram.geometry.se3 import SE3
from engram.graph.model import Clock
from engram.robot.front import Front
from engram.robot.settings import Settings
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.faults.clips import DOCTORED
from engram_lab.studies.faults.injected import (
    blurred,
    brightened,
    exchanged,
    frozen,
    halved,
    late_side,
    lowered,
    on_both,
    turned,
)

_WINDOW = 24
_HEALTHY = ("healthy", "at rest")
_REAL = (
    ("kitti_odometry/sequences/06", "grey"),
    ("kitti_raw/2011_09_26/2011_09_26_drive_0001_sync", "grey"),
    ("kitti_raw/2011_09_26/2011_09_26_drive_0001_sync", "colour"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Some frames of a drive.

    Attributes:
        truth: world_from_cam of each; empty if unknown.
    """

    name: str
    rig: str
    pairs: list[StereoPair]
    truth: list[SE3]


# Nothing is unknown of the clock.
_KNOWN = Facts(Clock.UTC, "Europe/London")

Inject = Callable[[Window, float, np.random.Generator], list[StereoPair]]


@dataclass(frozen=True, slots=True)
class Kind:
    """A fault that the doctor should find."""

    codes: tuple[str, ...]
    least: float
    most: float
    unit: str
    inject: Inject
    facts: Facts = _KNOWN


def _each(change: Callable[[StereoPair, float], StereoPair]) -> Inject:
    return lambda window, strength, _: [change(pair, strength) for pair in window.pairs]


def _frozen(*sides: str) -> Inject:
    return lambda window, frames, rng: [
        one.pair for one in frozen(window.pairs, frames, 6, rng, sides)
    ]


def _late(window: Window, frames: float, rng: np.random.Generator) -> list[StereoPair]:
    shown = late_side(window.pairs, frames, 0, rng)
    return [one.pair for one in shown[round(frames) :]]


def _stamps(change: Callable[[int, int, float], float]) -> Inject:
    """New stamps, ns, from number, stamp and strength."""
    return lambda window, strength, _: [
        replace(pair, stamp_ns=round(change(k, pair.stamp_ns, strength)))
        for k, pair in enumerate(window.pairs)
    ]


def _slower(window: Window, hz: float, _: np.random.Generator) -> list[StereoPair]:
    first = window.pairs[0].stamp_ns
    usual_s = float(np.median(np.diff([one.stamp_ns for one in window.pairs]))) / 1e9
    factor = 1 / hz / usual_s
    return [
        replace(one, stamp_ns=first + round((one.stamp_ns - first) * factor))
        for one in window.pairs
    ]


def _gap(window: Window, frames: float, _: np.random.Generator) -> list[StereoPair]:
    return [one for k, one in enumerate(window.pairs) if not 9 <= k < 9 + round(frames)]


def _at_level(level: float, *, above: bool) -> Inject:
    """Gains that make a share of every image white, or black."""

    def gained(pair: StereoPair, share: float) -> StereoPair:
        at = 1 - share if above else share
        grey = max(float(np.quantile(pair.left[::4, ::4], at)), 1.0)
        return on_both(pair, lambda image: brightened(image, level / grey))

    return _each(gained)


def _step(window: Window, factor: float, _: np.random.Generator) -> list[StereoPair]:
    return [
        on_both(one, lambda image: brightened(image, 1 / factor)) if k >= 12 else one
        for k, one in enumerate(window.pairs)
    ]


def _other_focal_length(window: Window, by: float, rng: np.random.Generator) -> list[StereoPair]:
    camera, factor = window.pairs[0].camera, (1 + by) ** rng.choice([-1, 1])
    wrong = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    return [replace(one, camera=wrong) for one in window.pairs]


def _fewer(pair: StereoPair, px_per_deg: float) -> StereoPair:
    # Images that the front-end refuses as too small never come to the doctor.
    largest = min(pair.left.shape) / SMALLEST_SIDE_PX
    return halved(pair, min(float(np.radians(pair.camera.fx)) / px_per_deg, largest))


KINDS: dict[str, Kind] = {
    "sides swapped": Kind(("sides_swapped",), 1, 1, "", _each(lambda one, _: exchanged(one))),
    "each image turned": Kind(
        ("images_rotated",), 1, 1, "", _each(lambda one, _: on_both(one, turned))
    ),
    "right image of earlier frames": Kind(("not_synchronised",), 1, 3, "frames", _late),
    "right image lower": Kind(
        ("rows_misaligned",), 2, 8, "px",
        _each(lambda one, px: replace(one, right=lowered(one.right, px))),
    ),
    "right image rolled": Kind(
        ("rows_misaligned",), 0.015, 0.05, "rad",
        _each(lambda one, rad: replace(one, right=lowered(one.right, 0, rad))),
    ),
    "stream frozen": Kind(("frozen_stream",), 3, 15, "frames", _frozen("left", "right")),
    "right side frozen": Kind(("frozen_stream",), 3, 15, "frames", _frozen("right")),
    "images dark": Kind(
        ("no_odometry",), 50, 250, "times",
        _each(lambda one, by: on_both(one, lambda image: brightened(image, 1 / by))),
    ),
    "stamps set back": Kind(
        ("stamps_backwards",), 0.5, 3600, "s", _stamps(lambda k, at, s: at - (k >= 9) * s * 1e9)
    ),
    "stamps counted": Kind(("stamps_counted",), 1, 1, "", _stamps(lambda k, *_: k * 1e9)),
    "rows slightly off": Kind(
        ("rows_slightly_off", "rows_misaligned"), 1.5, 2, "px",
        _each(lambda one, px: replace(one, right=lowered(one.right, px))),
    ),
    "upside down": Kind(
        ("upside_down",), 1, 1, "", _each(lambda one, _: exchanged(on_both(one, turned)))
    ),
    "focal length wrong": Kind(("scale_off",), 0.08, 0.3, "too long or short", _other_focal_length),
    "stamps repeated": Kind(
        ("stamps_repeated",), 1, 1, "",
        lambda window, *_: [*window.pairs[:9], window.pairs[8], *window.pairs[9:]],
    ),
    "clock set forwards": Kind(
        ("stamp_jump",), 70, 20000, "s", _stamps(lambda k, at, s: at + (k >= 9) * s * 1e9)
    ),
    "frames missing": Kind(("frame_gaps",), 3, 10, "frames", _gap),
    "slow": Kind(("low_frame_rate",), 1, 3.5, "Hz", _slower),
    "one image repeated": Kind(("repeated_images",), 1, 1, "", _frozen("left", "right")),
    "overexposed": Kind(
        ("overexposed",), 0.5, 0.9, "of the image", _at_level(300, above=True)
    ),
    "black": Kind(("black",), 0.7, 0.95, "of the image", _at_level(6, above=False)),
    "exposure halved at once": Kind(("exposure_steps",), 2, 8, "times", _step),
    "right side darker": Kind(
        ("sides_exposed_differently",), 1.6, 5, "times",
        _each(lambda one, by: replace(one, right=brightened(one.right, 1 / by))),
    ),
    "out of focus": Kind(
        ("blurred",), 4, 10, "px",
        _each(lambda one, px: on_both(one, lambda image: blurred(image, px))),
    ),
    "few pixels": Kind(("low_resolution",), 2, 3.9, "px per degree", _each(_fewer)),
    "hour unknown": Kind(
        ("clock_unknown",), 1, 1, "", _each(lambda one, _: one), Facts(by_hour=True)
    ),
}  # fmt: skip


def windows() -> Iterator[Window]:
    """The rendered clips, made first if not in the cache, and windows of the real ones."""
    for plan in DOCTORED:
        clip = plan.read()
        yield Window(plan.name, plan.rig, clip.pairs, clip.world_from_cam)
    data = os.environ.get("ENGRAM_DATA")
    for name, rig in _REAL if data else ():
        drive = engram.open_drive(Path(data or "") / name, rig=rig)
        pairs = [pair for pair in drive if isinstance(pair, StereoPair)]
        for first in range(0, len(pairs) - _WINDOW + 1, _WINDOW + 4):
            part = slice(first, first + _WINDOW)
            yield Window(f"{Path(name).name}-{rig}@{first}", f"real {rig}", pairs[part], [])


def examined(pairs: Sequence[StereoPair], truth: Sequence[SE3], facts: Facts) -> Diagnosis:
    """What the doctor says of a drive."""
    front = Front(Settings())
    front.examination.evidence.facts = facts
    for pair in pairs:
        if front.clock.take(pair.stamp_ns):
            front.take(pair)
    evidence = front.examination.evidence
    evidence.taken = front.clock.report
    if len(truth) == len(evidence):
        steps = [before.inverse() @ after for before, after in itertools.pairwise(truth)]
        evidence.outside = [None, *steps]
    return front.diagnosis


def at_rest(window: Window, rng: np.random.Generator) -> list[StereoPair]:
    """A robot that stands at the window's first frame, before a camera with a little noise."""
    first = window.pairs[0]

    def noisy(image: np.ndarray) -> np.ndarray:
        seen = image + rng.normal(0, 1.2, image.shape).astype(np.float32)
        return np.asarray(np.clip(seen, 0, 255), np.uint8)

    return [replace(on_both(first, noisy), stamp_ns=one.stamp_ns) for one in window.pairs]


def trial(window: Window, kind: str) -> dict[str, Any]:
    """One window with one fault, or none."""
    rng = np.random.default_rng(zlib.crc32(f"{window.name} {kind}".encode()))
    if kind in _HEALTHY:
        pairs = window.pairs if kind == "healthy" else at_rest(window, rng)
        truth = window.truth if kind == "healthy" else []
        found = examined(pairs, truth, _KNOWN)
        strength, right = 0.0, _alarms(found) == []
    else:
        what = KINDS[kind]
        strength = float(np.exp(rng.uniform(np.log(what.least), np.log(what.most))))
        found = examined(what.inject(window, strength, rng), window.truth, what.facts)
        right = any(code in what.codes for code in _alarms(found))
    return {
        "window": window.name, "rig": window.rig, "kind": kind, "strength": strength,
        "found": _alarms(found), "right": right,
    }  # fmt: skip


def _alarms(found: Diagnosis) -> list[str]:
    return [one.code for one in found.findings if one.severity is not Severity.NOTE]


def run(file: Path) -> None:
    """Makes the trials that are missing from the file, window by window."""
    done = {(one["window"], one["kind"]) for one in _kept(file)}
    file.parent.mkdir(parents=True, exist_ok=True)
    for window in windows():
        with file.open("a", encoding="utf-8") as out:
            for kind in (*_HEALTHY, *KINDS):
                if (window.name, kind) in done or (
                    kind == "focal length wrong" and not window.truth
                ):
                    continue
                out.write(json.dumps(trial(window, kind)) + "\n")
                out.flush()


def figures(file: Path) -> Iterator[Figure]:
    """Share found of each kind; false alarms."""
    by_kind: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for one in _kept(file):
        by_kind[one["kind"]].append(one)
    for kind, rows in by_kind.items():
        wrong = [one for one in rows if not one["right"]]
        if kind in _HEALTHY:
            yield Figure(f"{kind}: alarms in {len(rows)} windows", len(wrong))
            continue
        what, right = KINDS[kind], 1 - len(wrong) / len(rows)
        span = "" if what.least == what.most else f", {what.least:g} to {what.most:g} {what.unit}"
        yield Figure(f"{kind}{span}: found of {len(rows)}", 100 * right, "%")


def _kept(file: Path) -> list[dict[str, Any]]:
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    return [json.loads(line) for line in lines if line.endswith("}")]


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    default = user_cache_path("engram") / "faults" / "doctor.jsonl"
    parser.add_argument("--work", type=Path, default=default, help="where trials are kept")
    parser.add_argument("--report", action="store_true", help="run nothing")
    asked = parser.parse_args()
    if not asked.report:
        run(asked.work)
    report(figures(asked.work), asked.json, "the doctor, on drives that its limits never saw")


if __name__ == "__main__":
    main()
