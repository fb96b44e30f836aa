"""Reading without the collector leaves it as it was found."""

import gc

import pytest

from engram.maps.map import no_collections


@pytest.mark.parametrize("was_on", [True, False])
def test_the_collector_is_left_as_found(was_on: bool) -> None:
    before = gc.isenabled()
    (gc.enable if was_on else gc.disable)()
    try:
        with no_collections():
            assert not gc.isenabled()
        assert gc.isenabled() is was_on
        with pytest.raises(ZeroDivisionError), no_collections():
            _ = 1 / 0
        assert gc.isenabled() is was_on
    finally:
        (gc.enable if before else gc.disable)()
