"""Data for tests of reports: small results files, a name that attacks web pages, a page parser."""

import re
from html import unescape
from html.parser import HTMLParser

from mmwave_env import __version__
from mmwave_env.metrics import METRICS

HOSTILE = "</script><img src=x onerror=alert(1)>$|`\n\x1b[31m\u202eΩ日本\"'&"


def interval(mean):
    """Return an interval in the form of results files."""
    return {"mean": mean, "ci95": [mean - 0.1, mean + 0.1]}


def metrics(mean):
    """Return every metric in the form of results files, with means that count up from ``mean``."""
    return {metric: interval(mean + i) for i, metric in enumerate(METRICS)}


def comparison(names=("imm", "speed-rule"), **more):
    """Return a comparison with rewards -1, -2, ... and differences from the first of ``names``."""
    first, *others = names
    content = {"scenario": "mixed", "radio": "handset", "episodes": 2, "seed": 0}
    content |= {
        "command": "mmwave-loc compare --episodes 2 --episode-steps 30",
        "versions": {"mmwave-loc": __version__, "python": "3.12.0"},
        "policies": {name: metrics(-1.0 - i) for i, name in enumerate(names)},
        "paired": {f"{name} - {first}": metrics(-0.5) for name in others},
    }
    return content | more


class Read(HTMLParser):
    """Parsed page: tags with their attributes, embedded data, title and text."""

    def __init__(self, page):
        super().__init__()
        self.page = page
        self.tags = []
        self.text = ""
        self.data = ""
        self.feed(page)
        self.title = unescape(re.search("<title>(.*)</title>", page)[1])

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_data(self, data):
        tag, known = self.tags[-1] if self.tags else ("", {})
        if known.get("id") == "data":
            self.data += data
        if tag not in ("script", "style"):
            self.text += data

    def attributes(self, *names):
        """Return the values of all attributes with these names, in the order of the page."""
        return [known[name] for _, known in self.tags for name in names if name in known]

    def table(self, words):
        """Return the rows of the first table with these words in its caption."""
        parts = self.page.split('<div class="table"')[1:]
        part = next(part for part in parts if words in part.partition("</p>")[0])
        rows = re.findall("<tr>(.*?)</tr>", part, re.DOTALL)
        cells = (re.findall("<t[hd].*?>(.*?)</t[hd]>", row, re.DOTALL) for row in rows)
        return [[*map(unescape, row)] for row in cells]
