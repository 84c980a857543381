"""A report taken apart."""

from html.parser import HTMLParser


class Read(HTMLParser):
    """A page taken apart: tags, tables by caption, data, and all that is text."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.tables, self.data, self.text = [], {}, "", ""
        self._rows, self._caption, self._inside = [], "", []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attributes):
        known = dict(attributes)
        self.tags.append((tag, known))
        if tag not in ("wbr", "meta", "link"):  # which hold nothing
            self._inside.append((tag, known))
        if tag == "table":
            self._rows, self._caption = [], ""
        elif tag == "tr":
            self._rows.append([])
        elif tag in ("th", "td"):
            self._rows[-1].append(("", known.get("data-value")))

    def handle_endtag(self, tag):
        while self._inside and self._inside.pop()[0] != tag:
            pass
        if tag == "table":
            self.tables[self._caption] = self._rows

    def handle_data(self, data):
        inline = ("span", "b", "code")
        inside = [one for one in self._inside if one[0] not in inline]
        tag, known = inside[-1] if inside else ("", {})
        if known.get("id") == "data":
            self.data += data
        elif tag == "caption":
            self._caption += data
        elif tag in ("th", "td"):
            shown, value = self._rows[-1][-1]
            self._rows[-1][-1] = (shown + data, value)
        if tag not in ("script", "style"):
            self.text += data

    def table(self, words):
        """The one with these words in its caption."""
        (found,) = [rows for caption, rows in self.tables.items() if words in caption]
        return found
