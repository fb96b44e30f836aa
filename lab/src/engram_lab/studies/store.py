"""Results on disk: one file per held-out session, added to as configurations are run."""

from __future__ import annotations

import json
import os
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Iterable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from engram_lab.studies.configurations import Configuration
from engram_lab.studies.lockstep import Runs

_VERSION = 3
# What NumPy, zip and JSON say of damaged files.
UNREADABLE = (
    OSError,
    EOFError,
    ValueError,
    LookupError,
    TypeError,
    SyntaxError,
    NotImplementedError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
_LISTS = {"configurations", "in_force"}
_PER_FRAME = [one.name for one in fields(Runs) if one.name not in _LISTS | {"step_m"}]


def read_runs(path: Path) -> Runs | None:
    """What was run of a session; None where nothing was, or the file is of no use."""
    if not path.exists():
        return None
    try:
        with np.load(path) as kept:
            if int(kept["kind"][0]) != _VERSION:
                return None
            plain = json.loads(str(kept["configurations"][0]))
            in_force = json.loads(str(kept["in_force"][0]))
            columns: dict[str, Any] = {name: kept[name] for name in _PER_FRAME}
            return Runs(
                tuple(Configuration.from_dict(one) for one in plain),
                kept["step_m"],
                in_force=tuple(dict(one) for one in in_force),
                **columns,
            )
    except UNREADABLE:
        return None


def write_runs(path: Path, runs: Runs) -> None:
    """In one step: a killed run leaves what was there."""
    plain = [one.to_dict() for one in runs.configurations]
    draft = path.with_name(f".{path.name}.{os.getpid()}.npz")
    np.savez_compressed(
        draft,
        kind=np.array([_VERSION]),
        configurations=np.array([json.dumps(plain)]),
        in_force=np.array([json.dumps(runs.in_force)]),
        step_m=runs.step_m,
        **{name: getattr(runs, name) for name in _PER_FRAME},
    )
    draft.replace(path)


def joined(first: Runs | None, second: Runs) -> Runs:
    """Both; the second's where both have run a configuration."""
    if first is None:
        return second
    kept = only(first, set(first.configurations) - set(second.configurations))
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(kept, name), getattr(second, name)]) for name in _PER_FRAME
    }
    return Runs(
        kept.configurations + second.configurations,
        second.step_m,
        in_force=kept.in_force + second.in_force,
        **columns,
    )


def only(runs: Runs, wanted: Collection[Configuration]) -> Runs:
    """Some of the configurations, in the order in which they stand."""
    rows = [row for row, one in enumerate(runs.configurations) if one in wanted]
    columns: dict[str, Any] = {name: getattr(runs, name)[rows] for name in _PER_FRAME}
    return replace(
        runs,
        configurations=tuple(runs.configurations[row] for row in rows),
        in_force=tuple(runs.in_force[row] for row in rows),
        **columns,
    )


def missing(runs: Runs | None, wanted: Iterable[Configuration]) -> list[Configuration]:
    """What is wanted and was not run."""
    done = set() if runs is None else set(runs.configurations)
    return [one for one in dict.fromkeys(wanted) if one not in done]
