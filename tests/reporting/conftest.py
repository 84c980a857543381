"""Fixtures that open pages in a real browser, if playwright and Chromium are installed."""

from shutil import which

import pytest


@pytest.fixture(scope="session")
def chromium():
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        try:
            browser = started.chromium.launch(executable_path=which("chromium"))
        except playwright.Error as error:
            pytest.skip(f"no Chromium: {error}")
        yield browser
        browser.close()


@pytest.fixture
def opened(chromium, address):
    """Return a function that opens pages; console messages and external requests fail the test."""
    contexts = []
    complaints = []

    def open_page(path="", width=1280, **options):
        contexts.append(chromium.new_context(viewport={"width": width, "height": 800}, **options))
        page = contexts[-1].new_page()
        page.on("console", lambda message: complaints.append(f"{path}: {message.text}"))
        page.on("pageerror", lambda error: complaints.append(f"{path}: {error}"))
        page.on("request", lambda sent: complaints.append(sent.url) if others(sent.url) else None)
        page.goto(address + path)
        return page

    def others(url):
        return not url.startswith((address, "data:", "blob:"))

    yield open_page
    for context in contexts:
        context.close()
    assert complaints == []
