"""Files of the frozen formats, written by 0.2.0, read for ever as they did."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.place_blocks import BODY
from engram.maps.schema import metadata

from .data import make_street
from .data.make_street import ALL_KINDS, BLOCK, FROZEN, LOG, MAP, RECOGNISER, VOCABULARY

STORED = Path(make_street.__file__).parent
KEPT = json.loads((STORED / FROZEN).read_text())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Copies of the files: opening a map may write its write-ahead log."""
    for name in (ALL_KINDS, MAP, LOG):
        shutil.copy(STORED / name, tmp_path)
    return tmp_path


def test_the_files_have_rows_of_every_table(folder: Path) -> None:
    filled = set()
    for name in (ALL_KINDS, MAP):
        with closing(sqlite3.connect(folder / name)) as connection:
            for table in metadata.tables:
                if connection.execute(f"SELECT 1 FROM {table} LIMIT 1").fetchone():
                    filled.add(table)
    assert filled == set(metadata.tables)


@pytest.mark.parametrize("name", KEPT["maps"])
def test_every_record_of_a_map_reads_as_written(folder: Path, name: str) -> None:
    assert make_street.digests_of_map(folder / name) == KEPT["maps"][name]
    assert check_file(folder / name).problems == ()


def test_blocks_of_places_and_the_vocabulary_read_as_written(folder: Path) -> None:
    with Map.open(folder / MAP) as stored:
        assert stored.place_blocks(VOCABULARY, RECOGNISER).body(0) == BLOCK[BODY]
        assert stored.vocabulary is not None


def test_every_frame_of_a_log_reads_as_written(folder: Path) -> None:
    log = make_street.FrameLog(folder / LOG)
    assert [make_street.digest_of(one) for one in log] == KEPT["frames"]


def test_the_log_localises_in_the_map_as_it_did(folder: Path) -> None:
    for found, kept in zip(make_street.localised(folder), KEPT["localised"], strict=True):
        shown = make_street.shown(found)
        assert (shown["status"], shown["node"]) == (kept["status"], kept["node"])
        # The method may become better, the files may not mean another place: 5 mm, 0.3°.
        np.testing.assert_allclose(shown["node_from_live"], kept["node_from_live"], atol=0.005)
        assert kept["node_from_live"][2] == pytest.approx(0.8, abs=0.005)  # the truth
