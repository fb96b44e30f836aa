"""How false fixes become events, and events a bound."""

import pytest

from engram_lab.checks.undisturbed import Driven, Kept, Way, events_of, figures, maps_of


def driven(drive: str, metres: float, events: int) -> Driven:
    way = Way(metres, 100, 80, 3, 2 * events, events, 1.5)
    return Driven("town", (0, 2), drive, "cold start", "brief", 11, 60, way)


@pytest.mark.parametrize(
    ("at_m", "events"),
    [((), 0), ((5.0,), 1), ((5.0, 24.0, 43.0), 1), ((5.0, 25.0), 2), ((0.0, 1.0, 90.0, 91.0), 2)],
)
def test_false_fixes_less_than_20_m_apart_are_one_event(at_m, events) -> None:
    assert events_of(at_m) == events


def test_without_an_event_the_bound_is_three_over_the_way() -> None:
    """−ln 0.05 = 2.996: the textbook's rule of three."""
    found = {one.name: one.value for one in figures([driven("a", 60e3, 0), driven("b", 40e3, 0)])}
    assert found["  distinct drives"] == 2
    assert found["  false events per 100 km"] == 0
    assert found["  their upper bound, 95 %"] == pytest.approx(2.9957, abs=1e-3)


def test_events_are_told_per_100_km() -> None:
    found = {one.name: one.value for one in figures([driven("a", 50e3, 2)])}
    assert found["  false events per 100 km"] == 4
    assert found["  their upper bound, 95 %"] == pytest.approx(12.59, abs=0.01)


def test_maps_are_of_distinct_drives_and_drawn_again_alike() -> None:
    drawn = maps_of(10, 6, 3, seed=1)
    assert drawn == maps_of(10, 6, 3, seed=1)
    assert all(len(set(one)) == 3 and list(one) == sorted(one) for one in drawn)
    assert len(set(drawn)) == len(drawn)


def test_what_was_driven_is_not_driven_again(tmp_path) -> None:
    row = driven("a", 50e3, 2)
    Kept(tmp_path / "rows.jsonl").add(row)
    assert Kept(tmp_path / "rows.jsonl").get(row.key) == row
