"""What a page is put together from."""

from dataclasses import dataclass, field
from typing import Any

from experiments.webpage.charts import Chart
from experiments.webpage.markup import chart


@dataclass
class Page:
    """What is put together: sections by title, as HTML, and the data of the script."""

    sections: dict[str, str] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=lambda: {"charts": [], "episodes": []})

    def add(self, title: str, *parts: str) -> None:
        """Append to a section."""
        self.sections[title] = self.sections.get(title, "") + "".join(parts)

    def drawn(self, found: Chart) -> str:
        """The place of a picture."""
        self.data["charts"].append(found)
        return chart(found["kind"], number=len(self.data["charts"]) - 1)
