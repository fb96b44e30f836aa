"""What users do with a file of a stranger, and what it held."""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from engram.calibration.formats import read_calibration
from engram.calibration.toml import CalibrationFile, calibration_toml
from engram.cli.settings import read_settings
from engram.config import load_toml
from engram.errors import EngramError
from engram.fleet.centre.merge_job import write_checked
from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.merging import merge
from engram.fleet.transfers import Manifest, decode_manifest, split
from engram.graph.clock import check_zone, hour_of_day, zone_note
from engram.graph.model import Clock
from engram.maps.map import Map
from engram.maps.map_files import check_file, copy_map
from engram.places.vocabulary import decode_vocabulary
from engram.sequences.framelog.file import FLIGHT_SUFFIX
from engram.sequences.framelog.log_writer import read_decisions, read_images, read_report
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.sequence import SequenceInfo
from engram_lab.mutations.case import Case, Subject

Held = dict[str, list[tuple[Any, ...]]]

# What a map of other records cannot take: without a relocaliser, as random landmarks match nothing.
_MERGING = MergeOptions(relocaliser="none")
_FOUND = re.compile(r"make a map of content ([0-9a-f]{32})")
# Follow from other rows, or tell nothing of the map.
_DERIVED = frozenset({"words"})
# So many first and last nodes are read one by one, too, as a robot does.
_SINGLY = 100


def read(case: Case, folder: Path, *, merges: bool) -> bool:
    """Reads a changed thing in every way.

    Args:
        case: the changed thing.
        folder: for what is made of it.
        merges: whether to merge it, too, which takes longer than all else.

    Returns:
        Whether it passed the check of its kind.

    Raises:
        Exception: any but `EngramError` is a fault of Engram.
    """
    if case.subject is Subject.HANDIN:
        return _hand_in(case, folder, merges)
    assert case.path is not None
    if case.subject is Subject.TEXT:
        return _read_text(case.path)
    if case.subject is Subject.MAP:
        return _read_map(case.path, folder, merges)
    return _read_drive(case.path)


def held(path: Path) -> Held:
    """The rows of a file as SQLite shows them, by table; {} if it cannot be read.

    A copy is read: to open a file folds its log into it.
    """
    found: Held = {}
    try:
        with (
            TemporaryDirectory(dir=path.parent) as folder,
            closing(sqlite3.connect(_copy(path, folder))) as (connection),
        ):
            connection.text_factory = bytes
            names = connection.execute(
                "SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY name"
            )
            for (name,) in names.fetchall():
                table = name.decode()
                if table not in _DERIVED:
                    rows = connection.execute(f"SELECT * FROM {table} ORDER BY 1")
                    found[table] = rows.fetchall()
    except (sqlite3.Error, UnicodeDecodeError):
        return {}
    return found


def _copy(path: Path, folder: str) -> Path:
    copy = Path(folder) / path.name
    for suffix in ("", "-wal"):
        if Path(f"{path}{suffix}").exists():
            shutil.copyfile(f"{path}{suffix}", f"{copy}{suffix}")
    return copy


def _read_map(path: Path, folder: Path, merges: bool) -> bool:
    try:
        sound = check_file(path).sound
    except EngramError:
        sound = False
    with suppress(EngramError), Map.open(path) as store:
        _each(_READERS, store)
    _each((lambda _: split(path), lambda _: copy_map(path, folder / "copy.engram")), None)
    with suppress(EngramError):
        if merges:
            merge(folder / "fleet.engram", [path], _MERGING)
    with suppress(EngramError), Map.open(path, writes=True) as store:
        store.tag("seen", author="lab")
    return sound


def _each(readers: Iterable[Callable[[Any], object]], store: Any) -> None:
    """Each reader by itself: what one refuses another may read."""
    for one in readers:
        with suppress(EngramError):
            one(store)


def _frames(store: Map) -> None:
    nodes = store.load().nodes
    with suppress(EngramError):
        list(store.frames.stored(nodes))
    for node in [*nodes[:_SINGLY], *nodes[-_SINGLY:]]:
        with suppress(EngramError):
            store.frames.frame(node.id)
        with suppress(EngramError):
            store.frames.thumbnail(node.id)
        with suppress(EngramError):
            list(store.frames.stored([node]))


def _vocabulary(store: Map) -> None:
    if store.vocabulary is not None:
        decode_vocabulary(store.vocabulary)


_READERS: tuple[Callable[[Map], object], ...] = (
    lambda store: store.log(),
    lambda store: store.info(),
    lambda store: store.tags(),
    lambda store: store.content_hash(),
    lambda store: store.record_hashes(),
    lambda store: (store.graph, store.path_memory, store.attempts),
    lambda store: (store.frame, store.goals),
    lambda store: store.anchors,
    lambda store: store.removals,
    lambda store: store.statistics(),
    lambda store: store.words(bytes(16)),
    lambda store: store.omissions,
    lambda store: store.interrupted(),
    lambda store: store.blob_sizes,
    lambda store: store.diff(0, "head"),
    lambda store: [store.origin(str(one.id)) for one in store.load().nodes[:2]],
    lambda store: [hour_of_day(one, one.start_ns) for one in store.sessions.values()],
    _vocabulary,
    _frames,
)


def _read_drive(path: Path) -> bool:
    try:
        log = FrameLog(path)
        for one in log:
            assert one.frame.stamp_ns is not None
    except EngramError:
        return False
    if path.suffix == FLIGHT_SUFFIX:
        with suppress(EngramError):
            read_report(path)
            for number in read_decisions(path):
                read_images(path, number)
            return True
        return False
    return True


def _read_text(path: Path) -> bool:
    """A calibration by its suffix; settings and zones by their names."""
    try:
        if path.name == "settings.toml":
            read_settings(path, [])
        elif path.name == "zone.txt":
            zone = path.read_bytes().decode("utf-8", "surrogatepass")
            source = SequenceInfo("x", "folder", Clock.UTC, zone=zone)
            assert hour_of_day(source, 0) is None or not zone_note(source)
            check_zone(zone)
        else:
            calibration_toml(read_calibration(path))
            if path.suffix == ".toml":
                load_toml(path.read_text(), CalibrationFile)
    except EngramError:
        return False
    return True


def _hand_in(case: Case, folder: Path, merges: bool) -> bool:
    path = folder / "thin.engram"
    try:
        kept = case.manifest
        manifest = decode_manifest(kept) if isinstance(kept, bytes) else kept
        assert manifest is not None
        assert case.parts is not None
        _admit(manifest, case.parts, path)
    except EngramError:
        return False
    return _read_map(path, folder, merges)


def _admit(manifest: Manifest, parts: dict[Any, bytes], path: Path) -> None:
    """As the centre does; a stranger can name the content of what it made."""
    try:
        write_checked(manifest, parts, path)
    except EngramError as error:
        found = _FOUND.search(str(error))
        if found is None:
            raise
        named = Manifest(found[1], manifest.revision, manifest.pages)
        write_checked(named, parts, path)
