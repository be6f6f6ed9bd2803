"""The sections of the page on the command line show what the commands print.

A line of three dots stands for any lines, three dots within a line for any text. Numbers agree to 1e-3: searches end
where the rounding of a version of JAX lets them. Table borders and the spaces of their columns depend on numbers."""

import re
import subprocess
import sys

import pytest
import typer
from project import ROOT
from typer.testing import CliRunner

from diffabs.cli.main import app

PAGE = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
SESSIONS = re.findall(r"^```console\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
QUICK = ("list", "show")  # the others take more than a few seconds
NUMBER = r"[-+]?(?:\d[\d,]*\.?\d*(?:e[-+]\d+)?)"
RTOL = 1e-3


def commands(session):
    """Return each command of a session, without `diffabs`, and the lines below it."""
    parts = re.split(r"^\$ diffabs (.*)\n", session, flags=re.MULTILINE)[1:]
    return list(zip(parts[::2], parts[1::2], strict=True))


def name(session):
    return "-".join(dict.fromkeys(command.split()[0] for command, _ in commands(session)))


def plain(text):
    """Return the lines without borders, and with single spaces."""
    lines = (re.sub(r"[\u2501-\u257f ]+", " ", line).strip() for line in text.replace("│", " | ").splitlines())
    return [line for line in lines if line]


def same(shown, line):
    """Whether a line of the page says what a printed line says."""
    head, dots, _ = shown.partition("...")
    if dots and not head.endswith(" "):
        return line.startswith(head)
    if dots:
        words = head.split()
        return same(" ".join(words), " ".join(line.split()[: len(words)]))
    if re.sub(NUMBER, "#", shown) != re.sub(NUMBER, "#", line):
        return False
    pairs = zip(re.findall(NUMBER, shown), re.findall(NUMBER, line), strict=True)
    values = ((float(a.replace(",", "")), float(b.replace(",", ""))) for a, b in pairs)
    return all(abs(a - b) <= RTOL * abs(a) for a, b in values)


def first_difference(shown, printed):
    """Return the first line of the page that is not printed at its place, or None."""
    lines, place, free = plain(printed), 0, False
    for line in plain(shown):
        if line == "...":
            free = True
            continue
        reach = range(place, len(lines) if free else min(place + 1, len(lines)))
        match = next((i for i in reach if same(line, lines[i])), None)
        if match is None:
            return line
        place, free = match + 1, False
    return None if free or place == len(lines) else lines[place]


def test_every_command_has_a_section_with_its_output():
    shown = {command.split()[0] for session in SESSIONS for command, _ in commands(session)}
    assert shown == typer.main.get_command(app).commands.keys()  # pyright: ignore[reportAttributeAccessIssue]


def test_a_wrong_line_is_noticed():
    printed = "a  1.0\nb  2.0\nc  3.0\n"
    assert first_difference("a 1.0\n...\nc 3.0001\n", printed) is None
    assert first_difference("a 1.0\nc 3.0\n", printed) == "c 3.0"
    assert first_difference("...\nb 2.1\n...\n", printed) == "b 2.1"
    assert first_difference("a 1.0\n", printed) == "b 2.0"
    assert first_difference("a 1...\n...\n", printed) is None
    assert first_difference("a 1.0001 ...\n...\n", printed + "d") is None
    assert first_difference("a 1.1 ...\n...\n", printed) == "a 1.1 ..."


@pytest.mark.parametrize(
    "session",
    [
        pytest.param(session, id=name(session), marks=[] if name(session) in QUICK else pytest.mark.slow)
        for session in SESSIONS
        if name(session) != "explore"
    ],
)
@pytest.mark.usefixtures("users_engine")
def test_a_session_prints_what_the_page_shows(session, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for command, shown in commands(session):
        result = CliRunner().invoke(app, command.split(), env={"COLUMNS": "100"})
        notes = [line for line in result.stderr.splitlines() if " ... " not in line]  # not the progress
        assert first_difference(shown, result.stdout + "\n" + "\n".join(notes)) is None, command


@pytest.mark.slow
def test_the_explorer_prints_the_address_of_the_page(tmp_path):
    pytest.importorskip("nicegui", reason="needs the extra `explore`")
    (session,) = (session for session in SESSIONS if name(session) == "explore")
    ((command, shown),) = commands(session)
    words = [sys.executable, "-m", "diffabs", *command.split(), "--port", "0"]
    explorer = subprocess.Popen(words, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert explorer.stderr is not None
    try:
        line = next(line for line in explorer.stderr if line.startswith("http"))
    finally:
        explorer.kill()
        explorer.communicate()
    pattern = re.escape(shown.splitlines()[-1]).replace("8342", r"\d+").replace(re.escape("..."), r"\S+")
    assert re.fullmatch(pattern, line.strip())
