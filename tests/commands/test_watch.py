"""Tests of ``mmwave-loc watch``, which shows episodes in a window or writes them as videos."""

import re
import shlex
import sys

import pytest

from tests.cli import assert_refused, succeed
from tests.paths import ROOT

pytest.importorskip("pygame")
from tests.rendering.test_video import gif

SHORT = ("--episode-steps", 12)


@pytest.fixture
def window(monkeypatch):
    """Return a list that collects the pictures that a window would show on a display."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    from mmwave_env.rendering.window import Window

    shown = []
    monkeypatch.setattr(Window, "show", lambda _, picture: shown.append(picture))
    return shown


def test_policies_are_shown_side_by_side_and_the_first_picture_shows_the_prior(tmp_path):
    out = tmp_path / "new" / "both.gif"
    words = ("--policies", "fixed-ekf", "imm", *SHORT, "--seed", 3, "--render-size", 500)
    shown = succeed("watch", *words, "--out", out)
    pictures, _ = gif(out)
    assert pictures.shape == (13, 500, 1000, 3)
    title, first, second, written = shown.splitlines()
    assert re.fullmatch(r"\w+, seed 3, 0 to 11 s", title)
    assert re.fullmatch(r"fixed-ekf: [\d.]+ m off on average, [\d.]+ m at most", first)
    assert second.startswith("imm: ") and written == f"written to {out}: 13 pictures"


def test_a_part_of_a_recording_or_of_a_log_can_be_played(tmp_path, window):
    part = ("--policies", "fixed-ukf", "--begin", 3, "--end", 8)
    succeed("watch", "--data", "canyon28_pedestrian", *part)
    succeed("simulate", *SHORT, "--out", tmp_path / "ride")
    before = len(window)
    assert succeed("watch", "--data", tmp_path / "ride", *part).startswith("ride, seed 0, 3 to 8 s")
    assert before > 0 and len(window) - before == 6


def test_closing_the_window_ends_the_command(monkeypatch, window):
    from mmwave_env.rendering.window import Window

    def show(self, picture):
        window.append(picture)
        self.close()

    monkeypatch.setattr(Window, "show", show)
    succeed("watch", "--policies", "fixed-ukf", *SHORT)
    assert len(window) == 1


MISTAKES = {  # name -> options, expected message
    "unknown policy": (("--policies", "oracle"), "policy: found 'oracle', expected one of"),
    "too many policies": (("--policies", *["imm"] * 4), "policies: found 4, expected 1 to 3$"),
    "unknown ending": (("--out", "video.avi"), "out: found video.avi, expected.*.gif or .mp4$"),
    "no pictures per second": (("--fps", 0), "fps: found 0, expected 1 to 50$"),
    "begin after the end": (("--begin", 9000), "begin, end: found 9000 to inf s, expected.*199 s"),
}  # fmt: skip


@pytest.mark.usefixtures("window")
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_ends_with_one_clear_line(mistake, tmp_path):
    words, message = MISTAKES[mistake]
    if "--policies" not in words:
        words = ("--policies", "fixed-ekf", "fixed-ukf", *words)
    assert_refused(f"^mmwave-loc watch: {message}", "watch", *words, cwd=tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="other systems need no display variable")
def test_the_error_without_a_display_names_the_variables_and_the_option_out(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER", "SDL_VIDEO_DRIVER"):
        monkeypatch.delenv(name, raising=False)
    assert_refused("found no display.*DISPLAY or WAYLAND_DISPLAY.*--out", "watch")


@pytest.mark.slow
def test_the_documented_command_makes_the_shipped_animation(tmp_path):
    pages = {path.name: path.read_text("utf-8") for path in (ROOT / "docs").glob("*.md")}
    (line,) = re.findall(r"^mmwave-loc (watch .*docs/watch.gif)$", pages["commands.md"], re.M)
    file = tmp_path / "watch.gif"
    shown = succeed(*shlex.split(line.replace("docs/watch.gif", str(file))))
    made, _ = gif(file)
    shipped, _ = gif(ROOT / "docs" / "watch.gif")
    assert made.shape == shipped.shape
    # Bytes are not compared, because math libraries, font engines and palettes differ slightly.
    for number in (0, 20, -1):
        differs = abs(made[number].astype(int) - shipped[number]) > 4
        assert differs.any(axis=-1).mean() < 0.01
    rule, learned = (float(n) for n in re.findall(r": ([\d.]+) m off on average", shown))
    assert learned < 3.0 < rule
