"""What the documents show works as shown, in an empty folder, in the order of the page."""

from __future__ import annotations

import inspect
import io
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
import pytest
import typer
import yaml
from tests.builders import write_street

import engram
from engram import errors
from engram.cli.app import app, main
from engram.sample.drives import write_drives
from engram.sequences.opening import SEQUENCES

ROOT = Path(__file__).parent.parent
README, DOCS = ROOT / "README.md", ROOT / "docs"
PAGES = [README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(DOCS.glob("*.md"))]
# Pages whose examples run, in what folder they begin.
# Pages that start services and run for ten seconds and more: `make test-long`.
SLOW = {"afternoon", "operate", "budget", "fleet-tutorial", "trouble"}
EXAMPLES = {
    README: "drives",
    DOCS / "index.md": "nothing",
    DOCS / "first-map.md": "nothing",
    DOCS / "fleet-tutorial.md": "nothing",
    DOCS / "afternoon.md": "nothing",
    DOCS / "centre.md": "drives",
    DOCS / "robot-tutorial.md": "nothing",
    DOCS / "study.md": "nothing",
    DOCS / "data.md": "mapped",
    DOCS / "datasets.md": "nothing",
    DOCS / "bags.md": "bags",
    DOCS / "calibrations.md": "bags",
    DOCS / "doctor.md": "mapped",
    DOCS / "recorder.md": "mapped",
    DOCS / "trouble.md": "mapped",
    DOCS / "goals.md": "mapped",
    DOCS / "mend.md": "mapped",
    DOCS / "budget.md": "mapped",
    DOCS / "ranking.md": "mapped",
    DOCS / "eyes.md": "nothing",
    DOCS / "operate.md": "fleet",
    DOCS / "paper-rules.md": "fleet",
    DOCS / "live.md": "first map",
    DOCS / "commands.md": "drives",
    DOCS / "compare.md": "nothing",
    DOCS / "settings.md": "drives",
    DOCS / "python.md": "drives",
}
# Pages on drives that do not ship; the others show to the digit what comes out.
OTHER_DRIVES = {DOCS / "bags.md"}
# What cannot run here: set-up, the demo (its own tests run it), real drives with two rigs, and what
# waits for a robot.
_ELSEWHERE = (
    "make ",
    ". .venv",
    "pip ",
    "engram map hall.engram",
    "engram map colour.engram",
    "engram live town.engram",
)
# Where a centre listens unless told otherwise; another run of the tests may have that port.
_USUAL_CENTRE = "http://127.0.0.1:8440"
_FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.M | re.S)


@dataclass(frozen=True)
class Block:
    """One fenced block of a page."""

    kind: str
    text: str

    @property
    def commands(self) -> list[list[str]]:
        if self.kind not in {"", "sh", "bash"}:
            return []
        lines = [line for line in self.text.splitlines() if not line.startswith(_ELSEWHERE)]
        return [words for line in lines if (words := shlex.split(line, comments=True))]


def blocks(page: Path) -> list[Block]:
    return [Block(kind, text) for kind, text in _FENCE.findall(page.read_text())]


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Thirty pairs of a rendered street in the plain layout."""
    return write_street(tmp_path_factory.mktemp("shown") / "street", frames=30)


@pytest.fixture
def folder(drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Makes the current folder one in which a page's examples can begin."""
    monkeypatch.chdir(tmp_path)

    def begin(state: str) -> None:
        if state == "nothing":
            return
        for name in ("street", "sequences/06"):
            place = tmp_path / name
            place.parent.mkdir(exist_ok=True)
            place.symlink_to(drive)
        write_drives(Path("drives"))
        if state == "drives":
            return
        if state == "first map":
            engram.map_drive("street.engram", engram.open_drive("drives/monday"))
            return
        if state == "bags":
            _write_bags(drive, tmp_path)
            return
        engram.map_drive("street.engram", engram.open_drive("street", frames="0::2"))
        if state == "mapped":
            return
        for robot, frames, hour in (("r1", "0::2", 11), ("r2", "1::2", 17)):
            at = f"2026-03-01T{hour}:00:00Z"
            options = {"frames": frames, "robot": robot, "recorded_at": at, "longitude_deg": 0.0}
            engram.map_drive("fleet.engram", engram.open_drive("street", **options))
        for robot in ("r1", "r2"):
            shutil.copy("fleet.engram", f"{robot}.engram")
        for name, frames in (("a", "0:30:3"), ("b", "1:30:3")):
            run_words(f"engram record street {name}.framelog --robot {name} --frames {frames}")

    return begin


