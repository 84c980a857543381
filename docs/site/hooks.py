"""Hooks of ProperDocs that generate pages and adapt links to the site during the build.

Besides the files of docs/, the site shows text whose only source is elsewhere: the README, the
help of the commands, CITATION.cff, notebooks and the docstrings of the modules.
"""

import ast
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout, suppress
from functools import cache, partial
from io import StringIO
from itertools import zip_longest
from pathlib import Path
from posixpath import relpath
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
MIRRORED = {  # pages of the site whose files are outside docs/
    "index.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    "security.md": "SECURITY.md",
}
SHOWN = ("first_switcher", "corrector")
NOTEBOOKS = {f"notebooks/{name}.md": f"docs/notebooks/{name}.ipynb" for name in SHOWN}
REPORTS = {"docs/results.json": "report.html"}  # results that the site shows as a web page
API = {  # page -> title, and paths of modules and folders (in mmwave_env unless "/" is first)
    "environment": ("Around the environment", ["vector_env", "sb3"]),
    "signals": ("Rewards and observations", ["interface/", "metrics"]),
    "numerics": ("Numbers", ["numerics/numbers", "numerics/linalg"]),
    "models": ("Models", ["models/"]),
    "filters": ("Filters", ["filters/"]),
    "world": ("World", ["world/"]),
    "datasets": ("Data sets", ["datasets/", "datasets/deepmimo/"]),
    "localization": ("Localization", ["localization/", "logs/"]),
    "policies": ("Policies", ["/policies/"]),
    "evaluation": ("Evaluation", ["/experiments/evaluation/"]),
}
CODE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\[([^\[\]]*)\]\(([^)\s:#]+)(#[^)\s]*)?\)")
PAGE_ALONE = re.compile(r'<p><a href="([^"]+\.html(?:#[^"]*)?)">([^<"]+)</a></p>')
CELL = re.compile(r"<td>(?=(?:[a-z]+(?:-[a-z0-9]+)*|[^<a-zA-Z]+|<code>[^<]{1,20}</code>)</td>)")
ROLE = re.compile(r":(?:class|func|meth|mod|data|attr|exc):<code>~?([\w.]+)</code>")


def repository() -> str:
    """Return the address of the repository, which only pyproject.toml states.

    It is "" as long as it is a placeholder; then no page links there.
    """
    (url,) = re.findall(
        r'^Repository = "(.*)"$', (ROOT / "pyproject.toml").read_text("utf-8"), re.MULTILINE
    )
    return "" if "//example.org" in url else url


def on_config(config: Any) -> Any:
    """Give the theme the address of the repository, for the header of every page."""
    if url := repository():
        config.repo_url = url
        config.repo_name = "source"
    return config


# --- pages made at the build


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are not files of docs/."""
    from properdocs.structure.files import File

    for path, text in made().items():
        files.append(File.generated(config, path, content=text()))
    files.append(File.generated(config, REPORTS["docs/results.json"], content=report_page()))
    return files


def made() -> dict[str, Callable[[], str]]:
    """Return the functions that make the Markdown of generated pages, by path on the site."""
    return {
        **{path: partial((ROOT / name).read_text, "utf-8") for path, name in MIRRORED.items()},
        "command-help.md": help_page,
        "citing.md": citing_page,
        **{page: partial(notebook_page, ROOT / name) for page, name in NOTEBOOKS.items()},
        "api/index.md": api_index,
        **{f"api/{name}.md": partial(api_page, name) for name in API},
    }


def help_page() -> str:
    """Return the page with the help of every command of the installed package."""
    from experiments.console.main import COMMANDS, run

    parts = [
        "# Options of the commands",
        "This page shows what `--help` prints. [Commands](commands.md) has the overview and "
        "examples.",
    ]
    for name in COMMANDS:
        printed = StringIO()
        os.environ |= {"COLUMNS": "88", "NO_COLOR": "1"}
        with redirect_stdout(printed), suppress(SystemExit):  # a parser exits after its help
            run(name, ["--help"])
        parts += [f"## {name}", f"```text\n{printed.getvalue().strip()}\n```"]
    return "\n\n".join(parts) + "\n"


def report_page() -> str:
    """Return the web page of the published results, with a few episodes to play."""
    from experiments.console.options import PageArgs
    from experiments.reporting.webpage.page import page_of

    results = tuple(Path(os.path.relpath(ROOT / name)) for name in REPORTS)
    return page_of(PageArgs(results=results, episodes=3))


def citing_page() -> str:
    """Return CITATION.cff as BibTeX: the software, and the paper that it follows."""
    import yaml

    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    (paper,) = cited["references"]
    address = f",\n  url     = {{{repository()}}}" if repository() else ""
    people = " and ".join(f"{a['family-names']}, {a['given-names']}" for a in paper["authors"])
    return f"""# How to cite

Cite the software with the version you used, and the paper that it follows:

```bibtex
@software{{mmwave_loc,
  title   = {{{{{cited["title"]}}}}},
  author  = {{{{{cited["authors"][0]["name"]}}}}},
  version = {{{cited["version"]}}}{address}
}}

@misc{{mobility_aware_localization,
  title  = {{{{{paper["title"]}}}}},
  author = {{{people}}},
  year   = {{{paper["year"]}}},
  doi    = {{{paper["doi"]}}}
}}
```

The same entries are in the file `CITATION.cff`, which reference managers read.
"""


def notebook_page(path: Path) -> str:
    """Return the cells of a notebook and their stored outputs, with a link to the file."""
    first, *others = json.loads(path.read_text("utf-8"))["cells"]
    # The link is by reference: :func:`relinked` would make an inline link lead to this page.
    parts = [
        "".join(first["source"]),
        "This page shows a notebook and its stored outputs. To run the notebook, [download it]"
        f"[file]{{ download }}.\n\n[file]: {path.name}",
    ]
    for cell in others:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        parts += [_shown(output) for output in cell.get("outputs", ())]
    return "\n\n".join(parts) + "\n"


def _shown(output: dict[str, Any]) -> str:
    """Return an output of a cell as Markdown: a picture, a table or text."""
    data = output.get("data") or {"text/plain": output["text"]}
    if "image/png" in data:
        image = "".join("".join(data["image/png"]).split())
        return f'<img alt="output of the cell above" src="data:image/png;base64,{image}">'
    if "text/markdown" in data:
        return "".join(data["text/markdown"])
    return f"```text\n{''.join(data['text/plain'])}\n```"


def modules_of(part: str) -> Iterator[str]:
    """Yield the dotted names of the modules at a path of :data:`API`."""
    path = ROOT / part.strip("/") if part.startswith("/") else ROOT / "mmwave_env" / part
    files = sorted(path.glob("*.py")) if part.endswith("/") else [path.with_suffix(".py")]
    for file in files:
        if file.stem != "__init__":
            yield ".".join(file.relative_to(ROOT).with_suffix("").parts)


def api_page(name: str) -> str:
    """Return the page of one part of the API, whose modules mkdocstrings fills in."""
    title, parts = API[name]
    modules = [f"::: {module}" for part in parts for module in modules_of(part)]
    if name == "signals":
        modules.insert(0, f"## The features of an observation\n\n{features()}")
    return "\n\n".join([f"# {title}", *modules]) + "\n"


def features() -> str:
    """Return the table of the features that an environment shows by default."""
    from mmwave_env.env import MmWaveLocEnv

    return MmWaveLocEnv().observation.table()


def api_index() -> str:
    """Return the overview of the API, with the first sentence of every module."""
    lines = [
        "# API",
        "`gymnasium.make` and `gymnasium.make_vec` are the entry points; [the environment's page]"
        "(../environment.md) lists their arguments, [this table](signals.md#the-features-of-an-"
        "observation) the features of an observation. The pages below document the modules inside, "
        "grouped as in the [architecture](../architecture.md).",
    ]
    for name, (title, parts) in API.items():
        rows = [
            f"| [{module}]({name}.md#{module}) | {_first_sentence(module)} |"
            for part in parts
            for module in modules_of(part)
        ]
        lines += [f"## {title}", "| module | about |\n|---|---|\n" + "\n".join(rows)]
    return "\n\n".join(lines) + "\n"


def _first_sentence(module: str) -> str:
    source = (ROOT / module.replace(".", "/")).with_suffix(".py").read_text("utf-8")
    about = (ast.get_docstring(ast.parse(source)) or "").split("\n\n")[0]
    about = re.sub(r":\w+:`~?([\w.]+)`", r"`\1`", " ".join(about.split()))
    return about.replace("|", "\\|").replace("``", "`")


# --- links


def source_of(name: str) -> str:
    """Return the address where the code host shows a file or folder, or "" without a code host."""
    url = repository()
    return url and f"{url}/{'tree' if (ROOT / name).is_dir() else 'blob'}/main/{name}"


@cache
def pages() -> dict[str, str]:
    """Map files of the checkout to pages of the site that show them in another form."""
    shown = {source: page for page, source in (MIRRORED | NOTEBOOKS).items()} | REPORTS
    for name, (_, parts) in API.items():
        for module in (m for part in parts for m in modules_of(part)):
            shown[f"{module.replace('.', '/')}.py"] = f"api/{name}.md#{module}"
    return shown | {"mmwave_env/env.py": "environment.md"}


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Make relative links lead to pages of the site, or else to files on the code host."""
    uri = page.file.src_uri
    return relinked(markdown, uri, (ROOT / MIRRORED[uri]) if uri in MIRRORED else DOCS / uri)


def relinked(markdown: str, uri: str, source: Path) -> str:
    """Return the Markdown of a page with its links changed for the site.

    Args:
        markdown: text of the page, whose links are relative to ``source``.
        uri: address of the page on the site, relative to its top.
        source: file that the page shows; it need not exist if the page is made at the build.
    """

    def mended(match: re.Match[str]) -> str:
        text, path, anchor = match.groups()
        target = Path(os.path.normpath(source.parent / path))
        if not target.exists():  # a page made at the build, or a mistake that ProperDocs reports
            return match[0]
        address = _address(target, os.path.dirname(uri) or ".")
        return f"[{text}]({address}{anchor or ''})" if address else text

    code = CODE.findall(markdown)
    prose = [LINK.sub(mended, piece) for piece in CODE.split(markdown)]
    return "".join(text for pair in zip_longest(prose, code, fillvalue="") for text in pair)


def _address(target: Path, folder: str) -> str:
    """Return the address of a file of the checkout relative to a folder of the site."""
    name = target.relative_to(ROOT).as_posix()
    if name in pages():
        return relpath(pages()[name], folder)
    shown = target.parent == DOCS or target.suffix == ".png"
    if shown and DOCS in target.parents and target.is_file():
        return relpath(target.relative_to(DOCS).as_posix(), folder)
    return source_of(name)


def on_page_content(html: str, **_: Any) -> str:
    """Turn roles such as :func: into links; keep numbers and names in tables on one line.

    If a paragraph holds only a link to a web page of this site, such as a report, a frame below the
    paragraph shows that page.
    """

    def linked(match: re.Match[str]) -> str:
        name = match[1]
        word = f"<code>{name.rpartition('.')[2]}</code>"
        return f'<autoref optional identifier="{name}">{word}</autoref>' if "." in name else word

    html = PAGE_ALONE.sub(
        r'\g<0>\n<iframe class="page" src="\1" title="\2" loading="lazy"></iframe>', html
    )
    return CELL.sub('<td class="whole">', ROLE.sub(linked, html))


def on_post_page(output: str, **_: Any) -> str:
    """Stop the theme from fetching the number of stars: the site loads only its own files."""
    return output.replace(' data-md-component="source"', "")
