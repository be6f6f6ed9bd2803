"""Files that are none, numbers and depths beyond all measure, bytes that are no text: one line each, and no waiting."""

import os
import tomllib
import tracemalloc

import pytest
from commands import assert_one_error_line, left_in, run
from mutants import killed_by

from diffabs.host.values import ScenarioError
from diffabs.robust.design.proof.certificate import Certificate
from diffabs.scenario import scenario, toml

pytestmark = pytest.mark.usefixtures("any_step_is_stable", "without_load")

HEX = "0x" + "f" * 3600  # 4,335 decimal digits: Python does not write so many
DEEP = "[" * 5000 + "]" * 5000
BYTES = os.fsdecode(b"title=\xff")


def refused(*args):
    result = run(*args, status=2)
    assert_one_error_line(result)
    assert len(result.stderr) < 1000
    return result.stderr


def strange(path, kind):
    if kind == "a folder":
        path.mkdir()
    elif kind == "a pipe":
        os.mkfifo(path)
    else:
        path.symlink_to(path.name)
    return path


KINDS = ["a folder", "a pipe", "a loop"]


@killed_by("host.files", "if not stat.S_ISREG(os.fstat(handle).st_mode):", "if False:")
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_file_is_not_read(tmp_path, kind):
    scenario = strange(tmp_path / "x.toml", kind)
    assert f'cannot read scenario "{scenario}": ' in refused("simulate", scenario)
    data = strange(tmp_path / "x.csv", kind)
    assert f"--data {data}: cannot be read, " in refused("identify", "slip-lmi", "--data", data, "--free", "plant.mass")
    column = f'sweep.over.plant.mass={{type="empirical",file="{data}",column="m"}}'
    assert f"cannot read {data}: " in refused("sweep", "slip-lmi", "--out", tmp_path / "o", "--set", column)
    with pytest.raises(OSError, match=r"not a regular file|Is a directory|Too many levels"):
        Certificate.load(strange(tmp_path / "x.json", kind))


