"""How far apart on the clock matches and what they matched are, on hours that are known."""

from types import SimpleNamespace

import numpy as np
from tests.worlds import make_node, path_uuid

from engram.graph.model import PathEntry, PathEntryKind
from engram_lab.fits import hours_of_use

HOUR_NS = 3600 * 10**9


def test_hours_are_told_over_midnight_and_on_any_day():
    node = make_node(0, 0)
    hours = [0.0, 2.0, -1.0, 23.5, 24.0 * 9 + 12.0]
    kinds = [PathEntryKind.SAVED, *[PathEntryKind.MATCHED] * 3, PathEntryKind.REPLAYED]
    entries = [
        PathEntry(path_uuid(0), at, node.id, kind, node.stamp_ns + int(hour * HOUR_NS))
        for at, (hour, kind) in enumerate(zip(hours, kinds, strict=True))
    ]
    contents = SimpleNamespace(nodes=(node,), path_entries=tuple(entries))
    np.testing.assert_allclose(hours_of_use.minutes_apart(contents), [120, 60, 30, 720])
