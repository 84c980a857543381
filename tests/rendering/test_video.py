"""Tests of video files, which are read back, and of pictures of several policies side by side."""

import sys

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mmwave_env.rendering.picture import Playback, draw_picture
from mmwave_env.rendering.video import require_video, write_video
from tests.refusals import refuses
from tests.rendering.test_picture import history

HEIGHT = 60
WIDTH = 100
COUNT = 7


def square(number):
    """Return a picture of a square that moves to the right."""
    picture = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    picture[20:40, 10 * number : 10 * number + 20] = (0, 114, 178)
    return picture


def gif(path):
    """Return the pictures (n, height, width, 3) of a GIF, and the duration of each in ms."""
    image = pytest.importorskip("PIL.Image")
    pictures = []
    lasts = []
    with image.open(path) as file:
        for number in range(file.n_frames):
            file.seek(number)
            pictures.append(np.asarray(file.convert("RGB")))
            lasts.append(file.info["duration"])
    return np.array(pictures), lasts


def mp4(path):
    """Return the pictures (n, height, width, 3) of an MP4 file, and their rate per second."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    reader = ffmpeg.read_frames(str(path))
    about = next(reader)
    width, height = about["size"]
    pictures = np.frombuffer(b"".join(reader), np.uint8).reshape(-1, height, width, 3)
    return pictures, about["fps"]


def written(path):
    require_video("out", path)
    pictures = [square(number) for number in range(COUNT)]
    write_video(path, iter(pictures), pictures[0], 5)
    assert list(path.parent.iterdir()) == [path]
    return path


def test_a_gif_has_every_picture(tmp_path):
    pytest.importorskip("PIL")
    pictures, lasts = gif(written(tmp_path / "square.gif"))
    assert_array_equal(pictures, [square(number) for number in range(COUNT)])
    assert lasts[:-1] == [200] * (COUNT - 1) and lasts[-1] > 1000


def test_an_mp4_has_every_picture(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    pictures, fps = mp4(written(tmp_path / "square.mp4"))
    assert pictures.shape == (COUNT, HEIGHT, WIDTH, 3) and fps == 5
    blue = pictures[:, 30, :, 0] < 100
    assert blue.argmax(axis=1).tolist() == pytest.approx([10 * n for n in range(COUNT)], abs=2)


@pytest.mark.parametrize(("package", "ending"), [("PIL", "gif"), ("imageio_ffmpeg", "mp4")])
def test_a_video_is_refused_if_its_package_is_not_installed(package, ending, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    with refuses("out", error=ImportError):
        require_video("out", tmp_path / f"square.{ending}")


def leaving(error_m):
    """Return the history of a user at rest, from whom the estimate moves away."""
    away = [(error_m * k, 0.0) for k in range(1, 6)]
    return history([(0.0, 0.0)] * 5, away, [0] * 5, anchors=[(50.0, 30.0, 10.0)])


def test_pictures_side_by_side_equal_the_single_pictures():
    histories = [leaving(1.0), leaving(4.0), leaving(2.0)]
    titles = ["one", "two", "three"]
    playback = Playback(histories, [["ekf"]] * 3, titles, 480, "dark")
    for epochs in (0, 3, 5):
        whole = playback.draw(epochs)
        assert whole.shape == (480, 3 * 480, 3)
        known = [each.part(slice(epochs + 1)) for each in histories]
        for number, title in enumerate(titles):
            part = whole[:, number * 480 : (number + 1) * 480]
            alone = draw_picture(known[number], ["ekf"], 480, "dark", title, known)
            assert_array_equal(part[:, 4:], alone[:, 4:])  # without the gap at the left


def test_errors_side_by_side_have_the_same_scale():
    near = leaving(0.1)
    far = leaving(30.0)
    ticks = np.s_[300:380, 452:]  # labels beside the strips of speed and error
    whole = Playback([near, far], [["ekf"]] * 2, ["near", "far"], 480, "light").draw(5)
    of_near = whole[:, :480][ticks]
    of_far = whole[:, 480:][ticks]
    assert_array_equal(of_near, of_far)
    alone = draw_picture(near, ["ekf"], 480, "light", "near")
    assert (alone[ticks] != of_near).any()
