"""States of hand-ins and downloads, and what must be kept for them."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from sqlalchemy import Connection, Select, func, select

from engram.centre.store.schema import artifacts, handins


class HandInState(StrEnum):
    """Where a hand-in is."""

    OPEN = "open"  # parts are missing
    COMPLETE = "complete"  # waits for a worker, or is in its hands
    MERGED = "merged"
    REFUSED = "refused"  # by the gate; a person may merge it all the same
    FAILED = "failed"  # it is no map that can be merged here
    CANCELLED = "cancelled"


ENDED = frozenset(
    {HandInState.MERGED, HandInState.REFUSED, HandInState.FAILED, HandInState.CANCELLED}
)
# Of downloads, and of dreams.
READY, ASKED, FAILED = "ready", "asked", "failed"
DONE, CANCELLED = "done", "cancelled"
_UNDER_WAY = (HandInState.OPEN, HandInState.COMPLETE, HandInState.REFUSED)


def manifest_key(name: str, manifest: str) -> str:
    """Where a manifest is kept among the objects."""
    return f"manifests/{name}/{manifest}"


def needed_manifests(connection: Connection, name: str, limit_ns: int) -> list[str]:
    """Manifests of one map whose parts must stay.

    Those of hand-ins that are under way, refused, or ended since a time, and of what these
    continue; of each robot's newest merged one, which its next one continues; and of downloads.
    """
    of_map = handins.c.map == name
    newest = newest_merged(name)
    late = handins.c.state.in_(map(str, _UNDER_WAY)) | (handins.c.ended_ns >= limit_ns)
    found: list[str] = []
    for query in (
        select(handins.c.manifest).where(of_map, late),
        select(handins.c.base).where(of_map, late, handins.c.base.is_not(None)),
        select(handins.c.manifest).where(of_map, handins.c.place.in_(newest)),
        select(artifacts.c.manifest).where(artifacts.c.map == name, artifacts.c.state == READY),
    ):
        found += connection.execute(query).scalars()
    return list(dict.fromkeys(found))


def newest_merged(name: str) -> Select[Any]:
    """Places of each robot's newest merged hand-in to a map."""
    merged = (handins.c.map == name) & (handins.c.state == str(HandInState.MERGED))
    return select(func.max(handins.c.place)).where(merged).group_by(handins.c.robot)
