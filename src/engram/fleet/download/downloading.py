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
from engram.fleet.download.part import Part, Stock, components, write_marks
from engram.fleet.download.selections import (
    SELECTIONS,
    Selection,
    check_options,
    coverage_for,
    facts_told,
)
from engram.maps.map import Map
from engram.maps.map_files import compact_map, publish_map
from engram.monitor import QUIET, Monitor

# Bytes of a node beside its blobs: rows and indices of it, its edges and path entries. Only the
# start of the search for a budget: the file is measured. Source: lab/reports/constants.md.
_ROWS_BYTES = 2500
_PAGE_BYTES = 4096
_TRIES = 8
# A file that leaves less than this share of the budget free ends the search.
_FULL_ENOUGH = 0.99
# The share of the budget that the search aims at.
_AIM = 0.995


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
        stock = Stock(store)
        if not len(stock):
            raise InputError(f"{store.location} holds no nodes at revision {store.revision}")
        selection = SELECTIONS[options.select](stock, options)
        coverage = selection.coverage or coverage_for(stock, options)
        with draft_folder(out) as folder:
            part, why = choose_part(stock, selection, options, folder, monitor)
            _write_draft(part, options, folder, monitor)
            compact = folder / _COMPACT
            compact_map(folder / _DRAFT, compact)
            report = _report(part, why, coverage, compact, out, options)
            publish_map(compact, out)
    return report


_DRAFT, _COMPACT = "draft.engram", "compact.engram"


def choose_part(
    stock: Stock, selection: Selection, options: DownloadOptions, folder: Path, monitor: Monitor
) -> tuple[Part, Mapping[str, Any]]:
    """The part of a selection, and facts of it; for a budget, as much as fits.

    A budget writes drafts into `folder` to measure them; the last one is the returned part.
    """
    if selection.order is None:
        return _part(stock, selection, options), selection.why
    landmarks, thumbnails = stock.sizes
    blobs = landmarks + thumbnails * options.with_thumbnails
    pages = np.ceil(blobs / _PAGE_BYTES) * _PAGE_BYTES + _ROWS_BYTES
    parts: dict[int, Part] = {}

    def measure(count: int) -> int:
        parts[count] = _part(stock, _beginning(selection, count), options)
        _write_draft(parts[count], options, folder, monitor)
        return _compacted_bytes(folder)

    budget_bytes, why = options.budget_bytes, dict(selection.why)
    if options.budget_percent is not None:
        why["everything_bytes"] = everything_bytes = measure(len(selection.order))
        budget_bytes = int(everything_bytes * options.budget_percent / 100)
        if budget_bytes >= everything_bytes:
            return parts[len(selection.order)], why
    assert budget_bytes is not None
    count = most_that_fit(measure, np.cumsum(pages[selection.order]), budget_bytes)
    return parts[count], why


def _part(stock: Stock, selection: Selection, options: DownloadOptions) -> Part:
    whole = options.select == "copy"
    return Part.of(stock, selection.sent, whole=whole, thumbnails=options.with_thumbnails)


def most_that_fit(
    measure: Callable[[int], int], expected_bytes: NDArray[np.float64], budget_bytes: int
) -> int:
    """Finds how many nodes fit into a budget, by writing files and measuring them.

    The file of one node gives the fixed size: vocabulary, statistics. Sizes are then predicted from
    `expected_bytes` until a file is too large, and after that by a line from the largest file that
    fits to the smallest that does not.

    Args:
        measure: writes the file of the first n nodes and returns its size, bytes.
        expected_bytes: (N,) float64, expected bytes of the first 1, 2, … N nodes; increasing.

    Source: regula falsi, with the Illinois algorithm's halving if one end stays (Dowell and

    Jarratt, BIT 11, 1971): sizes bend where later nodes bring fewer edges.
    """
    fits, fits_bytes = 1, measure(1)
    if fits_bytes > budget_bytes:
        raise InputError(
            f"not one node fits into {budget_bytes} bytes: the map's vocabulary, statistics and "
            f"the most useful node with its session take {fits_bytes} bytes; give a larger --budget"
        )
    too_many, too_many_bytes = len(expected_bytes) + 1, 0
    aimed_bytes = _AIM * budget_bytes
    low_weight = high_weight = 1.0
    for _ in range(_TRIES):
        if fits + 1 == too_many or fits_bytes >= _FULL_ENOUGH * budget_bytes:
            break
        room = aimed_bytes - fits_bytes
        if too_many_bytes:
            below, above = room * low_weight, (too_many_bytes - aimed_bytes) * high_weight
            room = expected_bytes[too_many - 1] - expected_bytes[fits - 1]
            room *= below / (below + above)
        wanted = np.searchsorted(expected_bytes, expected_bytes[fits - 1] + room, side="right")
        count = int(np.clip(wanted, fits + 1, too_many - 1))
        size_bytes = measure(count)
        if size_bytes <= budget_bytes:
            fits, fits_bytes = count, size_bytes
            low_weight, high_weight = 1.0, high_weight / 2
        else:
            too_many, too_many_bytes = count, size_bytes
            low_weight, high_weight = low_weight / 2, 1.0
    return fits


def _beginning(selection: Selection, count: int) -> Selection:
    assert selection.order is not None
    sent = np.zeros(len(selection.sent), np.bool_)
    sent[selection.order[:count]] = True
    return replace(selection, sent=sent)


def _compacted_bytes(folder: Path) -> int:
    compact = folder / _COMPACT
    compact_map(folder / _DRAFT, compact)
    size_bytes = compact.stat().st_size
    compact.unlink()
    return size_bytes


def _write_draft(part: Part, options: DownloadOptions, folder: Path, monitor: Monitor) -> None:
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
        of_nodes=len(stock),
        sessions=info.sessions,
        partial_paths=len(part.partial_paths()),
        edges=info.edges,
        bridges=len(part.bridges),
        components=len(np.unique(components(len(stock), ends)[sent])),
        size_bytes=file.stat().st_size,
        of_bytes=stock.store.info().size_bytes,
        why=dict(why),
        expected_missed=missed,
        copy_missed=copy_missed,
        forecast=Forecast.of(
            missed, missed - copy_missed, len(stock.sessions), Light.of(stock, options)
        ),
    )
