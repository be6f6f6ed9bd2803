"""Files and folders that are replaced: by a process that is killed, and by two processes at once."""

import errno
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading

import pytest
from commands import file_size_limit, left_in
from mutants import killed_by

from diffabs.host import files

# It replaces a folder, and is killed before the rename of this number. The module needs only the standard library.
REPLACE = """
import os, pathlib, runpy, signal, sys

module, folder, count = sys.argv[1:]
renames = 0

def kill(event, arguments):
    global renames
    renames += event == "os.rename"
    if renames == int(count):
        os.kill(os.getpid(), signal.SIGKILL)

files = runpy.run_path(module)
with files["new_folder"](pathlib.Path(folder)) as new:
    (new / "content").write_text("new")
    sys.addaudithook(kill)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux exchanges two folders in one step")
@killed_by("host.files", "if _exchange(new, target):", "if False:")
def test_a_killed_process_leaves_a_whole_folder(tmp_path):
    """The old one or the new one, whichever step it is killed before."""
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "content").write_text("old")
    for count in range(1, 4):
        done = subprocess.run([sys.executable, "-c", REPLACE, files.__file__, folder, str(count)], check=False)
        assert done.returncode in (0, -signal.SIGKILL)
        assert (folder / "content").read_text() in ("old", "new")
    assert (folder / "content").read_text() == "new"


@killed_by("host.files", "target.exists():\n            if _exchange", "False:\n            if _exchange")
def test_a_folder_without_an_exchange_is_replaced(tmp_path, monkeypatch):
    """As on other systems, in two steps."""
    monkeypatch.setattr(sys, "platform", "other")
    for content in ("old", "new"):
        with files.new_folder(tmp_path / "folder") as new:
            (new / content).touch()
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["new"]
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


@killed_by("host.files", "if parent.exists()", "if not parent.mkdir(parents=True, exist_ok=True)")
@killed_by("host.files", "        target.parent.mkdir(parents=True, exist_ok=True)\n", "")
def test_parents_of_a_folder_are_made_at_the_end(tmp_path):
    with pytest.raises(KeyboardInterrupt), files.new_folder(tmp_path / "out" / "paper"):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    with files.new_folder(tmp_path / "out" / "paper") as new:
        (new / "content").touch()
    assert [path.name for path in (tmp_path / "out" / "paper").iterdir()] == ["content"]
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "paper", "content"]


@killed_by("host.files", "target.exists() and not target.is_dir()", "False")
@killed_by("host.files", "target.exists() and not target.is_file()", "False")
def test_what_is_no_file_or_folder_is_not_replaced(tmp_path):
    """A pipe, a folder in place of a file, and a file in place of a folder."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").write_text("mine")
    for target in (tmp_path / "pipe", tmp_path):
        with pytest.raises(OSError, match="not a regular file"):
            files.write_file(target, b"new")
    with pytest.raises(NotADirectoryError), files.new_folder(tmp_path / "file"):
        pass
    assert (tmp_path / "pipe").is_fifo()
    assert (tmp_path / "file").read_text() == "mine"


@killed_by("host.files", 'new_file(target, ".tmp")', "new_file(target)")
@killed_by("host.files", "os.path.dirname(os.path.realpath(target))", "target.parent")
@killed_by(
    "host.files",
    "realpath(target))\n    if target.exists() and not target.is_file",
    "fspath(target))\n    if target.exists() and not target.is_file",
)
@killed_by(
    "host.files",
    "realpath(target))\n    if target.exists() and not target.is_dir",
    "fspath(target))\n    if target.exists() and not target.is_dir",
)
def test_what_a_link_points_to_is_replaced(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", lambda at: synced.append((os.fstat(at).st_ino, len([*tmp_path.glob(".*.tmp")]))))
    (tmp_path / "file").write_text("old")
    (tmp_path / "folder").mkdir()
    (links := tmp_path / "links").mkdir()
    for name in ("file", "folder"):
        (links / f"to {name}").symlink_to(tmp_path / name)
    files.write_durably(links / "to file", b"new")
    with files.new_folder(links / "to folder") as new:
        (new / "content").touch()
    assert (tmp_path / "file").read_text() == "new"
    assert [one.name for one in (tmp_path / "folder").iterdir()] == ["content"]
    assert all((links / f"to {name}").is_symlink() for name in ("file", "folder"))
    assert synced == [((tmp_path / "file").stat().st_ino, 1), (tmp_path.stat().st_ino, 0)]


@killed_by("host.files", ".{secrets.token_hex(4)}{suffix or target.suffix}", ".{suffix or target.suffix}")
def test_several_writers_of_a_file_do_not_disturb_each_other(tmp_path):
    path, contents, wrong = tmp_path / "summary.json", [letter * 200_000 for letter in (b"a", b"b")], []

    def write(content):
        try:
            for _ in range(20):
                files.write_synced(path, content)
        except OSError as error:
            wrong.append(error)

    threads = [threading.Thread(target=write, args=(content,)) for content in contents]
    files.write_synced(path, contents[0])
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        assert path.read_bytes() in contents
    for thread in threads:
        thread.join()
    assert wrong == []
    assert [one.name for one in tmp_path.iterdir()] == ["summary.json"]


def write_figure_like(target):
    """As a library writes: it opens the temporary file itself."""
    with files.new_file(target) as temporary, temporary.open("wb") as file:
        file.write(b"new")


def write_into_folder(target):
    with files.new_folder(target) as new:
        (new / "content").write_bytes(b"new")


@killed_by("host.files", "(named is None or inside)", "False")
@pytest.mark.parametrize("write", [files.write_file, files.write_durably, write_figure_like, write_into_folder])
def test_a_full_disk_names_the_file_and_leaves_nothing(tmp_path, write):
    target = tmp_path / "target"
    with file_size_limit(1), pytest.raises(OSError, match="File too large") as caught:
        write(target, b"new") if write in (files.write_file, files.write_durably) else write(target)
    assert files.describe_error(caught.value) == f"{target}: File too large"
    assert left_in(tmp_path) == set()


def test_a_full_folder_of_the_system_is_named(tmp_path, monkeypatch):
    """The file that is written beside it is another one, and not to blame."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with file_size_limit(1), pytest.raises(OSError, match="File too large") as caught:  # noqa: SIM117
        with files.new_file(tmp_path / "target"), files.temporary_folder("work-") as folder:
            (folder / "source").write_text("text")
    assert re.fullmatch(rf"{tmp_path}/work-\w+: File too large", files.describe_error(caught.value))
    assert left_in(tmp_path) == set()


@killed_by("host.files", "error.errno in DISK_ERRORS and", "")
def test_an_error_that_is_not_of_the_disk_names_no_file(tmp_path):
    with pytest.raises(OSError, match="refused") as caught, files.new_file(tmp_path / "target"):
        raise ConnectionRefusedError(errno.ECONNREFUSED, "refused")
    assert caught.value.filename is None
