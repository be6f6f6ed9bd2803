"""Changed folders of a sweep, for `fuzz_files`: what is read of one is what was written, or one line says why not."""

import hashlib
import json
import os
import pathlib
import shutil

import jax
import numpy as np
from commands import run
from fuzz_files import damaged, edited, in_a_line
from sweeping import SCENARIO, described

from diffabs.scenario import scenario
from diffabs.scenario.samples import load_sample
from diffabs.uncertainty.sweep import Results, SweepError, sweep
from diffabs.uncertainty.sweep.engines import ComputedChunk
from diffabs.uncertainty.sweep.seal import CHUNK_NAME_PATTERN
from diffabs.uncertainty.sweep.statistics.summary import summarise_sweep

TEXT = SCENARIO.replace("samples = 3200", "samples = 290")
SAMPLE = 7


class Written:
    """An engine that has the chunks already."""

    def __init__(self, folder):
        self.data = {
            int(CHUNK_NAME_PATTERN.fullmatch(path.name)[1]): path.read_bytes() for path in (folder / "chunks").iterdir()
        }

    def run(self, study, chunks, stopping):
        for chunk in chunks:
            start, stop = study.bounds(chunk)
            yield ComputedChunk(chunk, self.data[chunk], stop - start, 0, 0)


class Folders:
    """A sweep and another one of the same variables; a call changes a copy and reads it in every way."""

    def __init__(self, room):
        jax.config.update("jax_enable_x64", True)
        scenario.stable_step = lambda loop: np.inf
        (room / "small.toml").write_text(TEXT)
        for name, seed in (("out", 3), ("other", 4)):
            run("sweep", room / "small.toml", "--out", room / name, "--seed", seed, "--json")
        self.room, self.study, self.engine = room, described(TEXT), Written(room / "out")
        found = Results(room / "out")
        self.rows, self.digest, self.summary = found.pandas(), found.digest, summarise_sweep(found)
        self.loop = load_sample(room / "out", SAMPLE)[0].loop

    def __call__(self, rng, room):
        folder = room / "out"
        shutil.copytree(self.room / "out", folder)
        changes = [rng.choice(BYTES)] if rng.random() < 0.3 else []
        changes += [rng.choice(CHANGES)]
        what = "; ".join(f"{change.__name__}: {change(rng, folder, self.room)}" for change in changes)
        self.forged = any(change in FORGED for change in changes)
        name = "no reader yet"
        try:
            outcomes = []
            for reader in self.readers():
                name = reader.__name__
                outcomes.append((name, self._outcome(reader, folder)))
            return what, outcomes
        except Exception as error:
            error.mutation = f"{what} ({name})"
            raise

    def readers(self):
        return self.library, self.statistics, self.compare, self.from_sweep, self.resume

    def _outcome(self, reader, folder):
        try:
            return reader(folder)
        except SweepError as error:
            return in_a_line(error)
        except AssertionError:
            if self.forged:
                return "forged, and believed"
            raise

    def library(self, folder):
        found = Results(folder)
        rows = found.pandas()
        there = self.rows.loc[rows.index]
        assert rows.equals(there[rows.columns]), "other numbers"
        assert set(rows.columns) == set(there.columns), "other columns"
        assert found.complete == (len(rows) == len(self.rows)), "complete although rows are missing, or the other way"
        assert (found.digest == self.digest) == found.complete, "another digest"
        return "the same numbers" if found.complete else "the same numbers of fewer"

    def statistics(self, folder):
        found = Results(folder)
        if not found.complete:
            return "not asked: not complete"
        assert summarise_sweep(found) == self.summary, "other statistics"
        return "the same numbers"

    def compare(self, folder):
        from typer.testing import CliRunner

        from diffabs.cli import main

        result = CliRunner().invoke(main.app, ["compare", str(self.room / "out"), str(folder), "--json"])
        if result.exception and not isinstance(result.exception, SystemExit):
            raise result.exception
        if result.exit_code == 2:
            lines = [line for line in result.stderr.splitlines() if not line.startswith("warning: ")]
            assert len(lines) == 1, result.stderr
            assert lines[0].startswith("error: "), result.stderr
            return "refused in a line"
        assert result.exit_code == 0, result.output
        rows = json.loads(result.stdout)["metrics"].values()
        assert all(row["first"] == row["second"] for row in rows), "other numbers"
        return "the same numbers"

    def from_sweep(self, folder):
        try:
            loop = load_sample(folder, SAMPLE)[0].loop
        except scenario.ScenarioError as error:
            return in_a_line(error)
        same = jax.tree.map(lambda a, b: bool(np.array_equal(a, b)), loop, self.loop)
        assert all(jax.tree.leaves(same)), "another sample"
        return "the same sample"

    def resume(self, folder):
        try:
            found = sweep(self.study, folder, resume=True, on=self.engine)
        except OSError as error:  # which the command says in a line
            return in_a_line(error)
        assert found.complete, "not complete after resume"
        assert found.digest == self.digest, "another digest after resume"
        return "the same numbers"