@pytest.mark.parametrize("option", ["--csv", "--plot"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_file_is_not_written(tmp_path, kind, option):
    path = strange(tmp_path / "x.png", kind)
    assert f"{option} {path}: " in refused("simulate", "slip-lmi", option, path)
    assert left_in(tmp_path) == {"x.png"}


@pytest.mark.parametrize(
    "text",
    [
        f"title = {HEX}",
        f"solver.step = {HEX}",
        f"[plant]\nmass = {HEX}",
        f"[controller]\ngain = [1.0, {HEX}]",
        f"[sweep]\nsamples = {HEX}",
        f"[sweep.over]\nplant.mass = [1, -{HEX[:2]}{HEX[2:]}]".replace("-0x", "0x"),
        f"title = {DEEP}",
        f"title{'.a' * 5000} = 1",
        f"[plant]\nmass = {'{a=' * 5000}1{'}' * 5000}",
    ],
)
def test_a_number_or_depth_beyond_all_measure_in_a_file(file, text):
    said = refused("simulate", file(text))
    assert "is a whole number outside [-2^63, 2^63)" in said or "nested" in said


@pytest.mark.parametrize(
    "change",
    [
        f"title={HEX}",
        f"plant.mass={HEX}",
        f"sweep.samples={HEX}",
        f"controller.gain=1,{HEX}",
        f"title={DEEP}",
        f"title{'.a' * 5000}=1",
        f"plant.mass={DEEP}",
    ],
)
def test_a_huge_number_or_depth_on_the_command_line(change):
    said = refused("simulate", "slip-lmi", "--set", change)
    assert "is a whole number outside [-2^63, 2^63)" in said or "nested" in said


@pytest.mark.parametrize("change", [BYTES, BYTES.replace("title", "plant.mass"), BYTES.replace("title", "\udcff")])
def test_bytes_that_are_no_text(change):
    assert refused("simulate", "slip-lmi", "--set", change).endswith("is not UTF-8 text\n")


MANY = 51  # words of a key, one more than allowed
QUOTES = '"""'
LONG_KEYS = [
    f"{'a.' * MANY}b = 1",
    f"{'a . ' * MANY}b = 1",
    f"title = 'a'\n[plant{'.a' * MANY}]",
    "[[" + '"a.b".' * MANY + "c]]",
    "x = [1.0, {" + "'a'." * MANY + "b = 1.0 }]",
    f'title = {QUOTES}a\\"".b{QUOTES}\nx{".a" * MANY} = 1',
    f"title = '''a''.b''' # '\nx{'.a' * MANY} = 1",
]
SHORT_KEYS = [
    f"{'a.' * 45}b = {{ a.a = 1.5 }}",
    f"# {'a.' * MANY}\nx = 1",
    f'title = \'{"a." * MANY}\'\nnote = "\\"{"." * MANY}"',
    f"title = '''{'.' * MANY}\n'''\nnote = {QUOTES}\\\"{'.' * MANY}\"{QUOTES}",
    f"x = [{'1.5, ' * MANY}]",
]


@killed_by("scenario.toml", 'dots + bool(token["dot"])', "0")
@pytest.mark.parametrize("text", LONG_KEYS)
def test_a_key_of_many_words_is_refused_before_it_is_parsed(monkeypatch, text):
    """`tomllib` takes hours for a key of 250,000 words."""
    tomllib.loads(text)  # TOML itself has no limit
    monkeypatch.setattr(toml.tomllib, "loads", lambda _: pytest.fail("the text was parsed"))
    with pytest.raises(ScenarioError, match="a key is nested more than 50 deep"):
        toml.parse_toml(text)


@killed_by("scenario.toml", '0 if token["end"] else dots', "dots")
@pytest.mark.parametrize("text", SHORT_KEYS)
def test_dots_outside_of_keys_are_allowed(text):
    assert toml.parse_toml(text) == tomllib.loads(text)


@pytest.mark.parametrize("change", [f"controller={{{'a.' * 20_000}b=1}}", f"title=[{{a{'.b' * 20_000}=1}}]"])
def test_a_key_of_many_words_on_the_command_line(change):
    assert "a key is nested more than 50 deep" in refused("simulate", "slip-lmi", "--set", change)


def test_what_stands_below_a_long_key_takes_little_memory():
    """A path as text for each of the numbers would take 400 MB."""
    key, numbers = "a" * 200_000, [0] * 2_000
    tracemalloc.start()
    try:
        assert toml.parse_toml(f"{key} = {numbers}") == {key: numbers}
        assert tracemalloc.get_traced_memory()[1] < 1e8
    finally:
        tracemalloc.stop()


def test_a_message_does_not_repeat_a_long_key(file):
    key = "a" * 10_000
    assert refused("simulate", file(f"[{key}]\n[{key}]")).endswith("twice (at line 2, column 10002)\n")


@killed_by("scenario.scenario", "if len(section) > MAX_OBJECTIVES:", "if False:")
def test_more_objectives_than_can_be_checked(file):
    text = "".join(f"[objective.o{i}]\ntype = 'iae'\n" for i in range(201))
    assert refused("simulate", file(text)).endswith("objective has 201 entries, outside [0, 200]\n")


def test_a_scenario_inside_of_a_document_is_not_longer_than_one_that_is_written():
    """A scenario that is written has all digits, so it is longer than its file."""
    text = b"title = 'a'\n" + (b"#" * 999 + b"\n") * 1200
    assert scenario.loads(text, "x", "proof.json").title == "a"
    with pytest.raises(ScenarioError, match=r'"proof\.json" is larger than 10000000 bytes; it is no scenario$'):
        scenario.loads(text * 9, "x", "proof.json")


def test_more_digits_than_python_converts(file):
    said = refused("simulate", file(f"[plant]\nmass = {'9' * 5000}\n"))
    assert said.endswith("is not a scenario: a whole number is outside [-2^63, 2^63)\n")


def test_a_certificate_with_huge_numbers_and_depths(tmp_path):
    """JSON has no hexadecimal numbers; thousands of decimal digits are no finite float."""
    for text in (HEX, "9" * 4400, DEEP, '{"format": ' * 5000):
        path = tmp_path / "x.json"
        path.write_text(text)
        with pytest.raises(ValueError, match=r"x\.json: [^\n]*\Z") as error:
            Certificate.load(path)
        assert len(str(error.value)) < 1000


@pytest.mark.parametrize("count", ["0", "-3", "1025", "100000", "9" * 5000])
def test_a_number_of_devices_that_no_machine_has(tmp_path, count):
    result = run("sweep", "slip-lmi", "--out", tmp_path / "out", "--devices", count, status=2)
    assert "--devices" in result.stderr
    assert "Traceback" not in result.output
    assert left_in(tmp_path) == set()
