"""What is seen of long work while it lasts."""

from __future__ import annotations

import io

from engram.cli.screen import EVERY_S, Bars


class Clock:
    """Stands still until it is moved."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


class Terminal(io.StringIO):
    """A stream that takes bars."""

    def isatty(self) -> bool:
        return True


def test_a_log_gets_a_line_now_and_then(capsys):
    clock = Clock()
    with Bars(clock).stage("map", 40) as monitor:
        for _ in range(20):
            clock.now_s += EVERY_S / 5
            monitor.advance("localised")
    assert capsys.readouterr().err.splitlines() == [
        "map: 5 of 40, 70 s left, localised",
        "map: 10 of 40, 60 s left, localised",
        "map: 15 of 40, 50 s left, localised",
        "map: 20 of 40, 40 s left, localised",
    ]


def test_short_work_leaves_a_log_alone(capsys):
    clock = Clock()
    bars = Bars(clock)
    for _ in range(3):
        with bars.stage("merge", 2) as monitor:
            clock.now_s += EVERY_S / 7
            monitor.advance()
            monitor.advance()
    assert not capsys.readouterr().err


def test_a_part_that_begins_after_a_silence_is_announced(capsys):
    clock = Clock()
    bars = Bars(clock)
    clock.now_s += EVERY_S
    with bars.stage("simulate", 6) as monitor:
        clock.now_s += EVERY_S
        monitor.advance()
    assert capsys.readouterr().err.splitlines() == [
        "simulate: 0 of 6",
        "simulate: 1 of 6",
    ]


def test_a_slow_first_item_does_not_count_in_the_time_left(capsys):
    """The first waits for what is built once: 50 s, where the others take half a second."""
    clock = Clock()
    with Bars(clock).stage("simulate", 101) as monitor:
        clock.now_s += 50.0
        monitor.advance()
        for _ in range(40):
            clock.now_s += 0.5
            monitor.advance()
    assert capsys.readouterr().err.splitlines() == [
        "simulate: 1 of 101",
        "simulate: 21 of 101, 40 s left",
        "simulate: 41 of 101, 30 s left",
    ]


def test_items_of_an_earlier_run_do_not_count_in_the_time_left(capsys):
    clock = Clock()
    with Bars(clock).stage("simulate", 100) as monitor:
        for _ in range(60):
            monitor.advance()
        for _ in range(10):
            clock.now_s += 2.0
            monitor.advance()
    assert capsys.readouterr().err.splitlines() == [
        "simulate: 65 of 100, 70 s left",
        "simulate: 70 of 100, 60 s left",
    ]


def test_the_time_left_follows_a_change_of_pace(capsys):
    clock = Clock()
    with Bars(clock).stage("map", 400) as monitor:
        for seconds in [0.5] * 100 + [2.0] * 50:
            clock.now_s += seconds
            monitor.advance()
    assert capsys.readouterr().err.splitlines()[-1] == "map: 150 of 400, 500 s left"


def test_a_terminal_gets_a_bar_and_no_lines(monkeypatch):
    stream, clock = Terminal(), Clock()
    monkeypatch.setattr("sys.stderr", stream)
    with Bars(clock).stage("map", 2) as monitor:
        clock.now_s += 2 * EVERY_S
        monitor.advance("localised")
        monitor.advance("localised")
    assert "2/2" in stream.getvalue()
    assert "2 of 2" not in stream.getvalue()
