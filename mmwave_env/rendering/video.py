"""Video files (.gif or .mp4) of a sequence of pictures; needs the extra ``render``."""

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import numpy as np

from mmwave_env.io.files import atomic_path, require_writable
from mmwave_env.io.lookup import require_extra
from mmwave_env.rendering.theme import Pixels

_PACKAGES = {".gif": "PIL", ".mp4": "imageio_ffmpeg"}  # package that writes each format
_COLORS = 256  # maximum number of colors in a GIF
_LAST_S = 2.0  # time for which a GIF shows its last picture, before it repeats


def require_video(option: str, path: Path) -> None:
    """Refuse a file that can't be written, before work begins; messages begin with ``option``.

    Raises:
        ValueError: the name does not end with .gif or .mp4.
        MissingExtraError: the package that writes the format is not installed.
        OSError: the file can't be written.
    """
    kind = path.suffix.lower()
    if kind not in _PACKAGES:
        raise ValueError(f"{option}: found {path}, expected a name that ends with .gif or .mp4")
    require_extra(_PACKAGES[kind], "render", f"{option}, a {kind} file,")
    require_writable(path)


def write_video(path: Path, pictures: Iterable[Pixels], sample: Pixels, fps: int) -> None:
    """Write a complete video; if that fails, an older file at ``path`` remains unchanged.

    The video shows the ``pictures`` (height, width, 3), each when it is drawn. A GIF has the colors
    of the ``sample``, a picture such as the last. Call ``require_video`` first.
    """
    write = _write_mp4 if path.suffix.lower() == ".mp4" else _write_gif
    with atomic_path(path) as temporary:
        write(temporary, pictures, sample, fps)


def _write_gif(path: Path, pictures: Iterable[Pixels], sample: Pixels, fps: int) -> None:
    """Write a GIF with a single palette, so that unchanged pixels take no space."""
    from PIL import Image

    palette = Image.fromarray(sample).quantize(_COLORS, Image.Quantize.FASTOCTREE)
    frames = [
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in pictures
    ]
    lasts = [round(1000 / fps)] * (len(frames) - 1) + [round(1000 * _LAST_S)]
    frames[0].save(path, "GIF", save_all=True, append_images=frames[1:], duration=lasts, loop=0)


def _write_mp4(path: Path, pictures: Iterable[Pixels], sample: Pixels, fps: int) -> None:
    import imageio_ffmpeg

    size = sample.shape[1::-1]
    writer = imageio_ffmpeg.write_frames(str(path), size, fps=fps, quality=8, macro_block_size=2)
    with closing(writer):  # stops ffmpeg, even if a picture can't be drawn
        writer.send(None)  # starts the generator
        for picture in pictures:
            writer.send(np.ascontiguousarray(picture))
