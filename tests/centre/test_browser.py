"""The pages in a browser, over a socket: Chromium of this machine, driven by Playwright."""

from __future__ import annotations

import queue
import shutil
import threading

import pytest
import uvicorn

from engram.fleet.centre.application import create_app
from engram.fleet.centre.fleet import ref_of, robots_of
from engram.maps.map import Map
from engram.robot.anchors import anchor_map

from .conftest import NAME, drive

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture(scope="module")
def browser():
    driver = pytest.importorskip("playwright.sync_api", reason="no Playwright: make test-services")
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    with driver.sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


@pytest.fixture
def address(site, in_process):
    """Of a centre that two robots handed in to."""
    for number, name in enumerate(("r1", "r2")):
        agent = site.robot(name)
        drive(agent.live, name, 1_000 + number)
        agent.hand_in()
        site.settle()
    server = uvicorn.Server(uvicorn.Config(create_app(site.centre), port=0, log_level="warning"))
    running = threading.Thread(target=server.run)
    answers = threading.Event()
    startup = server.startup

    async def started(sockets=None) -> None:
        await startup(sockets)
        answers.set()

    server.startup = started
    running.start()
    assert answers.wait(60)
    port = server.servers[0].sockets[0].getsockname()[1]
    yield f"http://127.0.0.1:{port}"
    server.should_exit = True
    running.join()


@pytest.fixture
def page(browser, site, address):
    """An operator's, on a tablet; the browser complains of refused requests at most."""
    context = browser.new_context(base_url=address, viewport={"width": 1024, "height": 768})
    found, complaints = context.new_page(), []
    found.on("pageerror", lambda error: complaints.append(str(error)))
    found.on("console", lambda one: complaints.append(one.text))
    found.goto("/")
    found.fill("input[name=token]", site.token("operator")["Authorization"].split()[1])
    found.press("input[name=token]", "Enter")
    found.wait_for_url("**/map")
    yield found
    context.close()
    assert [one for one in complaints if not one.startswith("Failed to load resource")] == []


def test_the_map_by_keyboard_and_slider(page):
    page.get_by_text("3 of 6 nodes, in part 1 of 2").wait_for()
    page.get_by_text("How the parts lie to each other is unknown").wait_for()
    held = queue.SimpleQueue()
    page.route("**/nodes?at=*", lambda route: held.put(route, block=False))
    page.reload()
    page.get_by_text("loading…").wait_for()
    page.keyboard.press("n")  # before the nodes came, and without a click on the drawing
    held.get().continue_()
    page.wait_for_selector("#card dl")
    page.unroute("**/nodes?at=*")
    assert "revision 1" in page.inner_text("#card")
    seen = page.locator("#card img")
    assert seen.evaluate("image => image.decode().then(() => image.naturalWidth)") > 0
    page.focus("#slider")
    page.keyboard.press("ArrowLeft")
    page.get_by_text("3 nodes", exact=True).wait_for()
    page.select_option("#colour", "robot")
    assert page.inner_text("#legend li") == "r1 (3 nodes)"


def test_weak_spots_are_drawn_listed_and_zoomed_to_by_keyboard(page):
    page.get_by_text("3 of 6 nodes, in part 1 of 2").wait_for()
    drawn = "canvas.toDataURL()"
    plain, held = page.evaluate(drawn), queue.SimpleQueue()
    page.route("**/weak-spots?at=*", lambda route: held.put(route, block=False))
    page.check("#weak")
    page.get_by_text("loading…").wait_for()
    held.get().abort()
    page.get_by_text("weak spots cannot be shown").wait_for()
    assert page.evaluate(drawn) == plain
    page.unroute("**/weak-spots?at=*")
    page.uncheck("#weak")
    page.check("#weak")
    page.get_by_text("of the next drive is expected to be missed").wait_for()
    assert page.evaluate(drawn) != plain
    first = page.locator("#weak-list button").first
    assert " m missed, " in first.inner_text()
    assert page.inner_text("#weak-advice button").startswith("Drive this next: ")
    page.evaluate("view.scale /= 100")
    before = page.evaluate("view.scale")
    first.press("Enter")
    assert first.get_attribute("aria-pressed") == "true"
    assert page.evaluate("view.scale") > 2 * before
    assert page.evaluate("stretch.nodes.every((i) => shown.part[i] === part)")
    page.focus("#slider")
    page.keyboard.press("ArrowLeft")
    page.get_by_text("3 nodes", exact=True).wait_for()
    page.locator("#weak-list button").first.wait_for()
    assert page.evaluate("[weak.revision, shown.revision]") == [1, 1]
    page.uncheck("#weak")
    assert page.locator("#weak-panel").is_hidden()


def test_weak_spots_stay_those_of_the_revision_that_is_shown(page):
    """The slider moves while they are on their way: what arrives late is not drawn."""
    page.get_by_text("3 of 6 nodes").wait_for()
    held = queue.SimpleQueue()
    page.route("**/weak-spots?at=2", lambda route: held.put(route, block=False))
    page.check("#weak")
    late = held.get()
    page.focus("#slider")
    page.keyboard.press("ArrowLeft")
    page.get_by_text("3 nodes", exact=True).wait_for()
    page.get_by_text("loading…").wait_for()
    late.continue_()
    page.locator("#weak-list button").first.wait_for()
    assert page.evaluate("[weak.revision, shown.revision]") == [1, 1]


def test_parts_that_anchors_hold_are_shown_together(page, site, tmp_path):
    page.get_by_text("How the parts lie to each other is unknown").wait_for()
    path, anchors = site.centre.map_path(NAME), tmp_path / "anchors.csv"
    with Map.open(path) as store:
        nodes = [node.id for node in store.graph.nodes]
    places = [f"{node},{20 * at},{at}" for at, node in enumerate(nodes)]
    anchors.write_text("\n".join(["node,x,y", *places]))
    anchor_map(path, anchors, author="tests")
    page.reload()
    page.get_by_text("No drive joins the 2 pieces shown: anchors hold them together.").wait_for()
    page.get_by_text("6 nodes", exact=True).wait_for()
    assert page.locator("#parts").is_hidden()


def test_a_version_for_a_robot_and_a_revert_with_its_preview(page, site):
    page.goto(f"/maps/{NAME}/history")
    page.get_by_text("What changed").first.click()
    page.get_by_text("3 nodes added: 6 in the map").wait_for()
    page.fill("input[name=ref]", "canary")
    page.fill("input[name=revision]", "1")
    with page.expect_navigation():
        page.get_by_role("button", name="Move").click()
    assert ref_of(site.centre, NAME, "canary").revision == 1

    page.goto(f"/maps/{NAME}/fleet")
    field = page.get_by_label("What r2 follows")
    field.fill("canary")
    with page.expect_navigation():
        field.press("Enter")
    follows = {row.name: row.follows for row in robots_of(site.centre, NAME)}
    assert follows == {"r1": "head", "r2": "canary"}
    page.get_by_label("What r1 follows").fill("no-such-ref")
    page.get_by_label("What r1 follows").press("Enter")
    page.get_by_text("has no ref 'no-such-ref'").wait_for()

    page.goto(f"/maps/{NAME}/history")
    asked = []
    page.on("dialog", lambda one: (asked.append(one.message), one.accept()))
    with page.expect_navigation():
        page.click("[data-revert='2']")
    assert asked[0].startswith("Hide what revision 2 added: 3 nodes of r2?")
    assert "3 nodes instead of 6" in asked[0]
    with Map.open(site.centre.map_path(NAME)) as store:
        assert (store.revision, store.node_count()) == (3, 3)
