"""Which packages are installed, and what is missing for each extra."""

import re
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from typing import NamedTuple

OURS = "mmwave-loc"
_NAME = re.compile(r"^[A-Za-z0-9._-]+")
_EXTRA = re.compile(r"""extra == ['"](\w+)['"]""")


class Package(NamedTuple):
    """A package that the base or an extra asks for."""

    extra: str  # empty for the base
    name: str
    wanted: str  # as asked for, with its bounds
    found: str | None  # the version installed


def packages() -> list[Package]:
    """All that this package asks for; nothing where it is run from a folder, not installed."""
    try:
        return list(_packages(requires(OURS) or []))
    except PackageNotFoundError:
        return []


def _packages(wanted: list[str]) -> Iterator[Package]:
    for line in wanted:
        asked, _, condition = line.partition(";")
        extra, name = _EXTRA.search(condition), _NAME.search(asked)
        assert name is not None
        if name[0] != OURS:  # an extra of ours within another
            yield Package(extra[1] if extra else "", name[0], asked.strip(), _version(name[0]))


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
