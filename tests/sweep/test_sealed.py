"""What a sweep's folder says is what was written there: every reader finds what was changed, and says it in a line."""

import hashlib
import json
import os
import pathlib
import random
import shutil

import numpy as np
import pytest
from commands import assert_one_error_line, run
from marks import cases
from mutants import killed_by
from small_scenarios import SWEEP

from diffabs.uncertainty.sweep import Results, SweepError

pytestmark = pytest.mark.usefixtures("any_step_is_stable", "without_load")

# Five chunks, the last one shorter, of the program that tests/sweep/test_sweep.py compiles.
TEXT = SWEEP.replace("samples = 150", "samples = 290\ncheck = 0").replace("1e308", "-41.0")


@pytest.fixture(scope="module")
def whole(tmp_path_factory, any_step_is_stable, without_load):
    """A sweep, and another of the same variables with another seed."""
    folder = tmp_path_factory.mktemp("sealed")
    (folder / "small.toml").write_text(TEXT)
    for name, seed in (("out", 3), ("other", 4)):
        run("sweep", folder / "small.toml", "--out", folder / name, "--seed", seed, "--json")
    return folder


@pytest.fixture
def copy(whole, tmp_path):
    shutil.copytree(whole / "out", tmp_path / "out")
    return tmp_path / "out"


def chunk_files(folder):
    return sorted((folder / "chunks").iterdir())


def as_read(folder):
    """Everything that a reader of the library gets."""
    found = Results(folder)
    return found.complete, found.digest, found.pandas().to_dict("list")


def refused(folder, whole, needed=""):
    """By the library, and by the commands that read chunks, in one line each."""
    with pytest.raises(SweepError) as error:
        as_read(folder)
    assert str(error.value).count("\n") == 0
    assert needed in str(error.value)
    result = run("compare", whole / "out", folder, status=2)
    assert_one_error_line(result)
    assert needed in result.stderr