def _write_bags(drive: Path, folder: Path) -> None:
    """Two bags of the street, its calibration and a mask."""
    pytest.importorskip("rosbags", reason="the extra `bags` is not installed")
    from tests.sequences.bag_maker import LEFT, RIGHT, bag, rectified_infos

    for name, kind, frames in (("monday", "ros1", "0::2"), ("tuesday", "mcap", "1::2")):
        sequence = engram.open_drive(drive, frames=frames)
        with bag(folder / name, kind) as maker:
            for pair in sequence:
                stamp_ns = 10**18 + pair.stamp_ns
                for side, (topic, image) in enumerate(((LEFT, pair.left), (RIGHT, pair.right))):
                    maker.image(topic, stamp_ns, image)
                    info = topic.replace("image_raw", "camera_info")
                    maker.info(info, stamp_ns, rectified_infos(sequence.camera)[side])
                maker.odometry("/odom", stamp_ns, 8.0, 0.0)
                maker.imu("/imu/data", stamp_ns, (0.0, 0.0, 0.0))
    toml = run_words(["engram", "drive", "calibration", "monday.bag"]).stdout
    (folder / "monday.toml").write_text(toml)
    mask = np.full((sequence.camera.height, sequence.camera.width), 255, np.uint8)
    mask[-30:] = 0
    cv2.imwrite(str(folder / "mask.png"), mask)


@pytest.fixture
def served() -> Iterator[Callable[[list[str]], str]]:
    """Runs a centre on a free port, until the page ends; its address."""
    running: list[subprocess.Popen[str]] = []

    def serve(words: list[str]) -> str:
        program = [sys.executable, "-c", "from engram.cli import main; main()", *words[1:]]
        program += ["--port", "0"]
        running.append(subprocess.Popen(program, stdout=subprocess.PIPE, text=True))
        assert running[-1].stdout is not None
        told, _, address = running[-1].stdout.readline().strip().partition(" at ")
        assert told == "engram centre"
        return address

    yield serve
    for one in running:
        one.terminate()
        one.communicate()


@dataclass(frozen=True)
class Ran:
    """How a command ended, and what it printed."""

    returncode: int
    stdout: str
    stderr: str


def _first_session(path: str) -> str:
    with engram.open_map(path) as opened:
        return str(next(iter(opened.sessions)))[:8]


def run_words(words: str | list[str]) -> Ran:
    """Runs a command in this process: each page is many of them."""
    line = shlex.split(words) if isinstance(words, str) else words
    assert line[0] == "engram", line
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", line)
        try:
            main()
            status = 0
        except SystemExit as ended:
            status = int(ended.code or 0)
    return Ran(status, out.getvalue(), err.getvalue())


def pattern_of(shown: str, *, exact: bool = False) -> re.Pattern[str]:
    """What is shown, whatever its numbers unless exact; an ellipsis stands for anything."""
    if exact:
        return re.compile(".*".join(map(re.escape, shown.strip().split("…"))))
    parts = re.split(r"(\d[\d.]*|…|nodes?\b|components?\b)", shown.strip())
    wild = {"node": r"nodes?", "nodes": r"nodes?", "component": "components?"}
    return re.compile(
        "".join(
            ".*"
            if part == "…"
            else wild.get(part) or (r"[\d.]+" if part[:1].isdigit() else "") or re.escape(part)
            for part in parts
        )
    )


def test_there_are_at_least_25_examples() -> None:
    shown = [words for page in EXAMPLES for block in blocks(page) for words in block.commands]
    python = [block for page in EXAMPLES for block in blocks(page) if block.kind == "python"]
    assert len(shown) + len(python) >= 25


