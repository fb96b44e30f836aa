"""The pages Map and Robots of a day's centre as a browser shows them, for docs/pictures.

    engram lab fleet-day --out centre-demo
    python -m engram_lab.fleet_day.screens centre-demo docs/pictures

Needs Chromium, and the dependency group ``services`` for Playwright.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from engram.errors import ConfigError
from engram.fleet.centre.access import Role, add_person
from engram.fleet.centre.fleet import follow, move_ref, ref_of, robots_of
from engram.fleet.centre.service import Centre
from engram_lab.fleet_day.day import MAP_NAME, listening

_SIZE = {"width": 1180, "height": 650}
_OPERATOR = "operator"
# What robots try first, and what those follow that are not to try.
_CANARY, _STABLE = "canary", "stable"


def take(day: Path, out: Path) -> list[Path]:
    """Writes the pictures; returns their paths. The day's folder stays as it is.

    Raises:
        ConfigError: there is no Chromium.
    """
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "centre"
        shutil.copytree(day / "centre", copy)
        with Centre(copy) as centre:
            token = add_person(centre, _OPERATOR, MAP_NAME, Role.OPERATOR)
            _let_one_robot_try(centre)
            with listening(centre) as port, _browser() as browser:
                page = browser.new_page(base_url=f"http://127.0.0.1:{port}", viewport=_SIZE)
                page.goto("/")
                page.fill("input[name=token]", token)
                page.press("input[name=token]", "Enter")
                page.wait_for_url("**/map")
                return [draw(page, out) for draw in _PAGES.values()]


def _let_one_robot_try(centre: Centre) -> None:
    """The first robot follows `canary`, which is one revision ahead of the others' `stable`."""
    newest = ref_of(centre, MAP_NAME, "head").revision
    for ref, revision in ((_CANARY, newest), (_STABLE, newest - 1)):
        move_ref(centre, MAP_NAME, ref, revision, _OPERATOR)
    for number, robot in enumerate(robots_of(centre, MAP_NAME)):
        follow(centre, MAP_NAME, robot.robot, _STABLE if number else _CANARY, _OPERATOR)


def _map_page(page: Any, out: Path) -> Path:
    """The map with a node's card, by drives."""
    page.select_option("#colour", "drive")
    page.keyboard.press("n")
    page.locator("#card img").evaluate("image => image.decode()")
    return _written(page, out / "centre_map.jpg", type="jpeg", quality=80)


def _robots_page(page: Any, out: Path) -> Path:
    """The table of robots, without the empty space below it."""
    page.goto(f"/maps/{MAP_NAME}/fleet")
    below = page.locator("main").bounding_box()
    clip = {"x": 0, "y": 0, "width": _SIZE["width"], "height": below["y"] + below["height"]}
    return _written(page, out / "centre_robots.png", clip=clip)


def _written(page: Any, path: Path, **options: Any) -> Path:
    page.screenshot(path=path, **options)
    return path


_PAGES: Mapping[str, Callable[[Any, Path], Path]] = {"map": _map_page, "robots": _robots_page}


def chromium() -> str | None:
    """This machine's Chromium; None where it has none."""
    return shutil.which("chromium") or shutil.which("chromium-browser")


@contextmanager
def _browser() -> Iterator[Any]:
    """Chromium of this machine, driven by Playwright."""
    from playwright.sync_api import sync_playwright

    program = chromium()
    if program is None:
        raise ConfigError("no chromium on this machine: install the package chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("day", type=Path, help="folder of engram lab fleet-day")
    parser.add_argument("out", type=Path, help="folder of the pictures")
    asked = parser.parse_args()
    print("\n".join(map(str, take(asked.day, asked.out))))
