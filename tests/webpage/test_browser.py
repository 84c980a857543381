"""The page of a report in a real browser, where playwright and its Chromium are installed."""

import json

import pytest

from tests.cli import succeed
from tests.paths import ROOT
from tests.webpage import results
from tests.webpage.results import HOSTILE, write

playwright = pytest.importorskip("playwright.sync_api")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def content():
    return results.comparison((HOSTILE, "imm", "speed-rule"))


@pytest.fixture(scope="module")
def address(tmp_path_factory, content):
    """Of a page with everything on it."""
    folder = tmp_path_factory.mktemp("report")
    files = [
        write(folder / "r.json", content),
        write(folder / "t.json", results.track()),
        write(folder / "x.json", results.transfer()),
        write(folder / "l.json", results.learned()),
        ROOT / "docs" / "leaderboard",
        results.run(folder / "run", over=False),
    ]
    succeed("report", *files, "--out", folder / "report.html")
    return (folder / "report.html").as_uri()


@pytest.fixture
def opened(chromium, address):
    """How to open the page; at the end nothing may have gone wrong or been asked for."""
    complaints, contexts = [], []

    def open_page(width=1280, section="", **options):
        contexts.append(chromium.new_context(viewport={"width": width, "height": 800}, **options))
        page = contexts[-1].new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on(
            "request",
            lambda one: (
                complaints.append(one.url) if one.url.partition("#")[0] != address else None
            ),
        )
        page.goto(address + section)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert [one for one in complaints if not one.startswith("data:")] == []


def tab(page, name):
    page.get_by_role("tab", name=name).click()
    return page.get_by_role("tabpanel", name=name)


def test_tabs_show_one_section_each_and_are_reached_by_keys(opened):
    page = opened()
    names = page.get_by_role("tab").all_inner_texts()
    assert names == ["Results", "Errors", "Episodes", "Tracks", "Benchmark", "Learning", "Transfer",
                     "Studies", "How it was made"]  # fmt: skip
    for name in names:
        tab(page, name)
        assert page.get_by_role("tabpanel").count() == 1
    page.keyboard.press("Home")
    assert page.get_by_role("tabpanel", name="Results").is_visible()
    page.keyboard.press("ArrowRight")
    assert page.get_by_role("tabpanel", name="Errors").is_visible()
    assert page.evaluate("document.activeElement.textContent") == "Errors"


def test_an_address_may_name_a_section(opened):
    page = opened(section="#benchmark")
    assert page.get_by_role("tabpanel", name="Benchmark").is_visible()
    assert page.get_by_role("tabpanel").count() == 1


def test_everything_is_reached_by_the_tab_key_and_chosen_by_keys(opened):
    page = opened(section="#episodes")
    page.keyboard.press("Tab")
    reached = []
    while (now := page.evaluate("document.activeElement.id")) and now not in reached:
        reached.append(now)
        page.keyboard.press("Tab")
    assert reached == [
        "theme",
        "tab-episodes",
        "panel-episodes",
        "which",
        "main",
        "beside",
        "play",
        "time",
    ]
    page.locator("#main").focus()
    before = page.locator("#now").inner_text()
    page.keyboard.press("ArrowDown")
    playwright.expect(page.locator("#now")).not_to_have_text(before)
    page.locator("#theme").focus()
    page.keyboard.press("Enter")
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"