def test_every_page_with_examples_is_run() -> None:
    with_some = {page for page in PAGES for block in blocks(page) if block.kind in {"", "python"}}
    assert with_some - EXAMPLES.keys() <= {ROOT / "CONTRIBUTING.md"}


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.long if page.stem in SLOW else (), id=page.name)
        for page in EXAMPLES
    ],
)
def test_the_examples_of_a_page_run_in_their_order(
    folder: Callable[[str], None],
    page: Path,
    capsys: pytest.CaptureFixture[str],
    request: pytest.FixtureRequest,
) -> None:
    folder(EXAMPLES[page])
    last, centre = "", ""
    names: dict[str, object] = {"my_camera": _my_camera}
    printed = ""
    for block in blocks(page):
        if block.kind == "python":
            capsys.readouterr()
            exec(compile(block.text, page.name, "exec"), names)
            printed = capsys.readouterr().out
            found = names.get("found")
            assert found is None or found.status is not engram.LocalisationStatus.LOST
        elif block.kind == "text" and printed:
            for line in block.text.strip().splitlines():
                said = pattern_of(line, exact=page not in OTHER_DRIVES)
                assert said.search(printed), f"{page.name} shows: {line}\n{printed}"
            printed = ""
        elif block.commands:
            printed = ""
            for words in block.commands:
                if words[1] == "lab":  # minutes to hours; the laboratory's tests run its verbs
                    continue
                # A person copies the id from `engram info --sessions`.
                given = [_first_session(words[2]) if one == "SESSION" else one for one in words]
                given = [last if one == "CODE" else one for one in given]
                given = [centre if one == _USUAL_CENTRE else one for one in given]
                if words[1:3] == ["centre", "serve"]:
                    centre = request.getfixturevalue("served")(given)
                    continue
                ran = run_words(given)
                last = (ran.stdout.split() or [""])[-1]
                assert ran.returncode == 0, f"{page.name}: {shlex.join(words)}\n{ran.stderr}"
                printed += ran.stdout + ran.stderr
                if words[1] == "localise" and "--explain" not in words and "--json" not in words:
                    share = re.search(r"([\d.]+)% localised", ran.stdout)
                    assert share is not None
                    assert float(share[1]) > 50, f"{page.name}: {shlex.join(words)}\n{ran.stdout}"
    numbers = names.get("seen")
    if isinstance(numbers, engram.Localisation):
        assert numbers.localised


