"""Page docs/environment.md, made from the docstring of the environment by `make generated`."""

import inspect
from pathlib import Path

from mmwave_env.env import MmWaveLocEnv

PAGE = Path(__file__).resolve().parents[1] / "environment.md"


def page() -> str:
    """Return the page: a title, a comment and the docstring of the class."""
    text = inspect.cleandoc(MmWaveLocEnv.__doc__ or "")
    made = "<!-- made from the docstring of MmWaveLocEnv by `make generated` -->"
    return f"# MmWaveLoc-v0\n\n{made}\n\n{text}\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
