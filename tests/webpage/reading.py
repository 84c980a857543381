"""A report taken apart."""

from html.parser import HTMLParser


class Read(HTMLParser):
    """A page taken apart: tags, tables by caption, data, title, and all that is text."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.tables, self.data, self.title, self.text = [], {}, "", "", ""
        self._rows, self._caption, self._inside = [], "", []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attributes):
        known = dict(attributes)
        self.tags.append((tag, known))
        if tag not in ("meta", "link", "input", "use"):  # which hold nothing
            self._inside.append((tag, known))
        if known.get("class") == "table":
            self._rows, self._caption = [], ""
        elif tag == "tr":
            self._rows.append([])
        elif tag in ("th", "td"):
            self._rows[-1].append("")

    def handle_endtag(self, tag):
        while self._inside and self._inside.pop()[0] != tag:
            pass
        if tag == "table":
            self.tables[self._caption] = self._rows

    def handle_data(self, data):
        tag, known = self._inside[-1] if self._inside else ("", {})
        if known.get("id") == "data":
            self.data += data
        elif known.get("class") == "caption":
            self._caption += data
        elif tag in ("th", "td"):
            self._rows[-1][-1] += data
        elif tag == "title":
            self.title += data
        if tag not in ("script", "style"):
            self.text += data

    def table(self, words):
        """The one with these words in its caption."""
        (found,) = [rows for caption, rows in self.tables.items() if words in caption]
        return found
