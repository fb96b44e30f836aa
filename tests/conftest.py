"""Fixtures for all tests."""

import os
from pathlib import Path

import pytest


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
