"""Files and folders that are replaced: by a process that is killed, and by two processes at once."""

import signal
import subprocess
import sys
import threading

import pytest
from mutants import killed_by

from diffabs.runtime import files

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
@killed_by("runtime/files.py", "if _exchange(new, target):", "if False:")
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


@killed_by("runtime/files.py", "target.exists():\n            if _exchange", "False:\n            if _exchange")
def test_a_folder_without_an_exchange_is_replaced(tmp_path, monkeypatch):
    """As on other systems, in two steps."""
    monkeypatch.setattr(sys, "platform", "other")
    for content in ("old", "new"):
        with files.new_folder(tmp_path / "folder") as new:
            (new / content).touch()
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["new"]
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


@killed_by("runtime/files.py", ".{secrets.token_hex(4)}{target.suffix}", ".{target.suffix}")
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
