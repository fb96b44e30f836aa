"""DOWNLOAD: a small map for one robot and one mission, complete in itself (method §7, [G16] §V-B).

The same revision of the same fleet map and the same options give the same bytes: the order of
records depends only on their content, the revision carries the time of the fleet map's newest one
and no host, and the file is compacted at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.config import plain, to_dict
from engram.counts import counted
from engram.errors import InputError
from engram.files import check_parent, draft_folder
from engram.fleet.download.coverage import Coverage, Forecast, Light, expected_missed
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.part import Part, Stock, write_marks
from engram.fleet.download.selections import (
    SELECTIONS,
    Selection,
    check_options,
    coverage_for,
    facts_told,
)
from engram.graph.graph import labels_of
from engram.maps.map import Map
from engram.maps.map_files import compact_map, publish_map
from engram.monitor import QUIET, Monitor

# What a file takes, with indices: without a node; of a node besides its blobs; of each record about
# it. Source: pages by table of two downloads and of a city; the file is measured anyway.
_EMPTY_BYTES, _NODE_BYTES = 200_000, 700
_EDGE_BYTES, _ENTRY_BYTES, _ATTEMPT_BYTES = 355, 68, 22
# Bytes of a node's words, by those of its landmarks.
_WORDS_SHARE = 0.06
# A file that fills this share of the budget ends the search.
_FULL_ENOUGH = 0.96
# The share of the budget that the search aims at.
_AIM = 0.985
_EVERYTHING = 100.0  # per cent


@dataclass(frozen=True, slots=True, eq=False)
class DownloadReport:
    """What was sent, and its forecast.

    Attributes:
        select: key of `SELECTIONS`.
        nodes, of_nodes: sent, and all.
        sessions, partial_paths: sent; paths of which entries were left out.
        edges, bridges: sent; how many of them were composed.
        components: connected components; as many as the same nodes have in the fleet map.
        size_bytes, of_bytes: of the file, and of the fleet map's.
        expected_missed, copy_missed: expected share of the mission's route without a match,
            with the nodes sent and with all nodes.
        forecast: interval of the first, by missions in other towns.
    """

    out: Path
    select: str
    revision: int
    source_hash: str
    content_hash: str
    nodes: int
    of_nodes: int
    sessions: int
    partial_paths: int
    edges: int
    bridges: int
    components: int
    size_bytes: int
    of_bytes: int
    why: dict[str, Any]
    expected_missed: float
    copy_missed: float
    forecast: Forecast

    def to_dict(self) -> dict[str, Any]:
        """What ``download --json`` prints."""
        values: dict[str, Any] = plain(self)
        return values

    def text(self) -> str:
        """The report as text."""
        share = self.nodes / self.of_nodes if self.of_nodes else 1.0
        lines = [
            f"{self.select}: {self.nodes} of {counted(self.of_nodes, 'node')} ({share:.1%}), "
            f"{self.size_bytes / 1e6:.1f} of {self.of_bytes / 1e6:.1f} MB, "
            f"of revision {self.revision}",
            f"{counted(self.sessions, 'session')}, {counted(self.edges, 'edge')} "
            f"({counted(self.bridges, 'bridge')}), {counted(self.components, 'component')}, "
            f"{counted(self.partial_paths, 'partial path')}",
            self.forecast.text(),
        ]
        if self.nodes < self.of_nodes:
            lost = self.expected_missed - self.copy_missed
            lines.append(
                f"estimated cost of the nodes left out, for comparing downloads: {lost:.1%} of the "
                "route"
            )
        lines += facts_told(self.why)
        if everything_bytes := self.why.get("everything_bytes"):
            lines.append(
                f"{self.size_bytes / everything_bytes:.1%} of a full download in the same form "
                f"({everything_bytes / 1e6:.1f} MB)"
            )
        return "\n".join(lines)


def download(
    centre: Path | str,
    out: Path,
    options: DownloadOptions,
    *,
    at: int | str | None = None,
    monitor: Monitor = QUIET,
) -> DownloadReport:
    """Writes a part of a fleet map as a map of its own.

    Args:
        centre: the fleet map, or its address.
        out: NAME.engram, which must not be there yet.
        options: which part.
        at: revision of the fleet map; None for the newest.
        monitor: receives progress per written node.

    Raises:
        ConfigError: an option is missing, out of range, or not used by the selection.
        InputError: no node fits the options, or `out` exists.
        MapError: the fleet map cannot be read, or `out` cannot be written.

    After any error `out` does not exist: the file is renamed to it last.
    """
    check_options(options)
    if out.exists() or out.is_symlink():
        raise InputError(f"{out} exists already; choose another name")
    check_parent(out)
    with Map.open(centre, at=at) as store:
        stock = stocked(store, options)
        selection = SELECTIONS[options.select](stock, options)
        coverage = selection.coverage or coverage_for(stock, options)
        with draft_folder(out) as folder:
            part, why = choose_part(stock, selection, options, folder, monitor)
            compact = folder / _COMPACT
            if selection.order is None:
                written(part, options, folder, monitor)
            report = _report(part, why, coverage, compact, out, options)
            publish_map(compact, out)
    return report


_DRAFT, _COMPACT = "draft.engram", "compact.engram"


def choose_part(
    stock: Stock, selection: Selection, options: DownloadOptions, folder: Path, monitor: Monitor
) -> tuple[Part, Mapping[str, Any]]:
    """The part of a selection, and facts of it; for a budget, as much as fits.

    A budget leaves the file of the part in `folder`, as `written` does.
    """
    if selection.order is None:
        return _part(stock, selection, options), selection.why
    expected_bytes = _expected_bytes(stock, selection.order, options)
    why, budget_bytes = dict(selection.why), options.budget_bytes
    parts: dict[int, Part] = {}

    def measure(count: int) -> int:
        parts[count] = _part(stock, _beginning(selection, count), options)
        return written(parts[count], options, folder, monitor).stat().st_size

    if options.budget_percent == _EVERYTHING:
        why["everything_bytes"] = measure(len(stock))
        return parts[len(stock)], why
    if options.budget_percent is not None:
        why["everything_bytes"] = everything_bytes = int(expected_bytes[-1])
        budget_bytes = int(everything_bytes * options.budget_percent / 100)
    assert budget_bytes is not None
    return parts[most_that_fit(measure, expected_bytes, budget_bytes)], why


def _part(stock: Stock, selection: Selection, options: DownloadOptions) -> Part:
    whole = options.select == "copy"
    return Part.of(stock, selection.sent, whole=whole, thumbnails=options.with_thumbnails)


def _expected_bytes(
    stock: Stock, order: NDArray[np.int64], options: DownloadOptions
) -> NDArray[np.float64]:
    """(N,) float64: estimated size of the file of the first 1, 2, … N nodes of an order, bytes."""
    landmarks, thumbnails = stock.sizes
    nodes = _NODE_BYTES + (1 + _WORDS_SHARE) * landmarks + thumbnails * options.with_thumbnails
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    made = stock.attempts
    # A record goes along with the last of its nodes.
    rows = (
        (_EDGE_BYTES, place[stock.graph.edge_ends].max(axis=1)),
        (_ENTRY_BYTES, place[np.concatenate([order[:0], *stock.on_path.values()])]),
        (_ATTEMPT_BYTES, np.maximum(place[made.reference], place[made.node])),
    )
    about = sum(each * np.bincount(at, minlength=len(order)) for each, at in rows)
    fixed_bytes = _EMPTY_BYTES + len(stock.store.vocabulary or b"")
    return np.asarray(fixed_bytes + np.cumsum(nodes[order] + about), np.float64)


def most_that_fit(
    measure: Callable[[int], int], expected_bytes: NDArray[np.float64], budget_bytes: int
) -> int:
    """Finds how many nodes fit into a budget, by writing a file and measuring it.

    The first file has as many as are expected to fit. If it is too large, or leaves much free, a
    second one corrects the expectation by it; only where that is too large, too, come smaller ones.

    Args:
        measure: writes the file of the first n nodes and returns its size, bytes; the last file
            written is the one of the result.
        expected_bytes: (N,) float64, expected size of the file of the first 1, 2, … N nodes,
            bytes; increasing.

    Raises:
        InputError: not one node fits.
    """
    aimed_bytes = _AIM * budget_bytes
    count = _fitting(expected_bytes, aimed_bytes)
    size_bytes = measure(count)
    if size_bytes <= budget_bytes and (
        count == len(expected_bytes) or size_bytes >= _FULL_ENOUGH * budget_bytes
    ):
        return count
    while True:
        scaled = expected_bytes * (size_bytes / expected_bytes[count - 1])
        again = _fitting(scaled, aimed_bytes)
        if size_bytes > budget_bytes:
            if count == 1:
                raise InputError(
                    f"not one node fits into {budget_bytes} bytes: the map's vocabulary, "
                    f"statistics and the most useful node with its session take {size_bytes} "
                    "bytes; give a larger --budget"
                )
            again = min(again, count - 1)
        elif again <= count:
            return count
        count, size_bytes = again, measure(again)
        if size_bytes <= budget_bytes:
            return count


def _fitting(expected_bytes: NDArray[np.float64], budget_bytes: float) -> int:
    """How many nodes are expected to fit; at least one."""
    return max(int(np.searchsorted(expected_bytes, budget_bytes, side="right")), 1)


def _beginning(selection: Selection, count: int) -> Selection:
    assert selection.order is not None
    sent = np.zeros(len(selection.sent), np.bool_)
    sent[selection.order[:count]] = True
    return replace(selection, sent=sent)


def written(part: Part, options: DownloadOptions, folder: Path, monitor: Monitor) -> Path:
    """Writes a part as a map file of a folder of its own, in place of an earlier one."""
    for old in folder.iterdir():
        old.unlink()
    stock = part.stock
    with (
        Map.create(folder / _DRAFT) as draft,
        monitor.stage("download", len(part)) as stage,
        draft.begin_revision(
            **revision_of(stock, options), at_ns=stock.store.log()[-1].committed_ns
        ) as writer,
    ):
        part.write(writer, stage)
        write_marks(writer, part)
        writer.commit()
        if stock.words is not None:
            stock.words.give(draft, part.node_ids)
    compact_map(folder / _DRAFT, compact := folder / _COMPACT)
    return compact


def stocked(store: Map, options: DownloadOptions) -> Stock:
    """The fleet map around a mission.

    Raises:
        InputError: it has no nodes, or not those that the mission names.
    """
    if not store.node_count():
        raise InputError(f"{store.location} holds no nodes at revision {store.revision}")
    return Stock(store, options)


def revision_of(stock: Stock, options: DownloadOptions) -> dict[str, Any]:
    """Author, message and configuration of a download's revision."""
    newest = stock.store.log()[-1]
    return {
        "author": "centre",
        "message": f"download {options.select} of revision {newest.number}",
        "configuration": {
            "download": {
                **to_dict(options),
                "source": stock.content_hash,
                "revision": newest.number,
            }
        },
    }


