"""The licenses of what the package depends on; ``make licenses`` writes docs/licenses.md."""

import re
from importlib.metadata import PackageNotFoundError, distribution

from experiments.health.installed import packages
from tests.paths import ROOT

PAGE = ROOT / "docs" / "licenses.md"
FOR_WORK = ("dev", "docs", "lint")  # extras for working on the package, not for running it
BY_HAND = {  # looked up: not installed with dev, or untold in their metadata
    "atheris": "Apache-2.0", "eclipse-sumo": "EPL-2.0", "optuna": "MIT", "ray": "Apache-2.0",
    "sionna-rt": "Apache-2.0", "tomli": "MIT",
}  # fmt: skip
FAMILIES = {  # by how it is told in metadata; of several, what is told first
    "EPL-2.0": r"EPL|Eclipse Public",
    "LGPL": r"LGPL|Lesser General Public",
    "GPL": r"GPL|General Public",
    "MPL-2.0": r"MPL|Mozilla",
    "MIT": r"\bMIT\b",
    "BSD": r"BSD",
    "Apache-2.0": r"Apache",
    "PSF": r"PSF|Python Software Foundation",
    "ISC": r"\bISC\b",
}
HEAD = """# Licenses

mmwave-loc is under the MIT license. This page names the licenses of what it depends on itself, as
these packages say; `make licenses` writes it, and a test holds it beside what is installed. Nothing
that runs is under the GPL, neither these packages nor what they bring; evo, which only tests use,
is. `imageio-ffmpeg` carries a program, ffmpeg, whose own license is the GPL; it is started, not
linked.

| extra | package | license |
|---|---|---|
"""


def license_of(package):
    """The family of a license, by a package's metadata; None where it is not installed."""
    try:
        found = distribution(package).metadata
    except PackageNotFoundError:
        return None
    said = [found.get("License-Expression") or ""]
    said += [one for one in found.get_all("Classifier") or [] if one.startswith("License")]
    said = " ".join([*said, (found.get("License") or "")[:200]])
    places = {name: re.search(words, said) for name, words in FAMILIES.items()}
    told = [name for name, place in places.items() if place]
    return min(told, key=lambda name: places[name].start(), default=BY_HAND.get(package, "untold"))


def rows():
    """Extra, package and license of everything the package asks for itself."""
    return [(one.extra or "(base)", one.name, license_of(one.name)) for one in packages()]


def brought(package, seen):
    """Names of a package and of all that it brings, as far as they are installed."""
    name = re.sub(r"[-_.]+", "-", package).lower()
    if name in seen:
        return
    try:
        asked = distribution(package).requires or []
    except PackageNotFoundError:
        return
    seen.add(name)
    for line in asked:
        wanted, _, condition = line.partition(";")
        if "extra" not in condition:
            brought(re.match(r"[\w.-]+", wanted)[0], seen)


def page():
    """The page; needs all extras installed."""
    return HEAD + "".join(
        f"| {extra} | {name} | {said or BY_HAND[name]} |\n" for extra, name, said in rows()
    )


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
