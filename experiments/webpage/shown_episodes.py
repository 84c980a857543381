"""The section of episodes to play."""

from collections.abc import Sequence

from experiments.webpage.episodes import LONGEST
from experiments.webpage.markup import paragraph
from experiments.webpage.played import Played
from experiments.webpage.sections import Page
from mmwave_env.lookup import printable


def left_out(played: Played) -> list[str]:
    """Why there is nothing of some contenders, or of all."""
    said = []
    for name, why in played.missing.items():
        who = f"{name} was" if name else "What is behind it was"
        said.append(paragraph(f"{who} not played again: {why}", "note"))
    return said


def add_episodes(page: Page, what: str, played: Played, names: Sequence[str]) -> None:
    """Episodes to watch, with contenders in this order."""
    shown = [one for one in played.shown if one["contenders"]]
    if not shown:
        return
    if "Episodes" not in page.sections:
        page.add("Episodes", '<div id="browser"></div>')
    for one in shown:
        courses = {name: one["contenders"][name] for name in names if name in one["contenders"]}
        contenders = {
            printable(name): course | {"modes": [printable(mode) for mode in course["modes"]]}
            for name, course in courses.items()
        }
        known = {"name": printable(f"{what}{one['name']}"), "contenders": contenders}
        page.data["episodes"].append(one | known)
    left = len(played.errors_m) - len(shown[0]["contenders"])
    if left > 0:
        page.add("Episodes", paragraph(
            f"{what}{', '.join(shown[0]['contenders'])} can be watched; {left} more are in the "
            "tables.", "note",
        ))  # fmt: skip
    if any(one["cut"] for one in shown):
        words = f"{what}of longer episodes the first {LONGEST} epochs are shown."
        page.add("Episodes", paragraph(words, "note"))
