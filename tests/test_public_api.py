"""What `import engram` offers, and what it costs."""

import difflib
import re
import subprocess
import sys

from tests.public_surface import LISTING, MEMBERS, MODULES

import engram


def test_what_is_promised_is_what_the_listing_says() -> None:
    # In a process of its own: tables keep what other packages added in this one.
    told = "from tests.public_surface import surface; print(*surface(), sep='\\n')"
    ran = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    committed, found = LISTING.read_text(encoding="utf-8").splitlines(), ran.stdout.splitlines()
    changes = list(difflib.unified_diff(committed, found, "listed", "found", lineterm="", n=0))
    assert not changes, "\n".join(
        [
            *changes,
            "what goes or changes is deprecated first (CONTRIBUTING, Compatibility); then",
            "python -m tests.public_surface writes the listing again",
        ]
    )


def test_the_page_names_what_is_promised() -> None:
    page = (LISTING.parents[1] / "docs" / "python.md").read_text()
    named = set(re.findall(r"`([\w.]+)`", page))
    assert set(MODULES) <= named
    for members in MEMBERS.values():
        assert members <= named


def test_every_public_name_is_there() -> None:
    for name in engram.__all__:
        assert getattr(engram, name) is not None
    assert set(engram._HOMES) == set(engram.__all__) - {"__version__"}


def test_an_unknown_name_is_an_attribute_error() -> None:
    assert not hasattr(engram, "no_such_name")


def test_importing_engram_and_its_program_imports_nothing_heavy() -> None:
    code = (
        "import sys, engram, engram.cli.app\n"
        "heavy = {'numpy', 'cv2', 'scipy', 'sqlalchemy', 'matplotlib', 'rich'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_a_drive_that_is_not_there_costs_no_heavy_import(tmp_path) -> None:
    code = (
        "import sys\n"
        "sys.argv = ['engram', 'map', 'town.engram', 'nowhere']\n"
        "from engram.cli.app import main\n"
        "try: main()\n"
        "except SystemExit as end: status = end.code\n"
        "heavy = {'numpy', 'cv2', 'scipy', 'sqlalchemy', 'matplotlib', 'rich'}\n"
        "print(status, sorted(heavy & set(sys.modules)))"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert run.stdout.strip() == "2 []"
    assert run.stderr == "engram: nowhere: there is no such file or folder\n"
