"""Tests, in a real browser, of the page that ``mmwave-loc report`` writes."""

import json

import pytest

from tests.cli import succeed
from tests.paths import write_json
from tests.reporting import results
from tests.reporting.results import HOSTILE

playwright = pytest.importorskip("playwright.sync_api")
pytestmark = pytest.mark.slow
SCREEN = 844  # px, height of a phone that is 390 px wide


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """Return the address of a report with all kinds of content."""
    folder = tmp_path_factory.mktemp("report")
    names = (HOSTILE, "imm", "speed-rule", "fixed-ekf", "fixed-ukf", "random")
    content = results.comparison(names)
    files = [write_json(folder / "r.json", content)]
    again = write_json(folder / "again.json", content)
    succeed("report", *files, again, "--out", folder / "report.html")
    return (folder / "report.html").as_uri()


@pytest.mark.parametrize(("width", "scheme"), [(320, "light"), (390, "dark"), (1280, "dark")])
def test_the_page_fits_the_screen_and_its_sections_are_not_too_long(opened, width, scheme):
    page = opened(width=width, color_scheme=scheme)
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert ground == {"light": "rgb(255, 255, 255)", "dark": "rgb(17, 19, 24)"}[scheme]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    sections = page.locator("section").all()
    assert len(sections) == 3
    assert all(section.bounding_box()["height"] <= 10 * SCREEN for section in sections)


def test_keys_play_and_stop_an_episode_and_move_its_slider(opened):
    page = opened("#episodes")
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


def test_the_player_shows_the_errors_in_the_data_of_the_page(opened):
    page = opened()
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


def test_tables_are_complete_without_scripts(opened):
    page = opened(java_script_enabled=False)
    rows = page.locator(".table").first.locator("tbody tr:visible")
    assert rows.count() == 5
    page.get_by_label("Show all 6 rows").first.check()
    assert rows.count() == 6