# Contrast of two colors as WCAG 2.2 has it.
CONTRAST = """() => {
  const light = (color) => {
    const [r, g, b] = color.match(/[\\d.]+/g).slice(0, 3).map((v) => v / 255)
      .map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = (one) => {
    for (let at = one; at; at = at.parentElement) {
      const found = getComputedStyle(at).backgroundColor;
      if (found !== "rgba(0, 0, 0, 0)") return light(found);
    }
    return 1;
  };
  const texts = "h1, h2, h3, p, button, th, td, caption, label, select, code, .key span";
  return [...document.querySelectorAll(texts)]
    .filter((one) => one.checkVisibility() && one.textContent.trim())
    .map((one) => {
      const [a, b] = [light(getComputedStyle(one).color), ground(one)].sort((x, y) => y - x);
      return [(a + 0.05) / (b + 0.05), one.textContent.slice(0, 40)];
    })
    .filter(([contrast]) => contrast < 4.5);
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_text_stands_out(opened, scheme):
    page = opened(color_scheme=scheme)
    for name in page.get_by_role("tab").all_inner_texts():
        tab(page, name)
        assert page.evaluate(CONTRAST) == [], name


def test_the_figures_shown_are_those_of_the_file(opened, content):
    page = opened()
    rows = page.locator("table", has_text="Means").first.locator("tbody tr").all()
    for row, figures in zip(rows, content["policies"].values(), strict=True):
        shown = [float(one.get_attribute("data-value")) for one in row.locator("td").all()]
        assert shown == [figure["mean"] for figure in figures.values()]
    alternative = page.locator("#panel-results svg[role=img]").first.get_attribute("aria-label")
    assert "-1 (-1.1 to -0.9)" in alternative


def test_an_episode_plays_stops_and_is_moved_by_keys(opened):
    page = opened()
    tab(page, "Episodes")
    slider, now = page.locator("#time"), page.locator("#now")
    first = now.inner_text()
    slider.focus()
    page.keyboard.press("ArrowRight")
    assert slider.input_value() == "1" and now.inner_text() != first
    page.locator("#play").focus()
    page.keyboard.press("Enter")
    playwright.expect(slider).not_to_have_value("1")  # as the page's policy lets no one else poll
    page.keyboard.press("Enter")
    assert page.locator("#play").inner_text() == "Play"
    stopped = slider.input_value()
    page.wait_for_timeout(300)
    assert slider.input_value() == stopped


def test_contenders_and_episodes_are_chosen(opened):
    page = opened()
    tab(page, "Episodes")
    page.locator("#main").select_option(label="speed-rule")
    assert page.locator("#now").inner_text().count("error") == 1
    page.locator("#beside").select_option(label="nobody")
    assert "imm:" not in page.locator("#now").inner_text()
    page.locator("#beside").select_option(label="imm")
    said = page.locator("#now").inner_text()
    assert "speed-rule:" in said and "imm:" in said
    before = page.locator("#strips").inner_html()
    page.locator("#which").select_option(index=int(page.locator("#which").input_value() == "0"))
    assert page.locator("#strips").inner_html() != before


def test_the_browser_shows_the_numbers_of_the_data(opened):
    page = opened()
    tab(page, "Episodes")
    page.locator("#time").fill("12")
    data = json.loads(page.locator("#data").evaluate("one => one.textContent"))
    main = page.locator("#main option:checked").inner_text()
    course = data["episodes"][int(page.locator("#which").input_value())]["contenders"][main]
    assert f"error {course['error_m'][12]:g} m" in page.locator("#now").inner_text()


def test_lines_can_be_left_out(opened):
    page = opened()
    panel = tab(page, "Errors")
    lines = panel.locator("svg[role=img]").first.locator("g path")
    count = lines.count()
    panel.locator(".legend button").first.click()
    assert lines.count() == count - 1


def test_errors_and_levels_are_chosen_and_say_their_regions(opened):
    panel = tab(opened(), "Errors")
    title = "Errors and protection levels"
    choose = panel.get_by_role("combobox", name=title).first
    shown = panel.locator(f'svg[aria-label^="{title}"]').first
    seen = set()
    for name in choose.locator("option").all_inner_texts():
        choose.select_option(name)
        words = shown.get_attribute("aria-label")
        assert name in words and "hazardously misleading" in words
        seen.add(words)
    assert len(seen) == choose.locator("option").count() >= 4  # horizontal and vertical


def test_the_theme_is_that_of_the_system_and_can_be_changed(opened):
    page = opened(color_scheme="dark")
    ground = "getComputedStyle(document.body).backgroundColor"
    assert page.evaluate(ground) == "rgb(17, 19, 24)"
    page.get_by_role("button", name="Use light colors").click()
    assert page.evaluate(ground) == "rgb(255, 255, 255)"


@pytest.mark.parametrize("width", [320, 390, 768, 1280])
def test_nothing_is_wider_than_the_screen(opened, width):
    page = opened(width)
    for name in page.get_by_role("tab").all_inner_texts():
        tab(page, name)
        assert page.evaluate("document.documentElement.scrollWidth") <= width, name


def test_every_picture_has_a_text_alternative(opened):
    page = opened()
    for name in page.get_by_role("tab").all_inner_texts():
        for one in tab(page, name).locator("svg").all():
            assert one.get_attribute("aria-label") or one.get_attribute("aria-hidden") == "true"


def test_tables_are_whole_without_scripts(opened):
    page = opened(java_script_enabled=False)
    assert page.locator("table", has_text="Means").first.is_visible()
    assert page.locator("table", has_text="gates").is_visible()
