"""What other packages add is checked where it is loaded, and a broken package is named."""

from __future__ import annotations

from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from engram import plugins
from engram.cli import app as verbs
from engram.cli.app import app
from engram.errors import EngramError, IncompatibleError
from engram.frontend.features import FEATURES, feature_kind
from engram.localiser.relocalisation import relocaliser_named
from engram.places.recognisers import recogniser_named
from engram.ranking.policies import policy_named, policy_names
from engram.sequences.opening import layout_named, layout_names, open_drive


class NoRank:
    name = "one"

    def order(self, candidates, context):
        return candidates


class RankOfTwo:
    name = "one"

    def rank(self, context, candidates):
        return candidates


class OtherName:
    name = "another"

    def rank(self, context):
        return context


class NeedsMore:
    def __init__(self, file):
        raise AssertionError


SOMETHING = 3


@pytest.fixture
def added(monkeypatch: pytest.MonkeyPatch):
    """Makes packages add a name to a group: of this module, or of another one."""

    def add(group: str, *objects: str, name: str = "one") -> None:
        entries = []
        for number, named in enumerate(objects):
            value = named if ":" in named else f"{__name__}:{named}"
            entry = EntryPoint(name, value, group)
            dist = SimpleNamespace(name=f"package-{number}", version="0.1")
            vars(entry).update(dist=dist)
            entries.append(entry)
        monkeypatch.setattr(plugins, "_installed", lambda: EntryPoints(entries))

    return add


LOADS = {
    "engram.policies": ("ranking policy", policy_named),
    "engram.readers": ("reader of drives", layout_named),
    "engram.features": ("kind of features", feature_kind),
    "engram.recognisers": ("place recogniser", recogniser_named),
    "engram.verbs": ("verb", verbs._PLUGINS.load),
}


@pytest.mark.parametrize("group", LOADS)
@pytest.mark.parametrize(
    ("named", "reason"),
    [
        ("no_such_module:thing", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("Missing", f"AttributeError: module {__name__!r} has no attribute 'Missing'"),
        ("SOMETHING", "3 "),
    ],
)
def test_what_cannot_be_used_is_named_with_its_package(
    added, group: str, named: str, reason: str
) -> None:
    what, load = LOADS[group]
    added(group, named)
    with pytest.raises(IncompatibleError) as caught:
        load("one")
    text = str(caught.value)
    assert text.startswith(f"{what} 'one' of package-0 0.1 cannot be used: {reason}")
    assert text.endswith("; fix that package or uninstall it")


@pytest.mark.parametrize("group", LOADS)
def test_a_name_that_two_packages_add_is_refused(added, group: str) -> None:
    what, load = LOADS[group]
    added(group, "SOMETHING", "SOMETHING")
    with pytest.raises(
        IncompatibleError, match=f"{what} 'one' is provided by package-0 0.1 and pack"
    ):
        load("one")


@pytest.mark.parametrize(
    ("named", "reason"),
    [
        ("NoRank", r"NoRank has no method rank\(context\)"),
        ("RankOfTwo", r"RankOfTwo.rank\(context, candidates\) must take one argument, the context"),
        ("OtherName", "OtherName.name is 'another', must be 'one'"),
        ("NeedsMore", "TypeError: .*missing 1 required positional argument: 'file'"),
    ],
)
def test_a_class_that_is_no_policy_is_refused(added, named: str, reason: str) -> None:
    added("engram.policies", named)
    assert "one" in policy_names()
    with pytest.raises(IncompatibleError, match=reason):
        policy_named("one")


@pytest.mark.parametrize(
    ("find", "name", "package"),
    [
        (policy_named, "path-near", "engram-lab"),
        (feature_kind, "teblid", "engram-lab[teblid]"),
        (relocaliser_named, "bag-of-words", "engram-lab"),
    ],
)
def test_what_the_laboratory_adds_is_named_with_its_package(
    added, monkeypatch, find, name: str, package: str
) -> None:
    added("engram.verbs")
    monkeypatch.delitem(FEATURES, name, raising=False)
    with pytest.raises(EngramError) as caught:
        find(name)
    assert f"'{name}'" in str(caught.value)
    assert f", which comes with {package}; known: " in str(caught.value)


def test_names_of_engram_are_its_own(added) -> None:
    added("engram.policies", "NoRank", name="path")
    assert policy_named("path").name == "path"
    assert policy_names().count("path") == 1
    added("engram.readers", "SOMETHING", name="folder")
    assert layout_names().count("folder") == 1


def test_a_broken_reader_is_named_when_a_drive_is_recognised(added, tmp_path: Path) -> None:
    added("engram.readers", "no_such_module:thing")
    with pytest.raises(IncompatibleError, match="reader of drives 'one' of package-0"):
        open_drive(tmp_path)


def test_a_broken_verb_says_so_and_leaves_the_others_alone(added) -> None:
    added("engram.verbs", "no_such_module:thing")
    helped = CliRunner().invoke(app, ["--help"])
    assert "one         Cannot be used: its package is broken." in helped.output
    assert CliRunner().invoke(app, ["map", "--help"]).exit_code == 0
    ran = CliRunner().invoke(app, ["one", "thing", "--fast"])
    assert isinstance(ran.exception, IncompatibleError)
    assert "verb 'one' of package-0" in str(ran.exception)
