"""The documentation site in a real browser: built as `make docs` does it, served from here."""

import subprocess
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from tests.cli import environment
from tests.paths import ROOT

playwright = pytest.importorskip("playwright.sync_api")
pytest.importorskip("material")
pytest.importorskip("mkdocstrings")
pytestmark = pytest.mark.slow

PHONE = 390  # px
LACKING = """() => [...document.querySelectorAll("img, iframe")]
  .filter((one) => !(one.getAttribute("alt") || one.title)).map((one) => one.outerHTML)"""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder],
        cwd=ROOT, env=environment() | {"NO_MKDOCS_2_WARNING": "1"}, check=True,
    )  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def address(site):
    """Return the address of the site."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=site))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    thread.join()
    server.server_close()


def pages(site):
    """All of them, as addresses below the site's."""
    return sorted(file.relative_to(site).as_posix() for file in site.rglob("*.html"))


def test_every_page_opens_on_a_phone_without_complaint_or_request_to_others(site, opened):
    found, complaints = pages(site), []
    assert len(found) > 30 and {"index.html", "report.html"} <= set(found)
    for path in found:
        page = opened(path, PHONE)
        width = page.evaluate("document.documentElement.scrollWidth")
        complaints += [f"{path}: {width} px wide"] * (width > PHONE)
        complaints += [f"{path}: no alternative: {one}" for one in page.evaluate(LACKING)]
        page.close()
    assert complaints == []


def test_a_report_plays_inside_a_page(opened):
    page = opened("results/", PHONE)
    page.locator("iframe").scroll_into_view_if_needed()
    report = page.frame_locator("iframe")
    report.locator("#play").click()
    playwright.expect(report.locator("#play")).to_have_text("Pause")
    playwright.expect(report.locator("#time")).not_to_have_value("0")
