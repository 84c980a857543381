"""Tests, in a real browser, of the documentation site that `make docs` builds."""

import subprocess
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from tests.cli import environment
from tests.paths import ROOT

pytest.importorskip("playwright.sync_api")
pytest.importorskip("material")
pytest.importorskip("mkdocstrings")
pytestmark = pytest.mark.slow

PHONE = 390  # px, width of a phone
UNLABELED = """() => [...document.querySelectorAll("img, iframe")]
  .filter((shown) => !(shown.getAttribute("alt") || shown.title)).map((shown) => shown.outerHTML)"""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory):
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
def address(site):
    """Serve the site and yield its address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=site)) as server:
        threading.Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def test_every_page_fits_a_phone_and_makes_no_requests_to_other_sites(site, opened):
    pages = sorted(file.relative_to(site).as_posix() for file in site.rglob("*.html"))
    assert len(pages) > 30 and {"index.html", "report.html"} <= set(pages)
    complaints = []
    for path in pages:
        page = opened(path, PHONE)
        width = page.evaluate("document.documentElement.scrollWidth")
        complaints += [f"{path}: {width} px wide"] * (width > PHONE)
        complaints += [f"{path}: no alt or title: {shown}" for shown in page.evaluate(UNLABELED)]
        page.close()
    assert complaints == []