def files_of(folder):
    return sorted((folder / "chunks").iterdir())


def bytes_of_a_chunk(rng, folder, _):
    path = rng.choice(files_of(folder))
    data, what = damaged(rng, path.read_bytes() if path.is_file() else b"")
    if path.is_file():
        path.write_bytes(data)
    return what


def bytes_of_a_chunk_with_its_name(rng, folder, _):
    """The name is made to fit what is in the file."""
    path = rng.choice(files_of(folder))
    if not path.is_file() or not CHUNK_NAME_PATTERN.fullmatch(path.name):
        return "nothing"
    data, what = damaged(rng, path.read_bytes())
    path.unlink()
    path.with_name(f"{path.name[:14]}{hashlib.sha256(data).hexdigest()[:16]}.parquet").write_bytes(data)
    return what


def bytes_of_the_manifest(rng, folder, _):
    path = folder / "manifest.json"
    data, what = damaged(rng, path.read_bytes())
    path.write_bytes(data)
    return what


def value_of_the_manifest(rng, folder, _, again=False):
    path = folder / "manifest.json"
    document = json.loads(path.read_text())
    what = edited(rng, document)
    if again:
        document.pop("digest", None)
        compact = json.dumps(document, separators=(",", ":"))
        document["digest"] = hashlib.sha256(compact.encode()).hexdigest()
    path.write_text(json.dumps(document))
    return what


def value_of_the_manifest_with_its_digest(rng, folder, room):
    return value_of_the_manifest(rng, folder, room, again=True)


def names(rng, folder, _):
    """Numbers and digests exchanged, other numbers, other names."""
    one, two = rng.choice(files_of(folder)), rng.choice(files_of(folder))
    how = rng.choice(["numbers", "contents", "number", "beyond", "digest", "name", "case"])
    if how in ("numbers", "contents"):
        other = two.with_name(one.name[:14] + two.name[14:]), one.with_name(two.name[:14] + one.name[14:])
        one.rename(folder / "one")
        targets = (one, two) if how == "contents" else other
        if two.exists():
            two.rename(targets[0])
        (folder / "one").rename(targets[1])
        return f"{how} of {one.name} and {two.name}"
    number = rng.randrange(5) if how == "number" else rng.choice([5, 99, 10**8]) if how == "beyond" else one.name[5:13]
    number = number if isinstance(number, str) else f"{number:08d}"
    digest = f"{rng.randrange(16**16):016x}" if how == "digest" else one.name[14:30]
    name = rng.choice(["merged.parquet", "notes.txt", ".hidden", "x.tmp", "part-1.parquet"])
    name = name if how == "name" else f"part-{number}-{digest}.parquet"
    name = name.upper() if how == "case" else name
    if rng.random() < 0.5 and one.is_file():
        shutil.copy(one, one.with_name(name)) if name != one.name else None
    else:
        one.rename(one.with_name(name))
    return f"{how}: {one.name} as {name}"


def chunk_of_another_sweep(rng, folder, room):
    other = rng.choice(files_of(room / "other"))
    mine = next((path for path in files_of(folder) if path.name[:13] == other.name[:13]), None)
    if mine is not None and mine.is_file() and rng.random() < 0.7:
        mine.unlink()
    shutil.copy(other, folder / "chunks" / other.name)
    return other.name


def manifest_of_another_sweep(rng, folder, room):
    shutil.copy(room / "other" / "manifest.json", folder)
    return "seed 4"


def what_is_no_file(rng, folder, _):
    path = rng.choice([*files_of(folder), folder / "manifest.json", folder / "chunks"])
    target = folder / "elsewhere"
    path.rename(target)
    how = rng.choice(["gone", "folder", "pipe", "loop", "link", "empty", "nowhere"])
    if how == "folder":
        path.mkdir()
    elif how == "pipe":
        os.mkfifo(path)
    elif how == "empty":
        path.write_bytes(b"")
    elif how != "gone":
        path.symlink_to({"loop": path, "link": target, "nowhere": pathlib.Path("nowhere")}[how])
    return f"{path.name} is {how}"


FORGED = {bytes_of_a_chunk_with_its_name}  # nothing without a secret can tell; no traceback, that is all
BYTES = [bytes_of_a_chunk, value_of_the_manifest, value_of_the_manifest_with_its_digest]
CHANGES = [bytes_of_a_chunk, bytes_of_a_chunk, bytes_of_a_chunk_with_its_name, bytes_of_the_manifest, names, names]
CHANGES += [value_of_the_manifest, value_of_the_manifest_with_its_digest, value_of_the_manifest_with_its_digest]
CHANGES += [chunk_of_another_sweep, manifest_of_another_sweep, what_is_no_file]
