"""Compiled programs are kept in the user's cache folder, unless somebody has decided otherwise."""

import os
import pathlib
import subprocess
import sys

import jax
import pytest
from seams import replace_seam

from diffabs.host import compilation_cache as compiled


@pytest.fixture
def user(tmp_path, monkeypatch):
    """A user who has decided nothing, and the home."""
    before = jax.config.jax_compilation_cache_dir, jax.config.jax_persistent_cache_min_compile_time_secs
    for name in (
        *compiled.USER_VARIABLES,
        compiled.OFF_VARIABLE,
        "XDG_CACHE_HOME",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    ):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    jax.config.update("jax_compilation_cache_dir", None)
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before[0])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", before[1])


@pytest.mark.parametrize(
    ("system", "variable", "folder"),
    [
        ("linux", None, ".cache"),
        ("linux", "XDG_CACHE_HOME", "given"),
        ("darwin", None, "Library/Caches"),
        ("darwin", "XDG_CACHE_HOME", "Library/Caches"),
        ("win32", None, "AppData/Local"),
        ("win32", "LOCALAPPDATA", "given"),
    ],
)
def test_where_each_system_wants_it(user, monkeypatch, system, variable, folder):
    monkeypatch.setattr(sys, "platform", system)
    if variable:
        monkeypatch.setenv(variable, str(user / "given"))
    found = compiled.use_compilation_cache()
    assert found.parent == user / folder / "diffabs"
    assert found.is_dir()
    assert jax.config.jax_compilation_cache_dir == str(found)
    assert jax.config.jax_persistent_cache_min_compile_time_secs == compiled.WORTH


def test_a_relative_folder_is_none(user, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "here")
    assert compiled.use_compilation_cache().parent == user / ".cache" / "diffabs"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        (compiled.OFF_VARIABLE, "1"),
        ("JAX_COMPILATION_CACHE_DIR", "elsewhere"),
        ("JAX_ENABLE_COMPILATION_CACHE", "false"),
    ],
)
def test_who_has_decided_is_asked_no_more(user, monkeypatch, name, value):
    monkeypatch.setenv(name, value)
    assert compiled.use_compilation_cache() is None
    assert jax.config.jax_compilation_cache_dir is None
    assert not list(user.iterdir())


def test_a_folder_of_jaxs_own_stays(user):
    jax.config.update("jax_compilation_cache_dir", "mine")
    assert compiled.use_compilation_cache() is None
    assert jax.config.jax_compilation_cache_dir == "mine"


def test_a_folder_that_cannot_be_made_is_no_cache(user):
    (user / ".cache").write_text("a file")
    assert compiled.use_compilation_cache() is None
    assert jax.config.jax_compilation_cache_dir is None


def test_a_folder_that_cannot_be_written_is_no_cache(user, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert compiled.use_compilation_cache() is None
    assert jax.config.jax_compilation_cache_dir is None


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="Windows has no such modes")
def test_a_folder_that_others_may_write_to_is_no_cache(user, caplog):
    folder = compiled.use_compilation_cache()
    folder.chmod(0o777)
    jax.config.update("jax_compilation_cache_dir", None)
    assert compiled.use_compilation_cache() is None
    assert jax.config.jax_compilation_cache_dir is None
    assert [record.message for record in caplog.records] == [
        f"{folder}: compiled programs are not kept there, because other users may write to it"
    ]


def test_the_oldest_half_goes_where_there_is_too_much(user, monkeypatch):
    folder = compiled.use_compilation_cache()
    for i in range(4):
        path = folder / f"{i}-cache"
        path.write_bytes(bytes(10))
        os.utime(path, (i, i))
    replace_seam(monkeypatch, "compiled_room", 40)
    jax.config.update("jax_compilation_cache_dir", None)
    assert compiled.use_compilation_cache() == folder
    assert len(list(folder.iterdir())) == 4
    replace_seam(monkeypatch, "compiled_room", 39)
    jax.config.update("jax_compilation_cache_dir", None)
    assert compiled.use_compilation_cache() == folder
    assert {path.name for path in folder.iterdir()} == {"2-cache", "3-cache"}


@pytest.mark.slow
def test_commands_share_what_they_compile(tmp_path):
    """The same answer without a cache, from an empty one, a full one and a damaged one, and nothing said of it."""

    def simulated(**more):
        left = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
        command = [sys.executable, "-m", "diffabs", "simulate", "slip-lmi", "--json", "--quiet"]
        done = subprocess.run(command, env=left | more, capture_output=True, text=True, check=True)
        assert done.stderr == ""
        return done.stdout

    def entries() -> set[pathlib.Path]:
        return {path for path in tmp_path.rglob("*") if path.is_file()}

    home = {"XDG_CACHE_HOME": str(tmp_path)}
    alone = simulated(**home, DIFFABS_NO_CACHE="1")
    assert not entries()
    assert simulated(**home) == alone
    first = entries()
    assert first
    assert simulated(**home) == alone
    assert entries() == first
    for path in first:
        path.write_bytes(path.read_bytes()[:100])
    assert simulated(**home) == alone