def _report(
    part: Part,
    why: Mapping[str, Any],
    coverage: Coverage,
    file: Path,
    out: Path,
    options: DownloadOptions,
) -> DownloadReport:
    stock, sent = part.stock, part.sent
    missed = expected_missed(coverage, sent)
    copy_missed = expected_missed(coverage, stock.everything())
    with Map.open(file) as written:
        info = written.info()
        content_hash = written.content_hash()
    ends = np.array(
        [(stock.index[edge.a], stock.index[edge.b]) for edge in part.edges()], np.int64
    ).reshape(-1, 2)
    return DownloadReport(
        out=out,
        select=options.select,
        revision=stock.store.revision,
        source_hash=stock.content_hash,
        content_hash=content_hash,
        nodes=info.nodes,
        of_nodes=stock.store.node_count(),
        sessions=info.sessions,
        partial_paths=len(part.partial_paths()),
        edges=info.edges,
        bridges=len(part.bridges),
        components=len(np.unique(labels_of(ends, len(stock))[sent])),
        size_bytes=file.stat().st_size,
        of_bytes=stock.store.info().size_bytes,
        why=dict(why),
        expected_missed=missed,
        copy_missed=copy_missed,
        forecast=Forecast.of(
            missed, missed - copy_missed, len(stock.store.sessions), Light.of(stock, options)
        ),
    )
