"""One hand-in into the fleet map: never twice, never lost.

The row says `complete` until the outcome is known. A worker that dies leaves it so, and the next
one merges again: what was committed is found by the content hash that its revision names.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from engram.centre.errors import MissingPartsError, StoreError
from engram.centre.handins import HandIns
from engram.centre.keeping import HandInState
from engram.centre.parts import Parts
from engram.centre.refs import Refs
from engram.centre.service import Centre, MapPolicy
from engram.centre.worker.admission import KilledError, admit
from engram.centre.worker.watching import Watching
from engram.counts import counted
from engram.errors import (
    EngramError,
    MapLockedError,
    RefusedError,
    SequenceError,
    StorageFullError,
)
from engram.fleet.merge import MergeReport, merge
from engram.maps import Map
from engram.robot import Settings

_log = logging.getLogger(__name__)
# A held-out drive that cannot be read is a SequenceError: robots hand in no drives.
_OF_THE_CENTRE = (StorageFullError, StoreError, MapLockedError, SequenceError)


class WaitsError(EngramError):
    """A hand-in waits for the centre."""


def merge_hand_in(centre: Centre, row: dict[str, Any]) -> None:
    """Merges one complete hand-in.

    Raises:
        EngramError: what lies with the centre, and not with the hand-in, which waits: no space, a
            map that is being written to, a held-out drive that is gone.
    """
    handins = HandIns(centre)
    if row["tries"] >= centre.settings.merge_tries:
        tries = counted(row["tries"], "time")
        fact = f"its worker died {tries}; an operator may have it merged anyway"
        clear_scratch(centre, row)
        handins.end(row, HandInState.FAILED, error=fact)
        return
    handins.begun(row)
    begun_s = time.monotonic()
    thin = _thin_map(centre, row)
    try:
        with _scratch(thin):
            _admit(centre, row, thin)
            outcome = _merged(centre, handins, row, thin)
    except MissingPartsError:  # the map changed since they were asked for, by a revert
        handins.end(row, HandInState.OPEN)
    except RefusedError as error:
        handins.end(row, HandInState.REFUSED, error=centre.words_of(error))
    except KilledError as error:  # this try counts: the map may be what takes the memory
        raise WaitsError(f"{row['map']}: hand-in {row['id'][:8]} waits: {error}") from error
    except (*_OF_THE_CENTRE, OSError) as error:
        fact = centre.words_of(error)
        handins.put_off(row, fact)
        raise WaitsError(f"{row['map']}: hand-in {row['id'][:8]} waits: {fact}") from error
    except KeyboardInterrupt:
        if not handins.get(row["id"])["cancelled"]:
            raise
        handins.end(row, HandInState.CANCELLED, error="cancelled")
    except EngramError as error:
        handins.end(row, HandInState.FAILED, error=centre.words_of(error))
    except Exception as error:  # a stranger's map may bring about any: it ends this hand-in alone
        _log.exception("%s: hand-in %s", row["map"], row["id"][:8])
        fact = f"an unexpected fault, {centre.fault_of(error)}"
        handins.end(row, HandInState.FAILED, error=fact)
    else:
        _settle(centre, handins, row, outcome)
        took_s = time.monotonic() - begun_s
        _log.info("%s: hand-in %s took %.1f s of work", row["map"], row["id"][:8], took_s)


def _admit(centre: Centre, row: dict[str, Any], thin: Path) -> None:
    parts, limits = Parts(centre), centre.settings
    manifest = parts.manifest(row)
    admit(
        manifest,
        parts.source(row, manifest),
        thin,
        limits.admission_bytes,
        limits.admission_s,
    )


def _merged(centre: Centre, handins: HandIns, row: dict[str, Any], thin: Path) -> MergeReport:
    policy = centre.policy(row["map"])
    (report,) = merge(
        centre.map_path(row["map"]),
        [thin],
        policy.merge,
        Watching(partial(handins.heartbeat, row["id"])),
        settings=Settings(),
        require_better=[] if row["ungated"] else [Path(one) for one in policy.gate],
    )
    return report


def _settle(centre: Centre, handins: HandIns, row: dict[str, Any], report: MergeReport) -> None:
    if report.interrupted:
        handins.end(row, HandInState.CANCELLED, error="cancelled")
        return
    told = {**report.to_dict(), "source": f"hand-in {row['id']}"}
    revision = report.revision
    if revision is None:  # nothing new; or a worker died between the merge and this row
        revision = _revision_of(centre.map_path(row["map"]), row["content_hash"])
        report.revision = revision
    handins.end(row, HandInState.MERGED, revision=revision, report=told)
    policy: MapPolicy = centre.policy(row["map"])
    if policy.moves is not None and revision and not row["ungated"]:
        Refs(centre).move(row["map"], policy.moves, revision, "gate", None)


def _revision_of(path: Path, content_hash: str) -> int:
    """The revision that holds a map of this content: the one that merged it, or the newest."""
    with Map.open(path) as store:
        for one in store.log():
            merged = one.configuration.get("merge")
            if isinstance(merged, dict) and merged.get("source") == content_hash:
                return one.number
        return store.revision


def clear_scratch(centre: Centre, row: dict[str, Any]) -> None:
    """Removes what a killed merge of a hand-in left next to the maps."""
    _clear(_thin_map(centre, row))


def _thin_map(centre: Centre, row: dict[str, Any]) -> Path:
    return centre.folder / "work" / f"{row['id']}.engram"


@contextmanager
def _scratch(path: Path) -> Iterator[None]:
    """Removes what a file and its locks leave, before and after."""
    _clear(path)
    try:
        yield
    finally:
        _clear(path)


def _clear(path: Path) -> None:
    for one in path.parent.glob(f"{path.name}*"):
        one.unlink()
