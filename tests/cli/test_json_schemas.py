"""What `--json` prints is what the schemas of docs/schemas promise."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator
from tests.centre.conftest import NAME, Site, admit_here, drive
from tests.cli.json_schemas import SCHEMAS, SHARED, closed, named, problems, problems_of_line
from tests.cli.test_grammar import EVERY_VERB, command_of
from tests.maps.data.make_street import LOG
from tests.maps.test_frozen import STORED
from tests.maps.test_upgrade import OLD

from engram.cli.app import LABORATORY
from engram.fleet.centre import merge_job

WITH_JSON = [
    words
    for words in EVERY_VERB
    if words[0] not in LABORATORY
    and "--json" in [option for one in command_of(words).params for option in one.opts]
]
# Every verb at least once, in a folder of its own; those of a service and its robots are below.
RUNS = """
map town.engram STREET --robot r1 --recorded-at 2026-03-01T09:30:00Z
map town.engram STREET --robot r2
localise town.engram STREET --frames 0:6
localise town.engram STREET --explain 3
doctor STREET
record STREET street.framelog --frames 1::2 --robot r5
record STREET a.framelog --frames 0::3 --recorded-at 2026-03-05T12:00:00Z
record STREET b.framelog --frames 1::3 --recorded-at 2026-03-06T12:00:00Z
record STREET c.framelog --frames 2::3 --recorded-at 2026-03-02T12:00:00Z
evaluate result.json --truth truth.tum
report town.engram
weak-spots town.engram
info town.engram --sessions --nodes
check town.engram
check town.engram --seal
check town.engram --geometry
amend town.engram SESSION --robot r3
upgrade old.engram
vocabulary show town.engram
anchor town.engram anchors.csv
goal add town.engram dock --x 1 --y 0
goal list town.engram
export town.engram town.csv
goal remove town.engram dock
log town.engram
show town.engram 1
show town.engram NODE
diff town.engram 1 2
tag town.engram winter 1
tag town.engram
tag town.engram winter --delete
revert town.engram 2 --dry-run
merge fleet.engram town.engram --keep
build built.engram STREET street.framelog --order best --validate a.framelog
download fleet.engram out.engram
download fleet.engram part.engram --select budget --budget 300kB
download fleet.engram out.engram --update
dream fleet.engram --validate a.framelog --validate b.framelog --validate c.framelog
forget fleet.engram --session SESSION --yes
forget fleet.engram --erase --yes
settings show
features list
features check brief
drive info STREET
drive calibration STREET --picture rows.png
"""


def words_of(line: list[str]) -> tuple[str, ...]:
    """The verb that a command line begins with."""
    return next(words for words in EVERY_VERB if tuple(line[: len(words)]) == words)


def test_every_verb_with_json_has_a_schema_and_none_is_left_over() -> None:
    written = {path.name for path in SCHEMAS.glob("*.json")} - {SHARED}
    assert {named(words) for words in WITH_JSON} == written


@pytest.mark.parametrize("path", sorted(SCHEMAS.glob("*.json")), ids=lambda path: path.stem)
def test_a_schema_is_one_and_says_what_it_is(path: Path) -> None:
    schema = json.loads(path.read_text())
    Draft202012Validator.check_schema(schema)
    assert schema["$schema"] == Draft202012Validator.META_SCHEMA["$id"]
    assert schema["$id"] == path.name
    assert schema["title"]


def test_every_run_of_a_verb_in_these_tests_is_validated(engram, tmp_path) -> None:
    refused = engram("info", tmp_path / "none.engram", "--json")
    assert refused.json["error"]["kind"] == "NotAMapError"
    wrong = json.dumps({"file": "town.csv"})
    assert problems_of_line(["export", "town.engram", "town.csv", "--json"], wrong) != []


def test_a_key_that_is_new_missing_or_of_another_type_is_noticed() -> None:
    found = {"file": "town.csv", "nodes": 3, "goals": 0}
    assert problems("export.json", found) == []
    for wrong in ({**found, "bytes": 1}, {"file": "town.csv", "nodes": 3}, {**found, "nodes": "3"}):
        assert problems("export.json", wrong) != []
    assert closed({"type": "object"}) == {"type": "object"}


def test_every_output_fits_its_schema(engram, street, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(OLD, "old.engram")
    wanted = {"STREET": str(street)}
    seen = set()
    for line in RUNS.strip().splitlines():
        words = [wanted.get(word, word) for word in line.split()]
        ran = engram(*words, "--json")  # which validates what it prints
        assert ran.status == 0, f"{line}: {ran.err}"
        verb = words_of(words)
        seen.add(verb)
        if verb == ("localise",) and "frames" in ran.json:
            _write_truth(ran.json)
        if verb == ("info",):
            wanted["SESSION"] = ran.json["session_list"][0]["session"][:8]
            first, *_, last = ran.json["node_list"]
            wanted["NODE"] = first["node"][:8]
            known = f"node,x,y\n{first['node']},0,0\n{last['node']},8,0\n"
            Path("anchors.csv").write_text(known)
    of_service = {words for words in WITH_JSON if words[0] in {"agent", "centre"}}
    assert seen == set(WITH_JSON) - of_service


def _write_truth(result: dict) -> None:
    """A result of `localise`, and its own poses as the truth."""
    Path("result.json").write_text(json.dumps(result))
    lines = []
    for one in result["frames"]:
        if one["map_from_live"] is not None:
            at = [one["map_from_live"][4 * row + 3] for row in range(3)]
            lines.append(" ".join(map(str, (one["stamp_ns"] / 1e9, *at, 0, 0, 0, 1))))
    Path("truth.tum").write_text("\n".join(lines) + "\n")


def copy_of_log(folder: Path, name: str) -> Path:
    """A drive that a gate may have."""
    return Path(shutil.copy(STORED / LOG, folder / f"{name}.framelog"))


def test_outputs_of_a_service_and_its_robots_fit_their_schemas(
    engram, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(merge_job, "admit", admit_here)
    site = Site(tmp_path)
    robot = site.robot("r1")
    drive(robot.live, "r1", 1_000)
    robot.hand_in()
    site.settle()
    site.close()
    gate = [word for name in "abc" for word in ("--gate", copy_of_log(tmp_path, name))]
    assert engram("centre", "map", tmp_path / "centre", NAME, *gate).status == 0
    for verb in ("dream", "jobs"):
        assert engram("centre", verb, tmp_path / "centre", "--json").status == 0
    assert engram("agent", "status", tmp_path / "r1", "--json").status == 0
    unreachable = engram("agent", "sync", tmp_path / "r1", "--json")
    assert unreachable.json["outbox"]
    assert unreachable.json["error"]
