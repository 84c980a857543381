"""Results of one command: what all kinds have in common, and what is refused of each."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.webpage.kinds import Kind
from mmwave_env import __version__
from mmwave_env.files import read_json, told


@dataclass(frozen=True)
class Source:
    """Results of one command.

    Attributes:
        path: of the file or the folder, as it was given; of a part of a file with its title.
        kind: what they are.
        content: what the file holds; of a run the manifest, with "name", "over", the outcomes of
            its trainings as "seeds" and their "curves".
        versions: of the packages that made it, as far as they are known.
    """

    path: str
    kind: Kind
    content: Mapping[str, Any]
    versions: Mapping[str, str]

    @property
    def command(self) -> str:
        """That makes it again."""
        return str(self.content["command"])

    @classmethod
    def checked(cls, name: str, kind: Kind, content: Mapping[str, Any]) -> "Source":
        """Results that hold what they should.

        Raises:
            ValueError: naming the file, the key, and the version that wrote it.
        """
        versions = content.get("versions", {})
        writer = writer_of(versions)
        require_keys(name, kind, content, writer)
        try:
            kind.check(content)
            known = {str(package): str(number) for package, number in versions.items()}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(
                f"{name}: {told(error)}, written by {writer}; mmwave-loc {__version__} expects "
                "what docs/commands.md says"
            ) from error
        return cls(name, kind, content, known)


def read_object(path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        ValueError: it holds none.
        OSError: it can't be read.
    """
    return read_json(path, "results", dict)


def writer_of(versions: Any) -> str:
    """The version that wrote results, in words."""
    found = versions.get("mmwave-loc") if isinstance(versions, dict) else None
    return f"mmwave-loc {found}" if found else "an unknown version of mmwave-loc"


def words(names: Iterable[str]) -> str:
    """Names, one after the other."""
    return ", ".join(names)


def require_keys(name: str, kind: Kind, content: Mapping[str, Any], writer: str) -> None:
    """Refuse results with keys that there are not, and without keys that there must be.

    Args:
        name: of the file.
        kind: of results.
        content: the results.
        writer: the version that wrote them, in words.

    Raises:
        ValueError: naming all of these.
    """
    needed = ("command", *kind.needed)
    known = (*needed, *kind.optional)
    for key in content:
        if key not in known:
            raise ValueError(
                f"{name}: {key}: found a key written by {writer} that mmwave-loc {__version__} "
                f"does not know in results of this kind ({kind.name}); expected {words(known)}"
            )
    for key in needed:
        if key not in content:
            raise ValueError(
                f"{name}: {key}: found none, written by {writer}; expected it in results of this "
                f"kind ({kind.name})"
            )
