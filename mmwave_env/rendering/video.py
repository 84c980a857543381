"""Pictures one after another as a file: .gif or .mp4. Needs the extra ``video``."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.files import atomic_path, require_writable
from mmwave_env.lookup import require_extra

Draw = Callable[[int], NDArray[np.uint8]]
_COLORS = 256  # of a GIF, the most it can have
_SAMPLES = 6  # pictures that the colors are taken from
_LAST_S = 2.0  # that a GIF stays at its last picture, before it begins again


class Reel(NamedTuple):
    """What is to be written.

    Attributes:
        draw: from a number to its picture (height, width, 3).
        numbers: of the pictures, at least one.
        fps: pictures a second.
        report: gets the share done.
    """

    draw: Draw
    numbers: Sequence[int]
    fps: int
    report: Callable[[float], None]

    def pictures(self) -> Iterator[NDArray[np.uint8]]:
        """All of them, in order."""
        for done, number in enumerate(self.numbers, start=1):
            yield self.draw(number)
            self.report(done / len(self.numbers))


def require_video(option: str, path: Path) -> None:
    """Refuse a video that could not be written, before any work.

    Args:
        option: that names the file.
        path: of the file.

    Raises:
        ValueError: it does not end with .gif or .mp4.
        MissingExtraError: the package that writes it is not installed.
        OSError: the file can't be written.
    """
    kind = path.suffix.lower()
    if kind not in _KINDS:
        raise ValueError(f"{option}: found {path}, expected a name that ends with .gif or .mp4")
    require_extra(_KINDS[kind].package, "render", f"{option}, a {kind} file,")
    require_writable(path)


def write_video(
    path: Path, draw: Draw, numbers: Sequence[int], fps: int, report: Callable[[float], None]
) -> None:
    """Write a video in one step: it is whole or not there.

    Args:
        path: as of :func:`require_video`.
        draw, numbers, fps, report: as of :class:`Reel`.
    """
    with atomic_path(path) as temporary:
        _KINDS[path.suffix.lower()].write(temporary, Reel(draw, numbers, fps, report))


def _write_gif(path: Path, reel: Reel) -> None:
    """With one palette, so that what stays the same between two pictures costs nothing."""
    from PIL import Image

    some = np.linspace(0, len(reel.numbers) - 1, _SAMPLES).astype(int).tolist()
    samples = np.concatenate([reel.draw(reel.numbers[i]) for i in some])
    palette = Image.fromarray(samples).quantize(_COLORS, Image.Quantize.FASTOCTREE)
    first, *others = (
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in reel.pictures()
    )
    lasts = [round(1000 / reel.fps)] * len(others) + [round(1000 * _LAST_S)]
    first.save(
        path, format="GIF", save_all=True, append_images=others, duration=lasts, loop=0
    )  # fmt: skip


def _write_mp4(path: Path, reel: Reel) -> None:
    import imageio_ffmpeg

    height, width, _ = reel.draw(reel.numbers[0]).shape
    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=reel.fps, quality=8, macro_block_size=2
    )
    with closing(writer):  # also where a picture fails, or ffmpeg would write on
        writer.send(None)  # it begins
        for picture in reel.pictures():
            writer.send(np.ascontiguousarray(picture))


class _Kind(NamedTuple):
    """A kind of file: the package that writes it, and how."""

    package: str
    write: Callable[[Path, Reel], None]


_KINDS = {".gif": _Kind("PIL", _write_gif), ".mp4": _Kind("imageio_ffmpeg", _write_mp4)}
