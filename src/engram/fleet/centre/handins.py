"""Hand-ins: from a manifest and its parts to a job.

A hand-in is its manifest, of one robot, on one map: begun twice it is the same. A part is its hash.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from sqlalchemy import Connection, func, or_, select, update

from engram.counts import counted
from engram.errors import InputError, MapCorruptError
from engram.fleet.centre import jobs
from engram.fleet.centre.database import first_row
from engram.fleet.centre.objects import given_by
from engram.fleet.centre.problems import (
    ConflictError,
    MalformedError,
    MissingPartsError,
    QuotaError,
)
from engram.fleet.centre.service import (
    DAY_NS,
    Centre,
    kept_since_ns,
    manifest_key,
    needed_manifests,
)
from engram.fleet.centre.tables import (
    ENDED,
    HandIn,
    JobState,
    Usage,
    artifact_grants,
    artifacts,
    handins,
    usage,
)
from engram.fleet.transfers import (
    Manifest,
    PartHash,
    WireManifest,
    decode_manifest,
    decode_page,
    encode_manifest,
    handin_id,
)
from engram.maps.schema import frames, nodes, sessions, vocabularies

_PAGED = {table.name: table for table in (sessions, nodes, frames, vocabularies)}


def begin(centre: Centre, name: str, robot: str, sent: WireManifest) -> HandIn:
    """Begins a hand-in, or finds it.

    Raises:
        InputError: the manifest is malformed, or continues one that is not known.
        QuotaError: the robot has too many open ones.
    """
    centre.map_row(name)
    base = None if sent.base is None else _known_base(centre, name, robot, sent.base)
    manifest = sent.full(base)
    row = HandIn(
        id=handin_id(name, robot, manifest.id),
        map=name,
        robot=robot,
        manifest=manifest.id,
        base=sent.base,
        content_hash=manifest.content_hash,
        state=JobState.OPEN,
        bytes=0,
        begun_ns=centre.now_ns(),
    )
    known = centre.database.row(HandIn, handins.c.id == row.id)
    if known is not None:
        return _reopened(centre, known)
    centre.objects.put(manifest_key(name, manifest.id), encode_manifest(manifest))
    with centre.database.writing() as connection:
        _check_open(centre, connection, name, robot)
        _check_base(centre, connection, name, sent.base)
        jobs.ask(centre, connection, row, robot, "hand-in")
    return jobs.get(centre, HandIn, row.id)


def _reopened(centre: Centre, row: HandIn) -> HandIn:
    """An expired one, open again, without what it continued: that may be swept by now."""
    if row.state != JobState.CANCELLED or row.cancelled:
        return row
    fresh: dict[str, Any] = {"begun_ns": centre.now_ns(), "base": None, "tries": 0, "error": None}
    return jobs.set_state(centre, row, JobState.OPEN, **fresh)


def _known_base(centre: Centre, name: str, robot: str, manifest: str) -> Manifest | None:
    """A manifest that the robot handed in to this map, or got from it; else None."""
    own = select(handins.c.manifest).where(
        handins.c.map == name,
        handins.c.robot == robot,
        handins.c.manifest == manifest,
        or_(handins.c.state == JobState.MERGED, handins.c.state == JobState.COMPLETE),
    )
    got = (
        select(artifacts.c.manifest)
        .join(artifact_grants, artifact_grants.c.artifact == artifacts.c.id)
        .where(
            artifacts.c.map == name,
            artifact_grants.c.subject == robot,
            artifacts.c.manifest == manifest,
        )
    )
    with centre.database.reading() as connection:
        if not (connection.execute(own).first() or connection.execute(got).first()):
            return None
    return decode_manifest(centre.objects.get(manifest_key(name, manifest)))


def _check_base(centre: Centre, connection: Connection, name: str, base: str | None) -> None:
    if base is not None and base not in needed_manifests(connection, name, kept_since_ns(centre)):
        raise MalformedError(f"manifest {base:.40} is no longer kept; send a whole manifest")


def _check_open(centre: Centre, connection: Connection, name: str, robot: str) -> None:
    query = select(func.count()).where(
        handins.c.map == name, handins.c.robot == robot, handins.c.state == JobState.OPEN
    )
    count = connection.execute(query).scalar_one()
    if count >= centre.settings.open_handins:
        raise QuotaError(f"{counted(count, 'hand-in')} open; complete or cancel some")


def listed(
    centre: Centre,
    name: str,
    robot: str | None = None,
    state: str | None = None,
    *,
    before_ns: int = 2**62,
    limit: int | None = None,
) -> list[HandIn]:
    """Hand-ins of a map, newest first, that began before a time."""
    where = [handins.c.map == name, handins.c.begun_ns < before_ns]
    if robot is not None:
        where.append(handins.c.robot == robot)
    if state is not None:
        where.append(handins.c.state == state)
    newest = (handins.c.begun_ns.desc(), handins.c.id)
    return centre.database.rows(HandIn, *where, order=newest, limit=limit)


def kept_by_robots(centre: Centre, name: str) -> Counter[str]:
    """How many merged hand-ins of a map each robot keeps, since no backup holds them yet."""
    late = handins.c.revision > centre.map_row(name).durable_revision
    merged = select(handins.c.robot).where(handins.c.map == name, late)
    with centre.database.reading() as connection:
        return Counter(connection.execute(merged).scalars())


def complete(centre: Centre, row: HandIn) -> HandIn:
    """Makes a hand-in a job; done twice it is the same.

    Raises:
        ConflictError: parts are missing.
    """
    if row.state != JobState.OPEN:
        return row
    missing = wanted_parts(centre, row)
    if missing:
        raise ConflictError(
            f"{counted(len(missing), 'part')} missing; ask which are wanted and send them"
        )
    others = handins.alias()
    place = select(func.coalesce(func.max(others.c.place), 0) + 1).scalar_subquery()
    return jobs.set_state(centre, row, JobState.COMPLETE, row.robot, place=place)


def merge_anyway(centre: Centre, row: HandIn, by: str) -> HandIn:
    """Makes a refused, failed or cancelled hand-in a job again, without the gate.

    Raises:
        ConflictError: it is in another state.
    """
    if row.state not in ENDED - {JobState.MERGED} or row.place is None:
        raise ConflictError(f"hand-in {row.id} is {row.state}; only a refused one is tried again")
    fresh: dict[str, Any] = {"ungated": 1, "cancelled": 0, "tries": 0, "error": None}
    return jobs.set_state(centre, row, JobState.COMPLETE, by, "merge-anyway", **fresh)


def note_try(centre: Centre, row: HandIn) -> None:
    """Counts a try, before it is made: what kills its worker is not tried for ever."""
    _change(centre, row, tries=handins.c.tries + 1)


def put_off(centre: Centre, row: HandIn, why: str) -> None:
    """Takes back a try that found no room or no free lock: it is no fault of the hand-in."""
    _change(centre, row, tries=row.tries, progress=f"waits: {why}")


def _change(centre: Centre, row: HandIn, **change: Any) -> None:
    with centre.database.writing() as connection:
        connection.execute(update(handins).where(handins.c.id == row.id).values(**change))


def expire(centre: Centre) -> None:
    """Ends hand-ins that stayed incomplete too long."""
    limit_ns = centre.now_ns() - centre.settings.handin_days * DAY_NS
    old = (handins.c.state == JobState.OPEN, handins.c.begun_ns < limit_ns)
    for row in centre.database.rows(HandIn, *old):
        jobs.set_state(centre, row, JobState.CANCELLED, error="incomplete for too long")


def manifest_of(centre: Centre, row: HandIn) -> Manifest:
    """The manifest of a hand-in."""
    return decode_manifest(centre.objects.get(manifest_key(row.map, row.manifest)))


def _base_of(centre: Centre, row: HandIn) -> Manifest:
    """The manifest that it continues; an empty one without."""
    if row.base is None:
        return Manifest("", 0, {})
    return decode_manifest(centre.objects.get(manifest_key(row.map, row.base)))


def put_parts(centre: Centre, row: HandIn, bodies: Sequence[bytes]) -> None:
    """Stores verified parts of a hand-in; those that are there already cost nothing.

    Raises:
        ConflictError: it is complete or has ended.
        InputError: it is larger than any may be.
        QuotaError: more than the robot may hand in today.
    """
    if row.state != JobState.OPEN:
        raise ConflictError(f"hand-in {row.id} is {row.state} and takes no more parts")
    size, now, limits = sum(map(len, bodies)), centre.now_ns(), centre.settings
    with centre.database.reading() as connection:
        used = _used(connection, row.robot, now)
    if used + size > limits.bytes_a_day:
        raise QuotaError(
            f"{used + size} bytes today; {limits.bytes_a_day} are granted: continue tomorrow"
        )
    if jobs.get(centre, HandIn, row.id).bytes + size > limits.handin_bytes:
        raise InputError(
            f"the hand-in is larger than {limits.handin_bytes} bytes; hand in more often"
        )
    new = centre.packs(row.map).add(bodies, now, row.robot)
    more = update(handins).where(handins.c.id == row.id).values(bytes=handins.c.bytes + new)
    with centre.database.writing(durable=False) as connection:
        connection.execute(more)
        used = _used(connection, row.robot, now) + new
        centre.database.put(connection, Usage(row.robot, now // DAY_NS, used))


def _used(connection: Connection, robot: str, now_ns: int) -> int:
    today = (usage.c.subject == robot, usage.c.day == now_ns // DAY_NS)
    row = first_row(connection, Usage, *today)
    return 0 if row is None else row.bytes


def wanted_parts(centre: Centre, row: HandIn) -> list[PartHash]:
    """Parts that the robot has yet to send: pages first, then the blobs that they name.

    Of frames only those of nodes that are new to the fleet map; it takes no others.
    """
    if row.state != JobState.OPEN:
        return []
    manifest, base = manifest_of(centre, row), set(_base_of(centre, row).hashes())
    fresh = [page for page in dict.fromkeys(manifest.hashes()) if page not in base]
    missing = _not_given(centre, row, fresh)
    if missing:
        return missing
    blobs = _blobs_needed(centre, row, manifest, set(fresh))
    return _not_given(centre, row, list(dict.fromkeys(blobs)))


# Of a row of nodes.
_SESSION = nodes.columns.keys().index("session")


def _blobs_needed(
    centre: Centre, row: HandIn, manifest: Manifest, pages: set[PartHash] | None = None
) -> list[PartHash]:
    """Blobs that merging reads.

    Args:
        centre: the centre.
        row: the hand-in.
        manifest: its manifest, or that of its base.
        pages: only blobs that these pages name; None for all.

    Raises:
        MalformedError: a page does not hold rows of its table.
    """
    packs = centre.packs(row.map)

    def rows(name: str, pages: set[PartHash] | None) -> Iterator[tuple[Any, ...]]:
        listed = manifest.pages.get(name, ())
        for _, body in packs.read([page for page in listed if pages is None or page in pages]):
            try:
                yield from decode_page(_PAGED[name], body)
            except MapCorruptError as error:
                raise MalformedError(str(error)) from error

    own = {node[1]: (node[0], node[_SESSION]) for node in rows("nodes", None)}
    drives = {drive[0]: drive[1] for drive in rows("sessions", None)}
    with centre.reading(row.map) as store:
        known = store.lookups.known([*own, *drives.values()])
    held = {
        key for uuid, (key, drive) in own.items() if known.intersection((uuid, drives.get(drive)))
    }
    found = []
    for frame in rows("frames", pages):
        if frame[0] not in held:
            found += [PartHash(blob) for blob in frame[2:4] if blob is not None]
    return found + [PartHash(vocabulary[3]) for vocabulary in rows("vocabularies", pages)]


def parts_to_merge(centre: Centre, row: HandIn, manifest: Manifest) -> dict[PartHash, bytes]:
    """Pages and blobs of a hand-in that it may use: given by its robot, or of its base.

    Raises:
        MissingPartsError: the robot has yet to send some.
    """
    base = _base_of(centre, row)
    pages, trusted = list(dict.fromkeys(manifest.hashes())), set(base.hashes())
    _check_given(centre, row, (page for page in pages if page not in trusted))
    blobs = _blobs_needed(centre, row, manifest)
    of_base = set(_blobs_needed(centre, row, base)) if base.pages else set()
    _check_given(centre, row, (blob for blob in blobs if blob not in of_base))
    return dict(centre.packs(row.map).read([*pages, *dict.fromkeys(blobs)]))


def _check_given(centre: Centre, row: HandIn, parts: Iterable[PartHash]) -> None:
    missing = _not_given(centre, row, list(parts))
    if missing:
        raise MissingPartsError(f"{counted(len(missing), 'part')} missing")


def _not_given(centre: Centre, row: HandIn, parts: list[PartHash]) -> list[PartHash]:
    with centre.database.reading() as connection:
        given = given_by(connection, row.map, row.robot, parts)
    return [part for part in parts if part not in given]
