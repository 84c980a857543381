"""Metadata beyond pyproject.toml: the README, with links that also work on a package index."""

import re
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).parent


def described(readme: str, project: str, package: str) -> str:
    """Return the README with its relative links replaced by links to this version's files.

    As long as the address of the repository is a placeholder, their texts replace them.
    """
    (repository,) = re.findall(r'^Repository = "(.*)"$', project, re.MULTILINE)
    (version,) = re.findall(r'^__version__ = "(.*)"$', package, re.MULTILINE)
    if "//example.org" in repository:
        return re.sub(r"!?\[([^\]]*)\]\((?!\w+:|#)[^)]*\)", r"\1", readme)
    link = re.compile(r"(!?)(\[[^\]]*\]\()(?!\w+:|#)")
    kinds = {"!": "raw", "": "blob"}  # "raw": the file itself, for pictures; "blob": its web page
    return link.sub(lambda m: f"{m[0]}{repository}/{kinds[m[1]]}/v{version}/", readme)


if __name__ == "__main__":
    files = ("README.md", "pyproject.toml", "mmwave_env/__init__.py")
    texts = [(ROOT / name).read_text(encoding="utf-8") for name in files]
    setup(
        long_description=described(*texts),
        long_description_content_type="text/markdown",
    )
