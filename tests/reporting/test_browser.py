"""Tests, in a real browser, of the page that ``mmwave-loc report`` writes, and of the site.

The site is the documentation that `make docs` builds. Playwright and Chromium may be missing.
"""

import json
import subprocess
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from shutil import which

import pytest

from tests.cli import environment, succeed
from tests.paths import ROOT, write_json
from tests.reporting import results
from tests.reporting.results import HOSTILE

playwright = pytest.importorskip("playwright.sync_api")
pytestmark = pytest.mark.slow
PHONE = 390  # px, width of a phone
OURS = ("file:", "http://127.0.0.1:")  # beginnings of addresses of our pages
SCREEN = 844  # px, its height


@pytest.fixture(scope="module")
def chromium():
    with playwright.sync_playwright() as started:
        try:
            browser = started.chromium.launch(executable_path=which("chromium"))
        except playwright.Error as error:
            pytest.skip(f"no Chromium: {error}")
        yield browser
        browser.close()


@pytest.fixture
def opened(chromium):
    """Return a function that opens pages; console messages and external requests fail the test."""
    contexts = []
    complaints = []

    def open_page(address, width=1280, **options):
        contexts.append(chromium.new_context(viewport={"width": width, "height": 800}, **options))
        page = contexts[-1].new_page()
        page.on("console", lambda message: complaints.append(f"{address}: {message.text}"))
        page.on("pageerror", lambda error: complaints.append(f"{address}: {error}"))
        page.on("request", lambda sent: complaints.append(sent.url) if others(sent.url) else None)
        page.goto(address)
        return page

    def others(url):
        return not url.startswith((*OURS, "data:", "blob:"))

    yield open_page
    for context in contexts:
        context.close()
    assert complaints == []


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Return the address of a report with all kinds of content."""
    folder = tmp_path_factory.mktemp("report")
    names = (HOSTILE, "imm", "speed-rule", "fixed-ekf", "fixed-ukf", "random")
    content = results.comparison(names)
    files = [write_json(folder / "r.json", content)]
    again = write_json(folder / "again.json", content)
    succeed("report", *files, again, "--out", folder / "report.html")
    return (folder / "report.html").as_uri()


@pytest.mark.parametrize(("width", "scheme"), [(320, "light"), (390, "dark"), (1280, "dark")])
def test_the_page_fits_the_screen_and_its_sections_are_not_too_long(opened, report, width, scheme):
    page = opened(report, width, color_scheme=scheme)
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert ground == {"light": "rgb(255, 255, 255)", "dark": "rgb(17, 19, 24)"}[scheme]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    sections = page.locator("section").all()
    assert len(sections) == 3
    assert all(section.bounding_box()["height"] <= 10 * SCREEN for section in sections)


def test_keys_play_and_stop_an_episode_and_move_its_slider(opened, report):
    page = opened(report + "#episodes")
    slider = page.locator("#time")
    now = page.locator("#now")
    first = now.inner_text()
    slider.focus()
    page.keyboard.press("ArrowRight")
    assert slider.input_value() == "1" and now.inner_text() != first
    page.locator("#play").focus()
    page.keyboard.press("Enter")
    playwright.expect(slider).not_to_have_value("1")  # the page's CSP forbids wait_for_function
    page.keyboard.press("Enter")
    assert page.locator("#play").inner_text() == "Play"
    stopped = slider.input_value()
    page.wait_for_timeout(300)
    assert slider.input_value() == stopped


def test_the_player_shows_the_errors_in_the_data_of_the_page(opened, report):
    page = opened(report)
    page.locator("#main").select_option(label="speed-rule")
    assert page.locator("#now").inner_text().count("error") == 1
    page.locator("#beside").select_option(label="imm")
    page.locator("#which").select_option(index=1)
    page.locator("#time").fill("12")
    sentence = page.locator("#now").inner_text()
    data = json.loads(page.locator("#data").evaluate("element => element.textContent"))
    for name in ("speed-rule", "imm"):
        error_m = data["episodes"][1]["contenders"][name]["error_m"][12]
        assert f"{error_m:g} m" in sentence.split(f"{name}: ")[1].split(";")[0]
    assert page.locator("#strips text", has_text="speed-rule: mode").is_visible()


def test_tables_are_complete_without_scripts(opened, report):
    page = opened(report, java_script_enabled=False)
    rows = page.locator(".table").first.locator("tbody tr:visible")
    assert rows.count() == 6


# --- the site

UNLABELED = """() => [...document.querySelectorAll("img, iframe")]
  .filter((shown) => !(shown.getAttribute("alt") || shown.title)).map((shown) => shown.outerHTML)"""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("material")
    pytest.importorskip("mkdocstrings")
    folder = tmp_path_factory.mktemp("site")
    words = [
        sys.executable,
        "-m",
        "properdocs",
        "build",
        "--strict",
        "--quiet",
        "--site-dir",
        folder,
    ]
    subprocess.run(words, cwd=ROOT, env=environment(), check=True)
    return folder


@pytest.fixture(scope="module")
def served(site):
    """Serve the site and yield its address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=site)) as server:
        threading.Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def test_every_page_fits_a_phone_and_makes_no_requests_to_other_sites(site, served, opened):
    pages = sorted(file.relative_to(site).as_posix() for file in site.rglob("*.html"))
    assert len(pages) > 30 and {"index.html", "report.html"} <= set(pages)
    complaints = []
    for path in pages:
        page = opened(served + path, PHONE)
        width = page.evaluate("document.documentElement.scrollWidth")
        complaints += [f"{path}: {width} px wide"] * (width > PHONE)
        complaints += [f"{path}: no alt or title: {shown}" for shown in page.evaluate(UNLABELED)]
        page.close()
    assert complaints == []
