"""Pictures that commands write."""

from pathlib import Path

from mmwave_env.files import require_writable
from mmwave_env.lookup import require_extra


def require_picture(option: str, path: Path) -> None:
    """Refuse a picture that could not be drawn or written, before any work.

    Args:
        option: that names the file.
        path: of the file.

    Raises:
        ValueError: it does not end with .png.
        MissingExtraError: matplotlib is not installed.
        OSError: the file can't be written.
    """
    if path.suffix.lower() != ".png":
        raise ValueError(f"{option}: found {path}, expected a name that ends with .png")
    require_extra("matplotlib", "plot", f"{option}, a picture,")
    require_writable(path)
