"""A report taken apart."""

import re
from html import unescape
from html.parser import HTMLParser


class Read(HTMLParser):
    """A page taken apart: tags with their attributes, data, title, and all that is text."""

    def __init__(self, page):
        super().__init__()
        self.page, self.tags, self.text, self.data = page, [], "", ""
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

    def table(self, words):
        """Rows of the one with these words in its caption."""
        (part,) = [one for one in self.page.split('<div class="table">')[1:]
                   if words in one.partition("</p>")[0]]  # fmt: skip
        rows = re.findall("<tr>(.*?)</tr>", part, re.DOTALL)
        cells = (re.findall("<t[hd].*?>(.*?)</t[hd]>", row, re.DOTALL) for row in rows)
        return [[unescape(one) for one in row] for row in cells]
