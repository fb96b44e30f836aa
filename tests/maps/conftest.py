"""Where maps lie in tests."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def location(tmp_path: Path) -> Path:
    """A place for a map."""
    return tmp_path / "town.engram"