def _my_camera() -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Three dark images at 20 Hz, of the size that the tutorial states."""
    dark = np.zeros((370, 1226), dtype=np.uint8)
    for number in range(3):
        yield number * 50_000_000, dark, dark


def shown_commands() -> Iterator[tuple[str, list[str]]]:
    for page in PAGES:
        for block in blocks(page):
            for words in block.commands:
                if words[0] == "engram" and len(words) > 1 and not words[1].startswith("-"):
                    yield page.name, words
    services = yaml.safe_load((DOCS / "compose.yaml").read_text())["services"]
    for service in services.values():
        if "command" in service:
            yield "compose.yaml", shlex.split(service["command"])


@pytest.mark.parametrize(("page", "words"), list(shown_commands()))
def test_every_command_shown_is_a_verb_with_these_options(page: str, words: list[str]) -> None:
    verbs = typer.main.get_command(app).commands
    assert words[1] in verbs, f"{page}: engram {words[1]}"
    verb = verbs[words[1]]
    for word in words[2:]:
        if hasattr(verb, "commands"):
            assert word in verb.commands, f"{page}: {' '.join(words)}"
            verb = verb.commands[word]
    known = {
        option
        for parameter in verb.params
        for option in (*parameter.opts, *parameter.secondary_opts)
    }
    assert {word for word in words if word.startswith("--")} <= known


def test_every_link_to_a_file_leads_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_page_of_layouts_has_a_row_for_each() -> None:
    rows = re.findall(r"^\| `(\w[\w-]*)` \|", (DOCS / "data.md").read_text(), re.M)
    assert sorted(rows) == sorted(SEQUENCES)


def test_every_page_is_in_the_table_of_contents() -> None:
    index = (DOCS / "index.md").read_text()
    for page in DOCS.glob("*.md"):
        assert page.stem == "index" or f"\n{page.stem}\n" in index, page.name


def test_the_documents_stay_within_their_length() -> None:
    read = [README, *(page for page in DOCS.glob("*.md") if page.stem != "open-points")]
    # Words hold a letter or a digit: the bars and dashes that draw tables are none.
    words = [word for page in read for word in page.read_text().split() if re.search(r"\w", word)]
    assert len(words) <= 18_200


def test_the_error_tree_is_that_of_the_code() -> None:
    drawn = inspect.cleandoc(errors.__doc__ or "").split("::\n\n")[1].split("\n\n")[0]
    assert f"```text\n{textwrap.dedent(drawn)}\n```" in (DOCS / "python.md").read_text()
    found = {name for name in vars(errors) if name.endswith("Error")}
    assert found == set(re.findall(r"\w+Error", drawn))


def test_no_text_names_somebody_elses_package() -> None:
    wrong = re.compile(r"pip3? install [^\n]*\bengram(?!-localisation|-lab)(?=[\s'\"`\[=]|$)")
    kinds = {".md", ".py", ".toml", ".yaml", ".txt", ".hpp", ".cpp", ""}
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode != 0:
        pytest.skip("not a checkout")
    for name in listed.stdout.splitlines():
        path = ROOT / name
        if path.suffix in kinds and path.is_file() and path != Path(__file__):
            found = wrong.search(path.read_text(encoding="utf-8", errors="ignore"))
            assert found is None, f"{name}: {found}"


def sections_of_the_method() -> dict[str, str]:
    """Number → what stands below the heading."""
    parts = re.split(r"^## (\d+)\. .*$", (ROOT / "lab/reports/method.md").read_text(), flags=re.M)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def cited_sections(text: str) -> Iterator[tuple[str, str]]:
    """Section and item of citations such as "method §3.6, §4" and "method §2.1–2.3"."""
    for numbers in re.findall(r"method §(\d[\d.]*(?:(?:, §|–)\d[\d.]*)*)", text):
        yield from re.findall(r"(\d+)(?:\.(\d+))?", numbers)


def test_every_section_that_is_cited_is_in_the_method() -> None:
    sections = sections_of_the_method()
    assert "".join(sections) == "123456789"
    cited = [
        (path, section, item)
        for folder in ("src", "lab/src", "tests")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in {".py", ".hpp", ".cpp"} and path != Path(__file__)
        for section, item in cited_sections(path.read_text())
    ]
    assert len(cited) > 100  # the pattern still meets them
    for path, section, item in cited:
        where = f"{path.relative_to(ROOT)}: method §{section}"
        assert section in sections, where
        assert not item or re.search(rf"^{item}\. ", sections[section], re.M), f"{where}.{item}"


def test_every_package_that_the_architecture_names_is_there() -> None:
    page = (DOCS / "architecture.md").read_text()
    table = re.findall(r"^\| ((?:`\w+`(?:, )?)+)[^|]*\|", page, re.M)
    named = {name for row in table for name in re.findall(r"`(\w+)`", row)}
    assert {"robot", "cli", "fleet", "maps"} <= named
    for name in named - {"_core"}:
        assert find_spec(f"engram.{name}") is not None, name


def test_every_setting_and_verb_is_in_the_generated_references() -> None:
    sys.path.insert(0, str(DOCS))
    try:
        import generate
    finally:
        sys.path.remove(str(DOCS))
    assert "mapper.save_every_m" in generate.settings()
    assert "--recorded-at" in generate.commands()
    assert ".. autoclass:: engram.Robot" in generate.api_page("engram", {})
    assert "`node_from_omitted` (transform)" in generate.tables()


def test_pages_from_outside_keep_their_links_and_every_line() -> None:
    sys.path.insert(0, str(DOCS))
    try:
        from outside import PAGES, on_the_site
    finally:
        sys.path.remove(str(DOCS))
    report = Path("lab/reports/eyes.md")
    assert on_the_site(
        "100\n% of [it](method.md#a), [x](../../docs/how.md)", report, PAGES[report]
    ) == ("100\n\\% of [it](method.md#a), [x](../how.md)")
    page = Path("docs/eyes.md")
    assert (
        on_the_site("`lab/reports/eyes.md`", page, page)
        == "[`lab/reports/eyes.md`](reports/eyes.md)"
    )
    assert on_the_site("[it](../CHANGELOG.md)", page, page) == "[it](project/changes.md)"


@pytest.mark.skipif(find_spec("sphinx") is None, reason="needs the docs group: make docs")
def test_the_site_builds_strictly_and_fetches_nothing(tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", str(DOCS), str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    for page in tmp_path.rglob("*.html"):
        fetched = re.findall(
            r'(?:src|href)="(https?://[^"]+\.(?:js|css|woff2?))"', page.read_text()
        )
        assert fetched == [], page.name
    assert list(broken_links(tmp_path)) == []


def broken_links(site: Path) -> Iterator[str]:
    """Links of a built site to pages, files and anchors of its own that are not there."""
    texts = {page.resolve(): page.read_text() for page in site.rglob("*.html")}
    anchors = {page: set(re.findall(r'\bid="([^"]+)"', text)) for page, text in texts.items()}
    for page, text in texts.items():
        for link in set(re.findall(r'(?:href|src)="(?![a-z]+:)([^"]+)"', text)):
            path, _, anchor = unquote(link.partition("?")[0]).partition("#")
            target = (page.parent / path).resolve() if path else page
            if not target.exists() or (anchor and anchor not in anchors.get(target, {anchor})):
                yield f"{page.name}: {link}"
