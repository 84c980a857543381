"""Files of results: whole or not there."""

import json
import os
from pathlib import Path

import pytest

from mmwave_env.files import (
    atomic_folder,
    atomic_path,
    require_writable,
    write_bytes,
    write_json,
    write_text,
)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_takes_its_place_at_the_end(tmp_path):
    path = tmp_path / "new" / "log.csv.gz"
    with atomic_path(path) as temporary:
        assert temporary.parent == path.parent and temporary.name.endswith(".log.csv.gz")
        temporary.write_bytes(b"numbers")
        assert not path.exists()
    assert path.read_bytes() == b"numbers" and names(path.parent) == ["log.csv.gz"]
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_block_that_fails_leaves_everything_as_it_was(tmp_path, error):
    path = tmp_path / "log.csv"
    path.write_text("old")

    def write():
        with atomic_path(path) as temporary:
            temporary.write_text("half of the ne")
            raise error

    with pytest.raises(error):
        write()
    assert path.read_text() == "old" and names(tmp_path) == ["log.csv"]


def test_a_block_may_fail_after_its_file_is_gone(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "log.csv") as temporary:
        temporary.unlink()
    assert names(tmp_path) == []


def test_a_folder_takes_its_place_at_the_end_and_that_of_an_old_one(tmp_path):
    path = tmp_path / "new" / "set-v0"
    for name in ("first", "second"):
        with atomic_folder(path) as beside:
            assert beside.name == "set-v0" and names(beside) == []
            (beside / name).write_text("numbers")
            assert not (path / name).exists()
        assert names(path) == [name] and names(path.parent) == ["set-v0"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_folder_that_is_not_filled_leaves_everything_as_it_was(tmp_path, error):
    path = tmp_path / "set-v0"
    path.mkdir()
    (path / "old").write_text("old")

    def fill():
        with atomic_folder(path) as beside:
            (beside / "half").write_text("of the new")
            raise error

    with pytest.raises(error):
        fill()
    assert names(path) == ["old"] and names(tmp_path) == ["set-v0"]


def test_text_bytes_and_json_replace_what_was_there(tmp_path):
    write_text(tmp_path / "a.txt", "one\n")
    write_text(tmp_path / "a.txt", "für\n")
    assert (tmp_path / "a.txt").read_bytes() == "für\n".encode()
    write_json(tmp_path / "a.json", {"ate_m": 0.5})
    assert json.loads((tmp_path / "a.json").read_text()) == {"ate_m": 0.5}
    write_bytes(tmp_path / "a.bin", b"\r\n\xff")
    assert (tmp_path / "a.bin").read_bytes() == b"\r\n\xff"
    assert names(tmp_path) == ["a.bin", "a.json", "a.txt"]


def test_what_is_no_file_is_not_written(tmp_path):
    require_writable(tmp_path / "new" / "a.json")
    assert names(tmp_path / "new") == []
    for path, found in ((tmp_path, "a folder"), (os.devnull, "a device")):
        with pytest.raises(OSError, match=f"found {found}, expected a file"):
            require_writable(Path(path))
