"""Ctrl-C where nothing is half done; files that are written whole or not at all."""

import ast
import inspect
import signal
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

import engram
from engram.monitor import QUIET, Monitor, Relay, interruptible, write_whole

PACKAGES = [Path(engram.__file__).parent]
LABORATORY = PACKAGES[0].parents[1] / "lab" / "src"


class Recording(Monitor):
    """Notes every call of every public method, in stages too."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, tuple[object, ...]]] = []

    @contextmanager
    def stage(self, what: str, total: int) -> Iterator[Monitor]:
        self.heard.append(("stage", (what, total)))
        yield self

    def advance(self, word: str = "") -> None:
        self.heard.append(("advance", (word,)))

    def hear(self, report: object) -> None:
        self.heard.append(("hear", (report,)))

    def check(self) -> None:
        self.heard.append(("check", ()))


ARGUMENTS = {"str": "word", "int": 3, "Any": {"nodes": 1}}


def calls_of_all_methods() -> list[tuple[str, tuple[object, ...]]]:
    """A call of each public method of `Monitor`, by the types of its parameters."""
    methods = inspect.getmembers(Monitor, inspect.isfunction)
    return [
        (name, tuple(ARGUMENTS[one.annotation] for one in parameters[1:]))
        for name, method in methods
        if not name.startswith("_")
        for parameters in [list(inspect.signature(method).parameters.values())]
    ]


@contextmanager
def interruptible_here(inner: Monitor) -> Iterator[Monitor]:
    with interruptible(inner) as monitor:
        yield monitor


@contextmanager
def relayed(inner: Monitor) -> Iterator[Monitor]:
    yield Relay(inner)


@contextmanager
def relayed_in_a_stage(inner: Monitor) -> Iterator[Monitor]:
    with Relay(inner).stage("work", 2) as part, part.stage("part", 1) as within:
        yield within


@pytest.mark.parametrize("wrap", [interruptible_here, relayed, relayed_in_a_stage])
@pytest.mark.parametrize(("method", "arguments"), calls_of_all_methods())
def test_whatever_is_told_to_a_wrapper_reaches_what_it_wraps(wrap, method, arguments) -> None:
    inner = Recording()
    with wrap(inner) as monitor:
        entered = getattr(monitor, method)(*arguments)
        if isinstance(entered, AbstractContextManager):
            with entered:
                pass
    assert inner.heard[-1] == (method, arguments)


def wrappers(folder: Path) -> Iterator[tuple[str, set[str]]]:
    """Monitors that are given another one, with the names of their base classes."""
    for path in folder.rglob("*.py"):
        for kind in ast.walk(ast.parse(path.read_text())):
            if not isinstance(kind, ast.ClassDef):
                continue
            bases = {ast.unparse(base) for base in kind.bases}
            begins = [
                one
                for one in kind.body
                if isinstance(one, ast.FunctionDef) and one.name == "__init__"
            ]
            given = {ast.unparse(one.annotation) for begin in begins for one in begin.args.args[1:]}
            if bases & {"Monitor", "Relay"} and "Monitor" in given:
                yield kind.name, bases


def test_no_monitor_but_the_relay_passes_reports_on_by_hand() -> None:
    folders = [*PACKAGES, *([LABORATORY] if LABORATORY.is_dir() else [])]
    found = dict(one for folder in folders for one in wrappers(folder))
    assert found.pop("Relay") == {"Monitor"}
    assert all(bases == {"Relay"} for bases in found.values()), found


def test_a_relay_stops_the_work_after_what_it_wraps_was_asked() -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    inner = Recording()
    with Relay(inner, stop).stage("work", 1) as part, pytest.raises(KeyboardInterrupt):
        part.check()
    assert inner.heard[-1] == ("check", ())


def test_a_file_gets_its_name_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    with write_whole(path) as draft:
        draft.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text("old")
    with pytest.raises(FileNotFoundError), write_whole(path):
        (tmp_path / "no folder" / "file").write_text("new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_ctrl_c_waits_for_the_next_check() -> None:
    with interruptible(QUIET) as monitor, monitor.stage("work", 3) as part:
        part.check()
        signal.raise_signal(signal.SIGINT)
        part.advance()
        with pytest.raises(KeyboardInterrupt):
            part.check()
