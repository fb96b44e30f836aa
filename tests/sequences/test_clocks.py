"""The rule for stamps: what is wrong goes, the rest stays; a clock that is set stops nothing."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from engram.sequences.clocks import StampReport, SteadyClock, in_time

S = 10**9
UTC = 1_760_000_000 * S
HOUR = 3600 * S


@dataclass(frozen=True)
class Found:
    times_ns: dict[int, int]
    report: StampReport

    def lost(self, count: int) -> set[int]:
        return set(range(count)) - self.times_ns.keys()


def files(stamps_ns: list[int]) -> Found:
    clock = SteadyClock(waits=True)
    timed = list(in_time(stamps_ns, lambda one: one, clock))
    return Found({one.number: one.time_ns for one in timed}, clock.report)


def live(stamps_ns: list[int]) -> Found:
    clock, times_ns = SteadyClock(waits=False), {}
    for stamp_ns in stamps_ns:
        times_ns.update({one.number: one.time_ns for one in clock.take(stamp_ns)})
    return Found(times_ns, clock.report)


BOTH = pytest.mark.parametrize("how", [files, live])


def regular(count: int, start_ns: int = UTC, period_ns: int = S // 10) -> list[int]:
    return [start_ns + number * period_ns for number in range(count)]


def stepped(stamps_ns: list[int], at: int, by_ns: int) -> list[int]:
    return [stamp + (number >= at) * by_ns for number, stamp in enumerate(stamps_ns)]


@BOTH
@given(st.lists(st.integers(1, 10 * S), min_size=3, max_size=40))
def test_stamps_that_rise_evenly_enough_are_times_and_none_is_lost(how, intervals_ns) -> None:
    stamps_ns, now_ns = [], UTC
    for interval_ns in intervals_ns:
        now_ns += S + interval_ns % (S // 2)
        stamps_ns.append(now_ns)
    found = how(stamps_ns)
    assert list(found.times_ns.values()) == stamps_ns
    assert found.report == StampReport(len(stamps_ns))


@given(st.lists(st.integers(S // 10, 60 * S), min_size=20, max_size=40))
def test_photos_at_any_times_are_all_read_but_lone_ones_at_either_end(intervals_ns) -> None:
    stamps_ns, now_ns = [], UTC
    for interval_ns in intervals_ns:
        now_ns += interval_ns
        stamps_ns.append(now_ns)
    found = files(stamps_ns)
    assert all(found.times_ns[number] == stamps_ns[number] for number in found.times_ns)
    assert len(found.lost(len(stamps_ns))) <= 6  # three at each end


@st.composite
def wrong(draw: st.DrawFn) -> tuple[list[int], set[int]]:
    """A drive with some wrong stamps, no two closer than four frames."""
    count = draw(st.integers(12, 60))
    period_ns = draw(st.sampled_from([S // 30, S // 10, S // 4]))
    start_ns = draw(st.sampled_from([12 * S, UTC]))
    stamps_ns = regular(count, start_ns, period_ns)
    jitter = st.integers(-period_ns // 10, period_ns // 10)
    stamps_ns = [one + draw(jitter) for one in stamps_ns]
    faults = draw(st.lists(st.integers(0, count - 1), max_size=6, unique=True))
    at = [
        one
        for one, before in zip(sorted(faults), [-9, *sorted(faults)], strict=False)
        if one - before > 3
    ]
    for number in at:
        off_ns = draw(st.integers(S // 2, HOUR))
        stamps_ns[number] = draw(
            st.sampled_from([0, stamps_ns[number] + off_ns, stamps_ns[number] - off_ns])
        )
    return stamps_ns, set(at)


@BOTH
@given(wrong())
def test_wrong_stamps_go_and_no_other(how, drive: tuple[list[int], set[int]]) -> None:
    stamps_ns, at = drive
    found = how(stamps_ns)
    assert found.lost(len(stamps_ns)) <= at
    assert all(a < b for a, b in pairwise(found.times_ns.values()))
    assert found.report.left_out == len(found.lost(len(stamps_ns)))


@BOTH
@given(
    count=st.integers(20, 60),
    at=st.integers(0, 59),
    gap=st.integers(6, 50),
    by_ns=st.tuples(*[st.integers(S // 2, HOUR).flatmap(lambda n: st.sampled_from([n, -n]))] * 2),
)
@example(count=24, at=1, gap=40, by_ns=(-HOUR, HOUR))
@example(count=24, at=23, gap=40, by_ns=(-HOUR, HOUR))
@example(count=24, at=8, gap=8, by_ns=(HOUR, -HOUR))
@example(count=24, at=8, gap=8, by_ns=(-S // 2, -S // 2))
def test_a_step_costs_two_stamps_at_most(how, count, at, gap, by_ns) -> None:
    at %= count
    stamps_ns = stepped(regular(count), at, by_ns[0])
    steps = 1 if at else 0
    if at + gap < count:
        stamps_ns, steps = stepped(stamps_ns, at + gap, by_ns[1]), steps + 1
    found = how(stamps_ns)
    lost = found.lost(count)
    assert len(lost) <= 2 * steps
    assert all(a < b for a, b in pairwise(found.times_ns.values()))
    assert found.report.left_out == len(lost)
    # Ahead may be a pause.
    assert found.report.steps or lost or by_ns[0] > 0 or at == 0


@BOTH
@given(st.integers(3, 20), st.integers(S, HOUR))
def test_after_a_clock_that_was_set_back_times_count_on(how, at, by_ns) -> None:
    true_ns = regular(24)
    found = how(stepped(true_ns, at, -by_ns))
    late = [number for number in found.times_ns if number >= at + 3]
    assert all(abs(found.times_ns[number] - true_ns[number]) < S // 1000 for number in late)
    (step,) = found.report.steps
    assert step.by_ns == pytest.approx(-by_ns, abs=S // 1000)


@BOTH
def test_a_clock_set_forwards_for_good_is_believed(how) -> None:
    """As at boot, when the network tells the time: 1970, then now."""
    stamps_ns = [*regular(12, 30 * S), *regular(12)]
    found = how(stamps_ns)
    assert found.lost(24) <= {12, 13}
    assert all(found.times_ns[number] == stamps_ns[number] for number in range(14, 24))


@BOTH
def test_a_run_of_zeros_goes(how) -> None:
    stamps_ns = regular(24)
    stamps_ns[8:13] = [0] * 5
    assert how(stamps_ns).lost(24) == {8, 9, 10, 11, 12}
    assert how(stamps_ns).report.early == 5


@BOTH
def test_repeated_stamps_go(how) -> None:
    stamps_ns = [stamp for stamp in regular(12) for _ in range(2)]
    found = how(stamps_ns)
    assert sorted(found.times_ns.values()) == regular(12)
    assert (found.report.repeated, found.report.faulty) == (12, 0)


@BOTH
def test_a_clock_that_stands_still_gives_no_time(how) -> None:
    found = how([*regular(10), *[regular(10)[-1]] * 100])
    assert list(found.times_ns) == list(range(10))


def test_a_pause_is_told_from_a_step_where_a_recorder_listened() -> None:
    for pause_s, paused in ((3600, True), (0, False)):
        clock = SteadyClock(waits=True)
        stamps_ns = stepped(regular(24), 10, HOUR)
        received_ns = stepped(regular(24, 5 * S), 10, pause_s * S)
        drive = list(zip(stamps_ns, received_ns, strict=True))
        timed = list(in_time(drive, lambda one: one[0], clock, lambda one: one[1]))
        assert len(timed) == 24
        true_ns = stamps_ns if paused else regular(24)
        assert [one.time_ns for one in timed] == pytest.approx(true_ns, abs=S // 1000)


@given(st.integers(0, 23), st.integers(S, HOUR))
def test_a_stamp_and_its_time_lead_to_each_other(at, by_ns) -> None:
    stamps_ns = stepped(regular(24), max(at, 1), -by_ns)
    clock = SteadyClock(waits=True)
    for one in in_time(stamps_ns, lambda stamp_ns: stamp_ns, clock):
        assert clock.stamp_of(one.time_ns) == one.stamp_ns
        assert one.number < at or clock.time_of(one.stamp_ns) == one.time_ns