def flipped(data, bit):
    return data[: bit // 8] + bytes([data[bit // 8] ^ (1 << bit % 8)]) + data[bit // 8 + 1 :]


# Chunks


@pytest.mark.slow
@killed_by("uncertainty.sweep.seal", "if chunk_file_name(seal.chunk, data) != path.name:", "if False:")
@pytest.mark.parametrize("seed", range(4))
def test_every_flipped_bit_of_a_chunk_is_seen(copy, seed):
    """A hundred of each seed, anywhere in a file: pages, dictionary, footer, marks."""
    rng = random.Random(seed)
    for _ in range(100):
        path = rng.choice(chunk_files(copy))
        data = path.read_bytes()
        path.write_bytes(flipped(data, rng.randrange(8 * len(data))))
        with pytest.raises(SweepError, match="is damaged: its contents do not match its name"):
            as_read(copy)
        path.write_bytes(data)


@pytest.mark.slow
def test_compare_sees_it_too(copy, whole):
    path = chunk_files(copy)[2]
    data = path.read_bytes()
    for place in (10, len(data) // 2, len(data) - 20):
        path.write_bytes(flipped(data, 8 * place))
        refused(copy, whole, f"{path} is damaged")


@pytest.mark.slow
@killed_by("uncertainty.sweep.results", "self._verified.get(chunk) == state", "chunk in self._verified")
def test_a_file_that_changes_while_it_is_open_is_verified_again(copy):
    found, path = Results(copy), chunk_files(copy)[0]
    before = found.column("iae")
    assert np.array_equal(found.column("iae"), before)
    path.write_bytes(flipped(path.read_bytes(), 4000))
    with pytest.raises(SweepError, match="is damaged"):
        found.column("iae")


def numbered(path, chunk):
    return path.with_name(f"part-{chunk:08d}{path.name[13:]}")


@killed_by(
    "uncertainty.sweep.seal",
    "for key, value in seal.metadata().items()",
    "for key, value in list(seal.metadata().items())[::2]",
)
def test_chunks_that_exchanged_their_numbers(copy, whole):
    one, two = chunk_files(copy)[1:3]
    one.rename(copy / "one")
    two.rename(numbered(two, 1))
    (copy / "one").rename(numbered(one, 2))
    refused(copy, whole, "is not that chunk: its chunk is '2'")
    result = run("sweep", whole / "small.toml", "--out", copy, "--resume", "--json")
    assert result.stderr == "damaged, computed again: chunks 1, 2\n"
    assert as_read(copy) == as_read(whole / "out")


def test_a_chunk_that_was_copied(copy, whole):
    one, two = chunk_files(copy)[1:3]
    two.unlink()
    shutil.copy(one, numbered(one, 2))
    refused(copy, whole, "is not that chunk: its chunk is '1'")


@killed_by(
    "uncertainty.sweep.seal",
    "for key, value in seal.metadata().items()",
    "for key, value in list(seal.metadata().items())[1:2]",
)
def test_a_chunk_of_another_sweep(copy, whole):
    """Not damaged, so it is not removed either: somebody may have no other copy."""
    mine, other = chunk_files(copy)[1], chunk_files(whole / "other")[1]
    mine.unlink()
    shutil.copy(other, mine.parent)
    refused(copy, whole, "is a chunk of another sweep: its owner is '")
    result = run("sweep", whole / "small.toml", "--out", copy, "--resume", status=2)
    assert_one_error_line(result)
    assert "is a chunk of another sweep" in result.stderr
    assert (mine.parent / other.name).exists()


def test_a_chunk_that_is_there_twice(copy, whole):
    path = chunk_files(copy)[1]
    shutil.copy(path, path.with_name("part-00000001-0123456789abcdef.parquet"))
    refused(copy, whole, "are the same chunk")
    result = run("sweep", whole / "small.toml", "--out", copy, "--resume", "--json")
    assert result.stderr == ""
    assert as_read(copy) == as_read(whole / "out")


@pytest.mark.parametrize(
    "name",
    cases(
        ["part-00000005-{}.parquet", "merged.parquet", "part-1.parquet", "notes.txt"],
        "merged.parquet",
        "part-1.parquet",
    ),
)
def test_a_stray_file_makes_nothing_interrupted(copy, whole, name):
    """A number beyond the last, or a name of no chunk: it is not read, and that is said."""
    path = chunk_files(copy)[4]
    stray = path.with_name(name.format(path.name[14:30]))
    shutil.copy(path, stray)
    assert as_read(copy) == as_read(whole / "out")
    for command in (["compare", whole / "out", copy], ["sweep", whole / "small.toml", "--out", copy, "--resume"]):
        result = run(*command, "--json")
        said = f"warning: {stray} is not a chunk of this sweep; other programs would read it, too\n"
        assert result.stderr == said
    assert stray.exists()


@pytest.mark.parametrize("kind", ["a folder", "a pipe", "a loop", "nothing behind a link"])
def test_what_is_named_like_a_chunk_and_is_no_file(copy, whole, kind):
    path = chunk_files(copy)[1]
    path.unlink()
    made = {
        "a folder": path.mkdir,
        "a pipe": lambda: os.mkfifo(path),
        "a loop": lambda: path.symlink_to(path.name),
        "nothing behind a link": lambda: path.symlink_to("nowhere"),
    }
    made[kind]()
    refused(copy, whole, f"{path} cannot be read: ")
    result = run("sweep", whole / "small.toml", "--out", copy, "--resume", status=2)
    assert_one_error_line(result)
    assert f"{path} cannot be read: " in result.stderr


def test_others_read_the_chunks_as_ever_and_see_whose_they_are(whole):
    import duckdb

    chunks = whole / "out" / "chunks"
    told = duckdb.sql(f"select key, value from parquet_kv_metadata('{chunks}/*.parquet')").fetchall()
    rows = [(key.decode(), value.decode()) for key, value in told]
    assert sorted(int(value) for key, value in rows if key == "diffabs.chunk") == [0, 1, 2, 3, 4]
    assert {value for key, value in rows if key == "diffabs.seed"} == {"3"}
    assert len({value for key, value in rows if key == "diffabs.owner"}) == 1
    assert duckdb.sql(f"select count(*) from '{chunks}/*.parquet'").fetchall() == [(290,)]


# The manifest


def edited(folder, change, *, again=False):
    """The manifest changed in one place; `again`: with the digest that then belongs to it."""
    path = folder / "manifest.json"
    there = json.loads(path.read_text())
    change(there)
    if again:
        there.pop("digest")
        compact = json.dumps(there, separators=(",", ":"))
        there["digest"] = hashlib.sha256(compact.encode()).hexdigest()
    path.write_text(json.dumps(there, indent=1))


def test_the_digest_of_a_manifest_is_that_of_the_rest(whole, copy):
    before = (copy / "manifest.json").read_bytes()
    edited(copy, lambda there: None, again=True)
    assert (copy / "manifest.json").read_bytes() == before


@pytest.mark.slow
@killed_by("uncertainty.sweep.manifest", 'if document.get("digest") != json_digest(manifest):', "if False:")
def test_a_scenario_that_was_edited_in_the_manifest_is_seen(copy, whole):
    def heavier(there):
        there["source"]["scenario"] = there["source"]["scenario"].replace("0.0995", "0.1")

    before = run("simulate", "--from-sweep", copy, "--sample", "3", "--json").stdout
    assert json.loads(before)["metrics"]["iae"] == pytest.approx(Results(copy).column("iae")[3], rel=1e-9)
    for again, needed in ((False, "it was changed after it was written"), (True, "is not what was swept: study.loop")):
        edited(copy, heavier, again=again)
        result = run("simulate", "--from-sweep", copy, "--sample", "3", status=2)
        assert_one_error_line(result)
        assert needed in result.stderr
        shutil.copy(whole / "out" / "manifest.json", copy)


@killed_by("scenario.samples", "    check_owner(folder, manifest, number)\n", "")
def test_the_manifest_of_another_sweep_is_not_believed(copy, whole):
    """Nor by who reads no number of a chunk."""
    shutil.copy(whole / "other" / "manifest.json", copy)
    with pytest.raises(SweepError, match="is a chunk of another sweep"):
        as_read(copy)
    result = run("simulate", "--from-sweep", copy, "--sample", "3", status=2)
    assert_one_error_line(result)
    assert "is a chunk of another sweep" in result.stderr


def paths(value, at=()):
    """Of every value in a document."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield (*at, key)
        yield from paths(item, (*at, key))


def deep(levels):
    value = 1.0
    for _ in range(levels):
        value = [value]
    return value


VALUES = (None, True, -1, 0, 1e308, float("nan"), "x", "\ud800", [], [1], {}, {"type": "x"}, deep(200), 10**400)


@pytest.mark.slow
@pytest.mark.parametrize("again", [False, True])
def test_no_value_of_a_manifest_ends_in_a_traceback(copy, whole, again):
    """Also where somebody worked out the digest anew: read without a word, it is the same sweep."""
    truth, there = as_read(copy), json.loads((copy / "manifest.json").read_text())
    rng = random.Random(5)
    for path in paths(there):
        for value in rng.sample(VALUES, 3):

            def change(document, path=path, value=value):
                for key in path[:-1]:
                    document = document[key]
                document[path[-1]] = value

            edited(copy, change, again=again)
            said = ""
            try:
                assert as_read(copy) == truth
            except SweepError as error:
                said = str(error)
            assert "\n" not in said
            assert said or again or json.loads((copy / "manifest.json").read_text()) == there, (path, value)
            shutil.copy(whole / "out" / "manifest.json", copy)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"format": ' + "9" * 5000 + "}", '{"format": 2', "\xff", "null"])
def test_a_manifest_that_is_none_is_one_line(copy, text):
    (copy / "manifest.json").write_bytes(text.encode("latin-1"))
    for command in (["compare", copy, copy], ["simulate", "--from-sweep", copy, "--sample", "0"]):
        result = run(*command, status=2)
        assert_one_error_line(result)
        assert "is no sweep that can be read: manifest.json: " in result.stderr


@pytest.mark.parametrize("kind", ["a folder", "a pipe", "a loop"])
def test_a_manifest_that_is_no_file(copy, kind):
    path = copy / "manifest.json"
    path.unlink()
    made = {"a folder": path.mkdir, "a pipe": lambda: os.mkfifo(path), "a loop": lambda: path.symlink_to(path.name)}
    made[kind]()
    result = run("simulate", "--from-sweep", copy, "--sample", "0", status=2)
    assert_one_error_line(result)
    assert "is no sweep: manifest.json: " in result.stderr


def test_a_sweep_without_seals_is_not_read(copy):
    there = json.loads((copy / "manifest.json").read_text())
    del there["digest"]
    (copy / "manifest.json").write_text(json.dumps({**there, "format": 1}))
    with pytest.raises(SweepError, match="read its chunks with pandas, or sweep again"):
        Results(copy)
    assert pathlib.Path(copy / "chunks").is_dir()
