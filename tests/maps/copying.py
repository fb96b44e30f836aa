"""A whole map copied into another one in one revision."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from engram.graph.model import PathId, SessionId, path_id
from engram.maps.map import Map
from engram.maps.writer import RevisionWriter


def begin_bulk(store: Map) -> RevisionWriter:
    return store.begin_revision(author="tests", message="copy", configuration={"policy": "copy"})


def copy_into(
    writer: RevisionWriter,
    source: Map,
    partial: set[PathId] | frozenset[PathId] = frozenset(),
    only: set[SessionId] | None = None,
) -> None:
    contents = source.load()
    frontends = source.frontends
    taken = {one.id for one in contents.sessions if only is None or one.id in only}
    for one in contents.sessions:
        if one.id in taken:
            descriptor, frontend = frontends[one.id]
            writer.add_session(
                one,
                contents.cameras[one.camera],
                descriptor=descriptor,
                frontend=frontend,
                partial=path_id(one.id) in partial,
            )
    ids = {one.id for one in contents.nodes if one.session in taken}
    for stored in source.frames.stored(one for one in contents.nodes if one.id in ids):
        writer.copy_node(stored)
    for edge in contents.edges:
        if edge.a in ids and edge.b in ids:
            writer.add_edge(edge)
    for entry in contents.path_entries:
        if entry.path in {path_id(one) for one in taken}:
            writer.add_path_entry(entry)
    node_ids = [one.id for one in contents.nodes]
    for place, one in enumerate(contents.sessions):
        if one.id in taken:
            made = contents.attempts.rows(contents.attempts.session == place)
            writer.copy_attempts(one.id, made, node_ids)
    vocabulary = source.vocabulary
    if vocabulary is not None:
        writer.put_vocabulary(vocabulary)


def copy_and_die(target: str, source: str) -> None:
    with Map.open(Path(target), writes=True) as store, Map.open(Path(source)) as other:
        writer = begin_bulk(store)
        copy_into(writer, other)
        writer.checkpoint()
        os.kill(os.getpid(), signal.SIGKILL)
