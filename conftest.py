"""Fixtures for all tests."""

import gc
import os
import signal
from collections.abc import Iterator
from pathlib import Path

# Tests run side by side, one process a core: the threads of BLAS would wait for each other, which
# they do by spinning. Set before NumPy is loaded, and inherited by all processes that tests start.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hypothesis
import pytest
from tests.builders import TOWN, TOWN_ROAD, drive, map_simulated, write_street

from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive

# A busy machine is no failure: no test has a time limit.
hypothesis.settings.register_profile("engram", deadline=None, print_blob=True, max_examples=30)
# `make test-long` tries ten times as many.
hypothesis.settings.register_profile(
    "thorough", hypothesis.settings.get_profile("engram"), max_examples=300
)
hypothesis.settings.load_profile("engram")


def pytest_collection_finish() -> None:
    """What imports made stays to the end: the collector need not look at it again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def ctrl_c_raises() -> Iterator[None]:
    """Ctrl-C means the same wherever the tests run: a shell's background jobs ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real images that ENGRAM_DATA names; the test is skipped where there are none.

    Tests that use it carry the marker `data`.
    """
    named = os.environ.get("ENGRAM_DATA")
    if not named:
        pytest.skip("ENGRAM_DATA names no folder of real images")
    folder = Path(named)
    if not folder.is_dir():
        pytest.skip(f"ENGRAM_DATA names {folder}, which is no folder")
    return folder


@pytest.fixture(scope="session")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve pairs of a rendered street in the plain layout."""
    return write_street(tmp_path_factory.mktemp("drives") / "street", frames=12)


@pytest.fixture(scope="session")
def mapped_street(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of the street, to be read; a test that writes copies it."""
    path = tmp_path_factory.mktemp("maps") / "town.engram"
    map_drive(path, open_drive(street), Settings(), RobotOptions())
    return path


@pytest.fixture(scope="session")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of `TOWN`, driven once along `TOWN_ROAD`; to be read."""
    path = tmp_path_factory.mktemp("town") / "town.engram"
    map_simulated(path, drive(TOWN, TOWN_ROAD))
    return path
