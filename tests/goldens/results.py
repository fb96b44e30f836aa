"""Rows and values of a case, and how they are compared."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy

FOLDER = Path(__file__).parent
TOLERANCE = 1e-6  # of poses, metres and radians, where bits cannot be compared
_ROUNDED = 1.01e-7  # by seven decimals, twice half a unit
# What any machine must find; all other columns are bits.
_EXACT = frozenset({"frame", "status", "node", "attempts"})
_SHORT = {
    "ok": "ok", "first": "first", "localised": "loc", "dead_reckoning": "dead", "lost": "lost",
    "no_odometry": "none",
}  # fmt: skip


@dataclass
class Case:
    """What one case came to: a row per frame, and values by name."""

    columns: list[str] = field(default_factory=list)
    rows: list[str] = field(default_factory=list)
    values: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        return {
            **({"columns": " ".join(self.columns), "rows": self.rows} if self.rows else {}),
            **({"values": self.values} if self.values else {}),
        }

    @staticmethod
    def from_dict(told: dict[str, Any]) -> Case:
        columns = told.get("columns", "").split()
        return Case(columns, told.get("rows", []), told.get("values", {}))


def measured_case(frames: list[dict[str, Any]]) -> Case:
    """Rows of front-end and odometry."""
    columns = [
        "frame",
        "status",
        "inliers",
        "landmarks",
        "landmark_bits",
        "motion",
        "covariance",
        "pose",
    ]
    rows = [
        [
            _word(one["frame"]),
            _word(one["status"]),
            str(one["inliers"]),
            str(one["landmarks"]),
            _bits(one["landmark_bytes"]),
            _bits(one["prev_from_curr"]),
            _bits(one["covariance"]),
            _pose(one["prev_from_curr"]),
        ]
        for one in frames
    ]
    return Case(columns, [" ".join(row) for row in rows])


def found_case(frames: list[dict[str, Any]], *, poses: bool) -> Case:
    """Rows of a drive that was localised or mapped, with readable poses or without."""
    columns = [
        "status",
        "node",
        "attempts",
        "candidates",
        "proposed",
        "inliers",
        "matched",
        "covariance",
        "position",
        "open_loop",
        "moved",
        "motion",
    ]
    rows = [
        [
            _word(one["status"]),
            "-" if one["node"] is None else one["node"][:8],
            str(one["attempts"]),
            str(one["candidates"]),
            str(one["proposed"]),
            str(one["inliers"]),
            _bits(one["node_from_live"]),
            _bits(one["covariance"]),
            _bits(one["position"]),
            _bits(one["open_loop_m"]),
            _bits(one["moved_m"]) + ("" if one["usable"] else "!"),
            _bits(one["prev_from_curr"]),
        ]
        for one in frames
    ]
    if poses:
        columns.append("pose")
        for row, one in zip(rows, frames, strict=True):
            row.append(_pose(one["node_from_live"]))
    return Case(columns, [" ".join(row) for row in rows])


def _word(status: str) -> str:
    return _SHORT.get(status, status)


def _bits(value: Any) -> str:
    """Four hexadecimal digits of bytes, arrays, numbers and words; "-" of nothing."""
    if value is None:
        return "-"
    digest = hashlib.sha256()
    for part in value if isinstance(value, tuple) else (value,):
        if isinstance(part, str):
            digest.update(part.encode())
        elif isinstance(part, bytes):
            digest.update(part)
        else:
            digest.update(np.ascontiguousarray(part, dtype="<f8").tobytes())
    return digest.hexdigest()[:4]


def _pose(matrix: Any) -> str:
    """Translation and rotation vector of a (4, 4) pose."""
    if matrix is None:
        return "-"
    turn, _ = cv2.Rodrigues(np.ascontiguousarray(matrix[:3, :3]))
    return ",".join(f"{value:.7f}" for value in (*matrix[:3, 3], *turn.ravel()))


def first_difference(golden: Case, found: Case, *, to_the_bit: bool) -> str | None:
    """Where two results of a case differ first: frame and column, or value; None where nowhere."""
    if golden.columns != found.columns:
        return f"columns {found.columns}, golden {golden.columns}: make the goldens anew"
    for frame, (old, new) in enumerate(zip(golden.rows, found.rows, strict=False)):
        for name, was, now in zip(golden.columns, old.split(), new.split(), strict=True):
            if _differ(name, was, now, to_the_bit=to_the_bit):
                return (
                    f"frame {frame}: {name} is {now}, golden {was}\n  now    {new}\n  golden {old}"
                )
    if len(golden.rows) != len(found.rows):
        return f"{len(found.rows)} frames, golden {len(golden.rows)}"
    was, now = _flat(golden.values), _flat(found.values)
    for name in [*was, *(name for name in now if name not in was)]:
        old, new = was.get(name), now.get(name)
        counted = isinstance(old, int) and isinstance(new, int)
        if old != new and (to_the_bit or counted):
            return f"{name} is {new!r}, golden {old!r}"
    return None


def _differ(name: str, was: str, now: str, *, to_the_bit: bool) -> bool:
    if was == now:
        return False
    if to_the_bit or name in _EXACT:
        return True
    if name != "pose" or "-" in {was, now}:
        return name == "pose"
    apart = [float(a) - float(b) for a, b in zip(was.split(","), now.split(","), strict=True)]
    return max(map(abs, apart)) > TOLERANCE + _ROUNDED


def _flat(values: Any, at: str = "") -> dict[str, Any]:
    if isinstance(values, dict):
        pairs = values.items()
    elif isinstance(values, list):
        pairs = enumerate(values)
    else:
        return {at: values}
    found: dict[str, Any] = {}
    for name, value in pairs:
        found |= _flat(value, f"{at}.{name}" if at else str(name))
    return found


def fingerprint() -> dict[str, str]:
    """Versions, and a probe of what the linear algebra of this machine gives for fixed matrices."""
    rng = np.random.default_rng(7)
    digest = hashlib.sha256()
    for _ in range(64):
        matrix = rng.normal(size=(6, 6))
        square = matrix @ matrix.T + np.eye(6)
        for part in (
            np.linalg.eigvalsh(square), np.linalg.inv(square), np.linalg.cholesky(square),
            np.linalg.solve(square, matrix[0]), *np.linalg.svd(matrix[:3, :3]),
            square @ matrix, np.exp(matrix), np.sin(matrix), np.arctan2(matrix, square),
        ):  # fmt: skip
            digest.update(np.ascontiguousarray(part).tobytes())
    large = rng.normal(size=(400, 60))
    digest.update(np.linalg.lstsq(large, large[:, 0] + 1, rcond=None)[0].tobytes())
    digest.update((large.T @ large).tobytes())
    return {
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "opencv": cv2.__version__,
        "linear_algebra": digest.hexdigest()[:16],
    }


def read(name: str) -> dict[str, Any]:
    return json.loads((FOLDER / f"{name}.json").read_text())


def write(name: str, content: dict[str, Any]) -> None:
    text = json.dumps(content, indent=1, ensure_ascii=False)
    (FOLDER / f"{name}.json").write_text(text + "\n")
