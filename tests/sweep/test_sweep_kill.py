"""What a sweep survives: kills, a full disk, damaged files, another configuration, Ctrl-C. It goes on to the same
table, to the bit, or is refused in one line."""

import errno
import hashlib
import json
import os
import pathlib
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from typing import NamedTuple

import numpy as np
import pytest
from commands import assert_one_error_line, left_in, run
from marks import readable_id
from sweeping import PATIENCE, SCENARIO, chunks, command, environment, manifest, started, until

from diffabs.uncertainty.sweep import Results
from diffabs.uncertainty.sweep.manifest import Seals, encode_manifest
from diffabs.uncertainty.sweep.seal import CHUNK_NAME_PATTERN, encode_chunk
from diffabs.uncertainty.sweep.store import Store

pytestmark = pytest.mark.slow  # each computes sweeps; what is wrong with one chunk is also seen in test_sealed

SHORT = SCENARIO.replace("samples = 3200", "samples = 640")
LONG = SCENARIO.replace("step = 1e-3", "step = 5e-4").replace("samples = 3200", "samples = 6400")  # to be killed in it
LEFT = {".lock", "manifest.json", "chunks", "summary.json"}
DAMAGE = {
    "emptied": lambda data: b"",
    "truncated": lambda data: data[: len(data) // 2],
    "one byte short": lambda data: data[:-1],
    "a bit of the first column": lambda data: flipped(data, 10),
    "a bit in the middle": lambda data: flipped(data, len(data) // 2),
    "a bit of the footer": lambda data: flipped(data, len(data) - 20),
    "a bit of the last mark": lambda data: flipped(data, len(data) - 1),
}


def flipped(data, place):
    return data[:place] + bytes([data[place] ^ 4]) + data[place + 1 :]


class Whole(NamedTuple):
    """A run that nothing disturbed."""

    folder: pathlib.Path
    scenario: pathlib.Path
    digest: str
    length: float  # s from its first chunk to its last


@pytest.fixture(scope="module")
def whole(tmp_path_factory, without_load, any_step_is_stable):
    return undisturbed(tmp_path_factory.mktemp("whole"), SHORT)


@pytest.fixture(scope="module")
def longer(tmp_path_factory, without_load, any_step_is_stable):
    return undisturbed(tmp_path_factory.mktemp("longer"), LONG)


def undisturbed(folder, text):
    (folder / "small.toml").write_text(text)
    result = run("sweep", folder / "small.toml", "--out", folder / "out", "--json")
    times = [path.stat().st_mtime for path in (folder / "out/chunks").iterdir()]
    digest = json.loads(result.stdout)["digest"]
    return Whole(folder / "out", folder / "small.toml", digest, max(times) - min(times))


def went_on(scenario, folder):
    """Go on to the end, in a process of its own. The document."""
    done = subprocess.run(
        command(scenario, folder, "--resume"), capture_output=True, text=True, env=environment(), check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture
def copy(whole, tmp_path):
    shutil.copytree(whole.folder, tmp_path / "out")
    return tmp_path / "out"


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# Kills


@pytest.mark.parametrize("kills", [3, 20])
def test_killed_again_and_again(longer, tmp_path, kills):
    """In turns between its chunks, and on its way to the first one."""
    there, survived, start, rng = chunks(longer.folder), [], 0.0, random.Random(2026)
    folders = [tmp_path / "0"]
    while len(survived) < kills:
        before, begun = chunks(folders[-1]), time.monotonic()
        with started(*command(longer.scenario, folders[-1], "--resume")) as process:
            if len(survived) % 2 == 0:
                until(lambda before=before: chunks(folders[-1]) > before, process)
                start = start or time.monotonic() - begun
            time.sleep(rng.random() * (2 * longer.length / kills if len(survived) % 2 == 0 else start))
            process.kill()
        if process.returncode == 0:  # it was finished before
            folders.append(tmp_path / str(len(folders)))
            continue
        assert process.returncode == -signal.SIGKILL
        survived.append(chunks(folders[-1]))
        assert before <= survived[-1] <= there
        for name in survived[-1]:
            data = (folders[-1] / "chunks" / name).read_bytes()
            assert hashlib.sha256(data).hexdigest().startswith(CHUNK_NAME_PATTERN.fullmatch(name)[2])
    assert any(0 < len(names) < len(there) for names in survived)
    for folder in folders:
        assert went_on(longer.scenario, folder)["digest"] == longer.digest
        assert contents(folder / "chunks") == contents(longer.folder / "chunks")
        assert left_in(folder) == LEFT


WRITING = """
import json, os, pathlib, signal, sys
from diffabs.uncertainty.sweep.store import Store

folder, manifest, *data = sys.argv[1:]

def killed_before(name, calls):
    real = getattr(os, name)
    def call(*args, **more):
        calls.append(name)
        return os.kill(os.getpid(), signal.SIGKILL) if len(calls) == LAST else real(*args, **more)
    setattr(os, name, call)

for LAST in range(1, 8):
    store = Store(pathlib.Path(folder) / str(LAST))
    with store.lock():
        if (child := os.fork()) == 0:
            calls = []
            for name in ("fsync", "replace", "rename"):
                killed_before(name, calls)
            store.begin(json.loads(manifest), resume=True)
            for chunk in range(2):
                store.write(chunk, bytes.fromhex(data[chunk]))
            os._exit(0)
        print(os.waitpid(child, 0)[1])
"""


def test_killed_at_each_step_of_writing(tmp_path):
    """Manifest and two chunks: each is written, flushed (1), renamed (2), and its folder flushed (3)."""
    table, seals = manifest(2, 1), Seals(manifest(2, 1))
    values = {name: np.zeros(1, bool if name in ("stopped", "diverged") else float) for name in seals.columns}
    data = [encode_chunk({**values, "sample": np.array([chunk])}, seals.of(chunk)).hex() for chunk in range(2)]
    words = [sys.executable, "-W", "ignore", "-c", WRITING, tmp_path, json.dumps(table), *data]
    done = subprocess.run(words, capture_output=True, check=True)
    assert [int(line) for line in done.stdout.split()] == [signal.SIGKILL] * 7
    for last in range(1, 8):
        store = Store(tmp_path / str(last))
        renamed = [k for k in (2, 5, 8) if k < last]
        with store.lock():
            assert (store.folder / "manifest.json").exists() == (len(renamed) > 0)
            assert len(list(store.chunks.glob("*.parquet"))) == len(renamed[1:])  # also hidden ones, as DuckDB
            store.begin(table, resume=True)
            there, damaged = store.scan(seals)
        assert (sorted(there), damaged) == (list(range(len(renamed) - 1)), [])
        assert not list(store.folder.rglob("*.tmp"))


def test_what_a_kill_leaves_behind(copy, whole):
    """Beginnings of files, also of an earlier diffabs, and a folder of trajectories that were being written."""
    for name in (".manifest.01234567.tmp", "manifest.json.tmp"):
        (copy / name).write_text("{")
    for name in (".part-00000007-0123456789abcdef.01234567.tmp", "part-00000007-0123456789abcdef.parquet.tmp"):
        (copy / "chunks" / name).write_text("PAR1")
    (copy / "trajectories.zarr.tmp").mkdir()
    (copy / "notes.tmp").write_text("mine")
    result = run("sweep", whole.scenario, "--out", copy, "--resume", "--json")
    assert json.loads(result.stdout)["digest"] == whole.digest
    assert left_in(copy) == LEFT | {"trajectories.zarr.tmp", "notes.tmp"}
    assert left_in(copy / "chunks") == chunks(whole.folder)


# Ctrl-C, and another process


def test_control_c_says_how_to_go_on(longer, tmp_path):
    """And meanwhile nobody else may have the folder."""
    folder, long = tmp_path / "out", ("--samples", "64000")  # so that it is not done before the key is pressed
    with started(*command(longer.scenario, folder, *long)) as process:
        assert until(lambda: chunks(folder), process)
        process.send_signal(signal.SIGSTOP)
        second = run("sweep", longer.scenario, "--out", folder, "--resume", *long, status=2)
        assert_one_error_line(second)
        assert second.stderr == f"error: {folder} is in use by another process\n"
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGCONT)
        out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, out) == (130, "")
    lines = err.splitlines()
    assert "interrupted: finishing the chunks in hand (Ctrl-C again: at once)" in lines
    assert lines[-1].startswith(f"interrupted: finished chunks are in {folder}; continue with: diffabs sweep ")
    again = shlex.split(lines[-1].partition("continue with: diffabs ")[2])
    assert again == [*command(longer.scenario, folder, *long)[3:], "--resume"]
    there = chunks(folder)
    assert 0 < len(there) < 1000
    undisturbed = json.loads(run("sweep", longer.scenario, "--out", tmp_path / "other", *long, "--json").stdout)
    assert json.loads(run(*again).stdout)["digest"] == undisturbed["digest"]
    assert there < chunks(folder)


def test_control_c_twice_does_not_wait(longer, tmp_path):
    """For a chunk that takes minutes. What it leaves can be continued."""
    folder = tmp_path / "out"
    endless = ("--set", "solver.step=1e-7", "--set", "sensor.period=1e-3", "--set", "sweep.chunk=4096")
    with started(*command(longer.scenario, folder, *endless)) as process:
        assert until((folder / "manifest.json").exists, process)
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        for line in process.stderr:
            if line.startswith("interrupted: finishing"):
                break
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (130, "", "interrupted\n")
    assert left_in(folder) == {".lock", "manifest.json", "chunks"}
    assert chunks(folder) == set()


# A full disk


def test_a_full_disk(copy, whole, monkeypatch):
    """As the system says it: three chunks are missing, the second of them does not find room."""
    for name in sorted(chunks(copy))[3:6]:
        (copy / "chunks" / name).unlink()
    calls, flush = [], os.fsync

    def full(handle):
        if "part-" in os.readlink(f"/proc/self/fd/{handle}"):
            calls.append(handle)
            if len(calls) == 2:
                raise OSError(errno.ENOSPC, "No space left on device")
        flush(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        result = run("sweep", whole.scenario, "--out", copy, "--resume", "--json", status=1)
    assert_one_error_line(result)
    assert re.fullmatch(
        rf"error: {copy}/chunks/part-\S+: No space left on device; finished chunks are kept; --resume continues\n",
        result.stderr,
    )
    assert chunks(copy) == chunks(whole.folder) - set(sorted(chunks(whole.folder))[4:6])
    assert left_in(copy / "chunks") == chunks(copy)
    document = json.loads(run("sweep", whole.scenario, "--out", copy, "--resume", "--json").stdout)
    assert document["digest"] == whole.digest


FULL = """
set -e
mount -t tmpfs -o size=128k none "$1"
shift
set +e
"$@" 1>&2
status=$?
set -e
ls "$OUT/chunks" | wc -l
echo $status
find "$OUT" -name '*.tmp' | wc -l
mount -o remount,size=64m "${OUT%/*}"
"$@" --resume | grep digest
"""


def test_a_disk_that_is_really_full(longer, tmp_path):
    """A small one, in a name space of its own; then it grows."""
    allowed = ["unshare", "-rm", "mount", "-t", "tmpfs", "none", str(tmp_path)]
    if shutil.which("unshare") is None or subprocess.run(allowed, capture_output=True, check=False).returncode:
        pytest.skip("no name space with a file system of its own (unshare -rm) here")
    out = tmp_path / "out"
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-c", FULL, "sh", str(tmp_path), *command(longer.scenario, out)],
        capture_output=True,
        text=True,
        env=environment() | {"OUT": str(out)},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    count, status, unfinished, digest = done.stdout.splitlines()
    assert (0 < int(count) < 100, status, unfinished) == (True, "1", "0")
    assert longer.digest in digest
    lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert re.fullmatch(rf"error: {out}/\S+: No space left on device; finished chunks .* --resume continues", lines[0])
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("size", [0, 3])
def test_a_disk_that_is_full_before_it_begins(whole, tmp_path, monkeypatch, size):
    """Neither folder nor manifest find room."""

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    folder = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(*((pathlib.Path, "mkdir") if size == 0 else (os, "fsync")), full)
        result = run("sweep", whole.scenario, "--out", folder, status=2 if size == 0 else 1)
    assert_one_error_line(result)
    assert "No space left on device" in result.stderr
    assert not (folder / "manifest.json").exists()


# Damaged files


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_chunk_is_found(copy, how):
    path = sorted((copy / "chunks").iterdir())[1]
    data = path.read_bytes()
    path.write_bytes(DAMAGE[how](data))
    assert path.read_bytes() != data
    there, damaged = Store(copy).scan(Seals(json.loads((copy / "manifest.json").read_text())))
    assert (sorted(there), damaged) == ([0, *range(2, 10)], [1])
    assert not path.exists()


@pytest.mark.parametrize(
    "how",
    ["a bit in the middle", "truncated", "a bit of the footer"],
)
def test_a_damaged_chunk_is_computed_again(copy, whole, how):
    path = sorted((copy / "chunks").iterdir())[1]
    data = path.read_bytes()
    path.write_bytes(DAMAGE[how](data))
    result = run("sweep", whole.scenario, "--out", copy, "--resume", "--json")
    assert json.loads(result.stdout)["digest"] == whole.digest
    assert result.stderr == "damaged, computed again: chunk 1\n"
    assert path.read_bytes() == data


def test_chunks_that_are_gone_or_damaged_together(copy, whole):
    names = sorted(chunks(copy))
    (copy / "chunks" / names[0]).unlink()
    for name in (names[2], names[-1]):
        (copy / "chunks" / name).write_bytes(b"")
    (copy / "chunks" / "merged.parquet").write_bytes(b"mine")
    result = run("sweep", whole.scenario, "--out", copy, "--resume", "--json")
    assert json.loads(result.stdout)["digest"] == whole.digest
    assert f"damaged, computed again: chunks 2, {len(names) - 1}\n" in result.stderr
    assert f"warning: {copy / 'chunks' / 'merged.parquet'} is not a chunk of this sweep" in result.stderr
    assert (copy / "chunks" / "merged.parquet").read_bytes() == b"mine"


# Another configuration


CHANGED = [
    (("--seed", "4"), "study.seed is 3 there, 4 here"),
    (("--samples", "641"), "study.samples is 640 there, 641 here"),
    (("--set", "sweep.chunk=128"), "study.chunk is 64 there, 128 here"),
    (("--set", "sweep.dtype=float32"), 'study.dtype is "float64" there, "float32" here'),
    (("--set", "solver.step=5e-4"), "study.solver.step is 0.001 there, 0.0005 here"),
    (("--set", "sensor.slip=0.006"), "study.loop.sensor.slip is 0.005 there, 0.006 here"),
    (("--set", "controller.gain=-4000,-41"), "study.loop.controller.gain is [-4000.0, -40.0] there"),
    (("--set", "sweep.over.plant.mass=5.3:6.3"), 'study.space.variables.plant.mass.high is 6.2 there, 6.3 here'),
    (("--set", "sweep.design=sobol"), 'study.space.design.type is "random" there, "sobol" here'),
    (("--set", "sweep.failures.overshoot=0.5"), "study.failures.overshoot is null there, 0.5 here"),
]  # fmt: skip
KERNEL = (("--engine", "kernel"), 'study.engine.name is "xla" there, "kernel" here')


@pytest.mark.parametrize(
    ("changes", "needed"),
    [*CHANGED, KERNEL],
    ids=[readable_id(needed) for _, needed in [*CHANGED, KERNEL]],
)
def test_another_configuration_is_refused(whole, changes, needed):
    before = contents(whole.folder)
    result = run("sweep", whole.scenario, "--out", whole.folder, "--resume", *changes, status=2)
    assert_one_error_line(result)
    assert f"{whole.folder} holds another sweep: " in result.stderr
    assert needed in result.stderr
    assert contents(whole.folder) == before


def changed(written, change):
    """A manifest after one change."""
    there = json.loads(written)
    if change == "versions":
        there["versions"]["jax"] = "0.1"
    elif change == "mass":
        there["study"]["loop"]["plant"]["wheel_radius"] = 0.1
    elif change == "commit":
        there["commit"] = "0123456789ab"
    del there["digest"]
    return encode_manifest(there).decode()


@pytest.mark.parametrize(
    ("change", "needed"),
    [
        ("versions", 'versions.jax is "0.1" there, '),
        ("mass", "study.loop.plant.wheel_radius is 0.1 there, 0.0995 here"),
    ],
)
def test_a_manifest_from_another_configuration_is_refused(copy, whole, change, needed):
    (copy / "manifest.json").write_text(changed((copy / "manifest.json").read_text(), change))
    before = contents(copy)
    result = run("sweep", whole.scenario, "--out", copy, "--resume", status=2)
    assert_one_error_line(result)
    assert f"{copy} holds another sweep: {needed}" in result.stderr
    assert contents(copy) == before


def test_another_commit_is_not_another_configuration(copy, whole):
    (copy / "manifest.json").write_text(changed((copy / "manifest.json").read_text(), "commit"))
    document = json.loads(run("sweep", whole.scenario, "--out", copy, "--resume", "--json").stdout)
    assert document["digest"] == whole.digest == Results(copy).digest


@pytest.mark.parametrize("how", ["truncated", "a bit in the middle", "gone"])
def test_a_manifest_that_is_damaged_is_refused(copy, whole, how):
    path = copy / "manifest.json"
    path.write_bytes(DAMAGE[how](path.read_bytes())) if how != "gone" else path.unlink()
    before = contents(copy)
    result = run("sweep", whole.scenario, "--out", copy, "--resume", status=2)
    assert_one_error_line(result)
    assert str(copy) in result.stderr
    assert contents(copy) == before


def test_the_table_is_not_trivial(whole):
    """Bits that could differ: noise, and every chunk its own."""
    found = Results(whole.folder)
    assert len(np.unique(found.column("iae"))) == 640
    assert found.digest == whole.digest
