from pathlib import Path

import numpy as np
import pytest
from tests.builders import Mapped, World, drive, map_simulated

ROAD = World(length_m=120.0, seed=11)


@pytest.fixture(scope="session")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Mapped]:
    """A map of the first 100 m of `ROAD`, to be read, and what mapping it came to."""
    path = tmp_path_factory.mktemp("maps") / "road.engram"
    return path, map_simulated(path, drive(ROAD, np.arange(0, 100, 1.0)))
