"""Tests of the documentation site, and of the description on package indexes."""

import importlib.util
import json
import re

import numpy as np
import pytest

from experiments.console.main import COMMANDS
from tests.paths import ROOT

FIRST = "notebooks/first_switcher"
NAVIGATION = set(re.findall(r"^ +- .*?([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M))


def loaded(path):
    """A Python file that is no module of a package."""
    spec = importlib.util.spec_from_file_location(path.replace("/", "_"), ROOT / path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def hooks():
    return loaded("docs/site/hooks.py")


def test_the_navigation_has_every_page_and_no_other(hooks):
    pages = {page.name for page in (ROOT / "docs").glob("*.md")}
    assert pages | set(hooks.made()) == NAVIGATION


@pytest.mark.parametrize(
    ("link", "uri", "source", "expected"),
    [
        ("results.md#how", "index.md", "docs/index.md", "results.md#how"),
        ("docs/results.md", "index.md", "README.md", "results.md"),
        ("results.json", "results.md", "docs/results.md", "report.html"),
        ("../README.md#train-on-it", "data.md", "docs/data.md", "index.md#train-on-it"),
        ("../mmwave_env/env.py", "data.md", "docs/data.md", "environment.md"),
        (
            "../mmwave_env/metrics.py",
            "data.md",
            "docs/data.md",
            "api/signals.md#mmwave_env.metrics",
        ),
        ("../data.md", "api/index.md", "docs/api/index.md", "../data.md"),
        ("docs/track.png", "index.md", "README.md", "track.png"),
        (f"{FIRST}.ipynb", "data.md", "docs/data.md", f"{FIRST}.md"),
        ("../data.md", "notebooks/a.md", "docs/notebooks/a.md", "../data.md"),
        ("LICENSE", "index.md", "README.md", "REPOSITORY/blob/main/LICENSE"),
        ("../tests/filters", "data.md", "docs/data.md", "REPOSITORY/tree/main/tests/filters"),
        ("nowhere.md", "data.md", "docs/data.md", "nowhere.md"),
        ("https://doi.org/10", "data.md", "docs/data.md", "https://doi.org/10"),
        ("#angles", "data.md", "docs/data.md", "#angles"),
    ],
)
def test_a_link_leads_to_the_page_or_to_the_code_host(hooks, link, uri, source, expected):
    text = f"See [it]({link}).\n\n```\n[code]({link})\n```\n"
    expected = expected.replace("REPOSITORY", hooks.repository())
    assert hooks.relinked(text, uri, ROOT / source) == text.replace(link, expected, 1)


def test_the_page_of_the_environment_is_its_docstring():
    module = loaded("docs/site/environment.py")
    assert module.PAGE.read_text("utf-8") == module.page(), "run: make generated"


def test_a_notebook_is_a_page_of_its_cells_with_a_link_to_the_file(hooks):
    ((uri, name),) = hooks.NOTEBOOKS.items()
    page, cells = hooks.made()[uri](), json.loads((ROOT / name).read_text("utf-8"))["cells"]
    places = [page.index("".join(cell["source"])) for cell in cells]
    assert places == sorted(places) and page.startswith("# ")
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert re.findall(r"^```python\n(.*?)\n```$", page, re.DOTALL | re.MULTILINE) == code
    assert "\n[file]: first_switcher.ipynb\n" in hooks.relinked(page, uri, ROOT / "docs" / uri)


def test_every_command_shows_its_help(hooks):
    parts = hooks.help_page().split("\n## ")[1:]
    assert [part.split("\n")[0] for part in parts] == list(COMMANDS)
    assert all(f"usage: mmwave-loc {part.split()[0]}" in part for part in parts)


def test_the_citation_names_version_and_paper(hooks):
    pytest.importorskip("yaml")
    page = hooks.citing_page()
    assert "version = {0.1.0}" in page and "10.48550/arXiv.2510.06861" in page
    assert "Orimogunje, Abidemi and Cha, Kyeong-Ju" in page


def test_every_module_of_the_reference_is_there(hooks):
    names = re.findall(r"^\| \[([\w.]+)\]", hooks.api_index(), re.MULTILINE)
    assert names == [
        name for part in hooks.API for name in re.findall(r"::: (.*)", hooks.api_page(part))
    ]
    assert all((ROOT / f"{name.replace('.', '/')}.py").is_file() for name in names)


def test_roles_of_docstrings_become_links_and_figures_stay_on_one_line(hooks):
    html = "<p>:func:<code>~mmwave_env.metrics.ate</code> :func:<code>draw</code></p>"
    linked = hooks.on_page_content(html)
    assert '<autoref optional identifier="mmwave_env.metrics.ate"><code>ate' in linked
    assert linked.endswith(" <code>draw</code></p>")
    cells = "<td>imm-tuned</td><td>-1.8 ± 0.1</td><td>the error</td><td><code>plot</code></td>"
    assert hooks.on_page_content(cells).count('<td class="whole">') == 3


def test_a_paragraph_that_is_but_a_link_to_a_report_gets_it_in_a_frame(hooks):
    html = '<p><a href="../report.html#episodes">Play it</a></p>'
    shown = hooks.on_page_content(html)
    assert shown.startswith(html)
    frame = '<iframe class="page" src="../report.html#episodes" title="Play it" loading="lazy">'
    assert frame in shown
    for other in ('<p>See <a href="report.html">it</a>.</p>', '<p><a href="data/">it</a></p>'):
        assert "<iframe" not in hooks.on_page_content(other)


def test_no_page_asks_a_code_host_for_stars(hooks):
    told = '<a href="https://github.com/a/b" class="md-source" data-md-component="source">'
    assert hooks.on_post_page(told) == '<a href="https://github.com/a/b" class="md-source">'


def test_the_description_on_an_index_links_into_the_repository_at_its_tag():
    texts = [
        (ROOT / name).read_text("utf-8")
        for name in ("README.md", "pyproject.toml", "mmwave_env/__init__.py")
    ]
    text = loaded("setup.py").described(*texts)
    (repository,) = re.findall(r'^Repository = "(.*)"$', texts[1], re.MULTILINE)
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert links and all(link.startswith(("https://", "#")) for link in links)
    for kind, path in re.findall(rf"\({re.escape(repository)}/(\w+)/v0\.1\.0/([^)#]+)", text):
        assert (ROOT / path).is_file()
        assert (kind == "raw") == path.endswith((".png", ".gif"))


def test_the_figure_of_angles_shows_those_of_the_measurement_model(tmp_path):
    figure = loaded("docs/site/angles.py")
    user = np.array(figure.USER_M)
    for anchor, told in zip(figure.SCENE.anchors_m, figure.angles_deg(), strict=True):
        x, y, z = user - anchor
        azimuths = np.arctan2(y, x), np.arctan2(-y, -x)
        angles = [azimuths[0], np.arctan2(z, np.hypot(x, y)), azimuths[1]]
        assert told == pytest.approx(np.degrees(angles))
    figure.draw(tmp_path / "angles.png")
    assert (tmp_path / "angles.png").read_bytes().startswith(b"\x89PNG")
