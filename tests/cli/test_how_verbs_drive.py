"""Each verb that drives ranks and attempts as the settings say."""

from __future__ import annotations

import pytest

from engram.errors import ConfigError

# Verb, what it hands its robot's options to, and where they are in what it hands over.
VERBS = {
    "map": ("map m.engram DRIVE", "engram.robot.mapping.map_drive", lambda given, _: given[3]),
    "localise": (
        "localise m.engram DRIVE", "engram.cli.localising.localise_and_print",
        lambda given, _: given[3],
    ),
    "live": (
        "live m.engram --play DRIVE", "engram.live.process.LiveProcess",
        lambda given, _: given[1].robot,
    ),
    "view": ("view m.engram DRIVE", "engram.robot.starting.robot_on", lambda given, _: given[3]),
    "merge": (
        "merge c.engram m.engram", "engram.fleet.merge.merging.merge",
        lambda _, named: named["localising"],
    ),
    "build": (
        "build c.engram DRIVE --order best --validate DRIVE",
        "engram.fleet.build.building.build_map",
        lambda given, _: given[3].judge.localising,
    ),
    "dream": (
        "dream c.engram m.engram --validate DRIVE", "engram.fleet.dream.dream",
        lambda given, _: given[4].localising,
    ),
    "lab try": (
        "lab try m.engram DRIVE", "engram_lab.trial.try_downloads", lambda given, _: given[4],
    ),
}  # fmt: skip


class SeenError(ConfigError):
    """The verb came as far as driving."""


@pytest.mark.parametrize("verb", VERBS)
def test_the_settings_rank_and_attempt_unless_options_do(
    engram, monkeypatch, mapped_street, street, tmp_path, verb
):
    typed, called, asked_of = VERBS[verb]
    seen = []

    def spied(*given, **named):
        seen.append(asked_of(given, named))
        raise SeenError("far enough")

    monkeypatch.setattr(called, spied)
    monkeypatch.setattr("engram_lab.trial.check_not_sent", lambda *_: None)
    monkeypatch.setattr("engram.viewing.viewer.Viewer", lambda *_: _Nothing())
    paths = {"m.engram": mapped_street, "c.engram": tmp_path / "c.engram", "DRIVE": street}
    words = [paths.get(one, one) for one in typed.split()]
    for config in ("linegar2015", "gadd2016"):
        ran = engram(*words, "--config", config)
        assert "far enough" in ran.err
        assert (seen[-1].ranking, seen[-1].lanes, seen[-1].rounds) == ("path", 2, 1)
    engram(*words)
    assert (seen[-1].ranking, seen[-1].lanes, seen[-1].rounds) == ("recall", 2, 2)
    assert seen[-1].threads is None
    engram(*words, "--set", "drive.threads=7")
    assert seen[-1].threads == 7
    engram(*words, "--config", "linegar2015", "--set", "drive.lanes=1")
    assert (seen[-1].ranking, seen[-1].lanes, seen[-1].rounds) == ("path", 1, 1)
    engram(*words, "--set", "drive.relocaliser=none")
    assert seen[-1].relocaliser is None
    assert seen[-1].memory_bytes is None
    engram(*words, "--set", "drive.memory=1.5GiB")
    assert seen[-1].memory_bytes == 3 * 2**29
    assert "drive.memory is 'much'" in engram(*words, "--set", "drive.memory=much").err
    if verb in {"localise", "live", "map"}:
        engram(*words, "--memory", "200MB")
        assert seen[-1].memory_bytes == 200_000_000
    if verb in {"localise", "live", "lab try"}:
        engram(*words, "--config", "linegar2015", "--ranking", "distance")
        assert (seen[-1].ranking, seen[-1].lanes, seen[-1].rounds) == ("distance", 2, 1)


class _Nothing:
    """In place of a viewer."""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def test_a_copy_of_the_papers_settings_serves_every_verb_as_its_name_does(
    engram, monkeypatch, tmp_path
):
    copy = tmp_path / "mine.toml"
    copy.write_text(engram("settings", "show", "--config", "gadd2016", "--toml").out)
    seen = []

    def spied(*_, settings, **__):
        seen.append(settings)
        raise SeenError("far enough")

    monkeypatch.setattr("engram_lab.town.simulating.simulate", spied)
    for config in ("gadd2016", copy):
        assert "far enough" in engram("lab", "simulate", "hamlet", "--config", config).err
    assert seen[0] == seen[1]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("linegar2016", "linegar2016: no such settings file; linegar2015 and gadd2016 ship"),
        ("", "cannot be read as settings: Is a directory"),
        ("bytes", "cannot be read as settings: not UTF-8 text"),
        ("half", "not valid TOML"),
    ],
)
def test_a_settings_file_that_cannot_be_read_is_told_once_and_plainly(
    engram, monkeypatch, tmp_path, name, says
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bytes").write_bytes(b"\xff\xfe")
    (tmp_path / "half").write_text("[merge")
    for verb in (("settings", "show"), ("lab", "simulate", "hamlet")):
        ran = engram(*verb, "--config", name or tmp_path)
        assert ran.status == 2
        assert says in ran.err
        assert "Errno" not in ran.err
