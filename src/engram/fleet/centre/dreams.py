"""Dreams: jobs that look for a better map in what robots handed in.

A dream is what is handed in, how it is merged and what judges it: each is dreamt of once.
"""

from __future__ import annotations

import hashlib
import json
from contextlib import closing, suppress

from sqlalchemy import select

from engram.config import to_dict
from engram.counts import counted
from engram.fleet.centre import jobs
from engram.fleet.centre.database import rows_of
from engram.fleet.centre.jobs import WORKER
from engram.fleet.centre.objects import given_by
from engram.fleet.centre.problems import ConflictError
from engram.fleet.centre.service import Centre, log_of, newest_merged
from engram.fleet.centre.tables import Dream, HandIn, JobState, dreams, handins
from engram.fleet.dream import FEWEST_DRIVES
from engram.fleet.transfers import Manifest, PartHash, blobs_named, decode_page, part_hash
from engram.maps.exchange import MapRows
from engram.maps.records import Revision
from engram.maps.schema import frames, nodes

_LISTED = 100


def ask(centre: Centre, name: str, by: str) -> Dream:
    """Asks for a dream of what is handed in now; one that failed or was cancelled, again.

    Raises:
        ConflictError: there is nothing to dream of, or too little to judge it by.
    """
    gate = centre.policy(name).gate
    if len(gate) < FEWEST_DRIVES:
        raise ConflictError(
            f"{name} has {counted(len(gate), 'held-out drive')}, too few to rule out chance; "
            f"give at least {FEWEST_DRIVES} with engram centre map --gate"
        )
    if not merged_handins(centre, name):
        raise ConflictError(f"nothing is merged into {name} yet: there is nothing to dream of")
    with centre.reading(name) as store:
        since = store.revision
    key, now = key_of(centre, name), centre.now_ns()
    row = Dream(key, name, JobState.ASKED, asked_by=by, asked_ns=now, since=since)
    again = set() if by == WORKER else set(JobState) - {JobState.DONE}
    with centre.database.writing() as connection:
        jobs.ask(centre, connection, row, by, "dream", again=again)
    return jobs.get(centre, Dream, key)


def ask_quietly(centre: Centre) -> None:
    """Asks for the dreams of maps whose quiet hours these are."""
    for name in centre.map_names():
        if centre.policy(name).is_quiet(centre.now_ns()):
            with suppress(ConflictError):
                ask(centre, name, WORKER)


def listed(centre: Centre, name: str) -> list[Dream]:
    """The last dreams of a map, newest first."""
    newest = dreams.c.asked_ns.desc()
    return centre.database.rows(Dream, dreams.c.map == name, order=newest, limit=_LISTED)


def due(centre: Centre) -> list[Dream]:
    """Dreams to run now; outdated ones are cancelled and requested again."""
    for row in jobs.pending(centre, Dream):
        if key_of(centre, row.map) != row.id:
            error = "robots have handed in since"
            jobs.set_state(centre, row, JobState.CANCELLED, error=error)
            with suppress(ConflictError):
                ask(centre, row.map, row.asked_by)
    return [row for row in jobs.pending(centre, Dream) if is_due(centre, row)]


def is_due(centre: Centre, row: Dream) -> bool:
    """Whether it is requested, and by a person or within quiet hours."""
    now = jobs.get(centre, Dream, row.id)
    quiet = centre.policy(row.map).is_quiet(centre.now_ns())
    return now.state == JobState.ASKED and (quiet or now.asked_by != WORKER)


def key_of(centre: Centre, name: str) -> str:
    """The id of the dream of what is handed in now."""
    policy = centre.policy(name)
    manifests = [row.manifest for row in merged_handins(centre, name)]
    about = json.dumps([name, manifests, policy.gate, to_dict(policy.merge)], sort_keys=True)
    return hashlib.sha256(about.encode()).hexdigest()[:32]


def merged_handins(centre: Centre, name: str) -> list[HandIn]:
    """Each robot's newest merged hand-in, oldest first: it holds all that the robot mapped.

    Robots of which something was reverted since are left out until they hand in again: a dream
    brings nothing back that a person hid.
    """
    of_map, last = handins.c.map == name, handins.c.place.in_(newest_merged(name))
    with centre.database.reading() as connection:
        newest = rows_of(connection, HandIn, of_map, last, order=handins.c.place)
        query = select(handins.c.robot, handins.c.revision)
        merged = connection.execute(query.where(of_map, handins.c.revision.is_not(None))).all()
    with centre.reading(name) as store:
        log = log_of(store)
    hidden = {entry.configuration["revert"]: entry.number for entry in log if _reverts(entry)}
    reverted: dict[str, int] = {}
    for robot, revision in merged:
        reverted[robot] = max(reverted.get(robot, 0), hidden.get(revision, 0))
    return [row for row in newest if (row.revision or 0) >= reverted.get(row.robot, 0)]


def _reverts(revision: Revision) -> bool:
    return isinstance(revision.configuration.get("revert"), int)


def parts_of(centre: Centre, row: HandIn, manifest: Manifest) -> dict[PartHash, bytes]:
    """Pages and blobs of a merged hand-in: its robot's own, or the fleet map's."""
    packs = centre.packs(row.map)
    found = dict(packs.read(dict.fromkeys(manifest.hashes())))
    named = [blob for _, _, blobs in blobs_named(manifest, found.get) for blob in blobs]
    with centre.database.reading() as connection:
        own = given_by(connection, row.map, row.robot, named)
    found |= dict(packs.read(dict.fromkeys(blob for blob in named if blob in own)))
    if any(blob not in found for blob in named):
        found |= _blobs_of_fleet_map(centre, row.map, manifest, found)
    return found


def _blobs_of_fleet_map(
    centre: Centre, name: str, manifest: Manifest, pages: dict[PartHash, bytes]
) -> dict[PartHash, bytes]:
    """Blobs that the robot got from the fleet map, and so does not hand in."""
    kept = [pages[page] for page in manifest.pages.get("nodes", ())]
    uuids = {row[1] for page in kept for row in decode_page(nodes, page)}
    found = {}
    with closing(MapRows(centre.map_path(name))) as rows:
        for key in [row[0] for row in rows.of(nodes) if row[1] in uuids]:
            for body in rows.one(frames, key)[2:4]:
                if body is not None:
                    found[part_hash(body)] = body
    return found
