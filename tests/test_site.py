"""Tests of the documentation site, and of the project's description on package indexes."""

import re

import numpy as np
import pytest

from experiments.console.main import COMMANDS
from tests.paths import ROOT, json_in, loaded

FIRST = "notebooks/first_switcher"
NAVIGATION = set(re.findall(r"^ +- .*?([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M))


@pytest.fixture(scope="module")
def hooks():
    return loaded("docs/site/hooks.py")


def test_the_navigation_lists_exactly_the_existing_pages(hooks):
    pages = {page.name for page in (ROOT / "docs").glob("*.md")}
    assert pages | set(hooks.made()) == NAVIGATION


ENVIRONMENT = "../mmwave_env/env.py"
METRICS = "../mmwave_env/metrics.py"


@pytest.mark.parametrize(
    ("link", "uri", "expected"),
    [
        ("docs/results.md", "README.md", "results.md"),
        ("results.json", "results.md", "report.html"),
        ("../README.md#train-on-it", "data.md", "index.md#train-on-it"),
        (ENVIRONMENT, "data.md", "environment.md"),
        (METRICS, "data.md", "api/signals.md#mmwave_env.metrics"),
        ("../data.md", "api/index.md", "../data.md"),
        (f"{FIRST}.ipynb", "data.md", f"{FIRST}.md"),
        ("LICENSE", "README.md", "REPOSITORY/blob/main/LICENSE"),
        ("../tests/filters", "data.md", "REPOSITORY/tree/main/tests/filters"),
        ("nowhere.md", "data.md", "nowhere.md"),
        ("https://doi.org/10", "data.md", "https://doi.org/10"),
        ("#angles", "data.md", "#angles"),
    ],
)
def test_a_link_leads_to_the_page_or_to_the_code_host(hooks, link, uri, expected, monkeypatch):
    monkeypatch.setitem(hooks.relinked.__globals__, "repository", lambda: "REPOSITORY")
    text = f"See [it]({link}).\n\n```\n[code]({link})\n```\n"
    expected = text.replace(link, expected, 1)
    readme = uri == "README.md"
    source = ROOT / uri if readme else ROOT / "docs" / uri
    assert hooks.relinked(text, "index.md" if readme else uri, source) == expected


def test_pages_made_from_code_are_up_to_date():
    for name, page in loaded("docs/site/generated_pages.py").PAGES.items():
        assert (ROOT / "docs" / name).read_text("utf-8") == page(), "run: make generated"


def test_the_page_of_a_notebook_shows_its_cells_and_their_outputs(hooks):
    for uri, name in hooks.NOTEBOOKS.items():
        page = hooks.made()[uri]()
        cells = json_in(ROOT / name)["cells"]
        cells = [cell for cell in cells if cell["cell_type"] == "code"]
        code = ["".join(cell["source"]) for cell in cells]
        assert re.findall(r"^```python\n(.*?)\n```$", page, re.DOTALL | re.MULTILINE) == code
        assert page.count("<img ") == sum("image/png" in str(cell["outputs"]) for cell in cells)


def test_the_page_of_help_texts_has_every_command(hooks):
    names = re.findall(
        r"^## (\S+)\n+```text\n(?:.*\n)*?usage: mmwave-loc \1 ", hooks.help_page(), re.M
    )
    assert names == list(COMMANDS)


def test_table_cells_with_one_name_or_number_do_not_wrap_and_sphinx_roles_become_links(hooks):
    html = "<p>:func:<code>~mmwave_env.metrics.ate</code> :func:<code>draw</code></p>"
    links = re.findall('identifier="(.*?)"><code>(.*?)<', hooks.on_page_content(html))
    assert links == [("mmwave_env.metrics.ate", "ate")]
    cells = "<td>imm-tuned</td><td>-1.8 ± 0.1</td><td>the error</td><td><code>plot</code></td>"
    assert hooks.on_page_content(cells).count('<td class="whole">') == 3


def test_a_paragraph_with_only_a_link_to_a_report_shows_the_report_in_a_frame(hooks):
    html = '<p><a href="../report.html#episodes">Play it</a></p>'
    html += '<p>See <a href="report.html">it</a>.</p><p><a href="data/">it</a></p>'
    frames = re.findall('<iframe .*src="([^"]*)"', hooks.on_page_content(html))
    assert frames == ["../report.html#episodes"]


def test_links_in_the_package_description_lead_to_the_tagged_version_of_files():
    files = ("README.md", "pyproject.toml", "mmwave_env/__init__.py")
    texts = [(ROOT / name).read_text("utf-8") for name in files]
    repository = "https://host.test/mmwave-loc"
    texts[1] = f'Repository = "{repository}"'
    text = loaded("setup.py").described(*texts)
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert links and all(link.startswith(("https://", "#")) for link in links)
    for kind, path in re.findall(rf"\({re.escape(repository)}/(\w+)/v0\.1\.0/([^)#]+)", text):
        assert (ROOT / path).is_file()
        assert (kind == "raw") == path.endswith((".png", ".gif"))


def test_no_page_links_to_an_address_that_is_a_placeholder(hooks, monkeypatch):
    described = loaded("setup.py").described
    version = '__version__ = "0.1.0"'
    texts = ("See [this](docs/data.md).", 'Repository = "https://example.org/x"', version)
    assert described(*texts) == "See this."
    monkeypatch.setitem(hooks.relinked.__globals__, "repository", str)
    source = ROOT / "README.md"
    assert hooks.relinked("See [it](LICENSE).", "index.md", source) == "See it."


def test_the_figure_of_angles_shows_the_angles_of_the_measurement_model(tmp_path):
    figure = loaded("docs/site/angles.py")
    user = np.array(figure.USER_M)
    x, y, z = (user - figure.SCENE.anchors_m).T
    expected = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), np.arctan2(-y, -x)
    np.testing.assert_allclose(figure.angles_deg(), np.degrees(expected).T)
    figure.draw(tmp_path / "angles.png")
    assert (tmp_path / "angles.png").read_bytes().startswith(b"\x89PNG")
