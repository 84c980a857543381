"""Tests that only regular files of limited size are read, and that no file is half written."""

import errno
import json
import os
import socket
import stat
from pathlib import Path

import pytest

from mmwave_env.io.files import (
    JSON_BYTES,
    atomic_path,
    open_regular,
    parse_json,
    read_bounded,
    read_json,
    read_text,
    require_writable,
    write_bytes,
    write_json,
    write_text,
)
from tests.refusals import refuses

posix = pytest.mark.skipif(os.name != "posix", reason="needs the modes, links and FIFOs of POSIX")


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_gets_its_name_only_when_it_is_complete(tmp_path):
    path = tmp_path / "new" / "log.csv.gz"
    with atomic_path(path) as temporary:
        assert temporary.parent == path.parent and temporary.name.endswith(".log.csv.gz")
        temporary.write_bytes(b"numbers")
        assert not path.exists()
    assert path.read_bytes() == b"numbers" and names(path.parent) == ["log.csv.gz"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_write_that_fails_leaves_the_old_file_unchanged(tmp_path, error):
    path = tmp_path / "log.csv"
    path.write_text("old")

    def write():
        with atomic_path(path) as temporary:
            temporary.write_text("half of the ne")
            raise error

    with pytest.raises(error):
        write()
    assert path.read_text() == "old" and names(tmp_path) == ["log.csv"]


def test_writing_text_bytes_or_json_replaces_an_existing_file(tmp_path):
    write_text(tmp_path / "a.txt", "one\n")
    write_text(tmp_path / "a.txt", "für\n")
    assert (tmp_path / "a.txt").read_bytes() == "für\n".encode()
    write_json(tmp_path / "a.json", {"ate_m": 0.5})
    assert json.loads((tmp_path / "a.json").read_text()) == {"ate_m": 0.5}
    write_bytes(tmp_path / "a.bin", b"\r\n\xff")
    assert (tmp_path / "a.bin").read_bytes() == b"\r\n\xff"
    assert names(tmp_path) == ["a.bin", "a.json", "a.txt"]


def test_folders_devices_and_links_to_devices_are_not_written(tmp_path):
    require_writable(tmp_path / "new" / "a.json")
    assert names(tmp_path / "new") == []
    link = tmp_path / "a.json"
    link.symlink_to(os.devnull)
    for path in (tmp_path, Path(os.devnull), link):
        for write in (require_writable, lambda path: write_text(path, "{}")):
            with refuses(path, error=OSError):
                write(path)
    assert names(tmp_path) == ["a.json", "new"] and link.is_symlink()


# --- permissions of written files, and links


@pytest.fixture
def umask():
    """Return a function that sets the umask; restore the old umask after the test."""
    before = os.umask(0o022)
    yield os.umask
    os.umask(before)


def mode_of(path):
    return stat.S_IMODE(path.stat().st_mode)


@posix
@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_a_new_file_has_the_permissions_that_the_umask_allows(tmp_path, umask, mask, mode):
    umask(mask)
    write_text(tmp_path / "where.tum", "0 1 2 3 0 0 0 1")
    assert mode_of(tmp_path / "where.tum") == mode


@posix
@pytest.mark.parametrize("mode", [0o600, 0o640, 0o666, 0o444])
def test_a_file_that_is_replaced_keeps_its_permissions(tmp_path, umask, mode):
    path = tmp_path / "where.tum"
    path.write_text("old")
    path.chmod(mode)
    with atomic_path(path) as temporary:
        assert mode_of(temporary) == 0o600  # other users can't read an incomplete file
        temporary.write_text("new")
    assert (path.read_text(), mode_of(path)) == ("new", mode)


@posix
@pytest.mark.parametrize("exists", [True, False])
def test_writing_to_a_link_writes_the_file_that_it_points_to(tmp_path, exists):
    (tmp_path / "store").mkdir()
    target = tmp_path / "store" / "a.json"
    link = tmp_path / "a.json"
    if exists:
        target.write_text("old")
    link.symlink_to(target)
    require_writable(link)
    write_json(link, {"ate_m": 0.5})
    assert link.is_symlink() and json.loads(target.read_text()) == {"ate_m": 0.5}
    assert names(tmp_path) == ["a.json", "store"] and names(target.parent) == ["a.json"]


# --- errors name the file that the user gave


def test_errors_never_name_a_temporary_file(tmp_path, monkeypatch):
    path = tmp_path / "a"
    with pytest.raises(FileNotFoundError) as error, atomic_path(path) as temporary:
        temporary.unlink()
    assert error.value.filename == str(path)

    def refused(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "tmpxyz"))

    monkeypatch.setattr("tempfile.TemporaryFile", refused)
    with pytest.raises(PermissionError) as error:
        require_writable(path)
    assert error.value.filename == str(path)


# --- reading


@pytest.fixture(params=["folder", "FIFO", "device", "socket"])
def special(request, tmp_path):
    """Return a path that is not a regular file."""
    path = tmp_path / "odd.json"
    if request.param == "folder":
        path.mkdir()
    elif os.name != "posix":
        pytest.skip("needs POSIX")
    elif request.param == "FIFO":
        os.mkfifo(path)
    elif request.param == "device":
        path.symlink_to("/dev/zero")
    else:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(os.path.relpath(path))
    return path


def test_a_path_that_is_not_a_regular_file_is_refused_before_it_is_opened(special):
    for read in (open_regular, lambda p: read_bounded(p, 10), lambda p: read_json(p, "a", dict)):
        with refuses(special, error=OSError):
            read(special)


def test_the_error_about_a_missing_file_names_the_file(tmp_path):
    for path in (tmp_path / "a", tmp_path / "a\0b"):
        with refuses(path, error=FileNotFoundError):
            open_regular(path, "a log")


def test_a_file_larger_than_the_limit_is_refused(tmp_path):
    path = tmp_path / "long"
    path.write_bytes(b"12345")
    assert read_bounded(path, 5) == b"12345"
    with refuses(path, error=OSError):
        read_bounded(path, 4, "a log")
    with path.open("wb") as file:  # a sparse file takes no space on the disk
        file.truncate(JSON_BYTES + 1)
    with refuses(path, error=OSError):
        read_json(path, "a scene", dict)


def test_text_is_read_as_utf8_with_or_without_a_byte_order_mark(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes(b"\xef\xbb\xbft,x\r\n\xc3\xa9")
    assert read_text(path) == "t,x\r\né"
    path.write_bytes(b"t,x\n1,\xff")
    with refuses(path, "line 2"):
        read_text(path)


def test_json_is_refused_if_a_key_occurs_twice():
    with refuses("noise"):
        parse_json('{"a": [{"noise": 1, "b": 2, "noise": 1}]}')


def test_json_is_refused_if_it_is_nested_too_deeply():
    for begin, end in (("[", "]"), ('{"a":', "}")):
        assert parse_json(begin * 50 + "1" + end * 50)
        with pytest.raises(ValueError, match="deep"):
            parse_json(begin * 100_000 + "1" + end * 100_000)


# JSON with a number that is read as infinity, which int() can't convert
TOO_LARGE = '{"modes": [1' + "0" * 299 + "0.0e99]}"


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"modes": 5}', TOO_LARGE])
def test_an_error_in_converting_json_names_the_file(tmp_path, content):
    path = tmp_path / "m.json"
    path.write_text(content)
    with refuses(path):
        read_json(path, "a mode file", lambda read: [int(mode) for mode in read["modes"]])
    path.write_text('{"modes": [1.0]}')
    assert read_json(path, "a mode file", lambda read: read["modes"]) == [1.0]
