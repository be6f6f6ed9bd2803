"""What docs/adding.md promises: its road and its controller, added to a copy of the project as it says."""

import os
import re
import shutil
import subprocess
import sys

import pytest
from project import ROOT

BLOCKS = re.findall(r"```python\n# ([^\n]+)\n(.*?)```", (ROOT / "docs" / "adding.md").read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A copy of the project with the files and exports of the page, but not yet its lines in tests/support/parts.py."""
    root = tmp_path_factory.mktemp("project")
    shutil.copytree(ROOT / "diffabs", root / "diffabs", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "tests/support", root / "tests/support", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("conftest.py", "test_conformance.py"):
        shutil.copy(ROOT / "tests" / name, root / "tests")
    shutil.copy(ROOT / "pyproject.toml", root)
    for target, text in BLOCKS:
        if target.endswith("__init__.py, add"):
            with (root / target.removesuffix(", add")).open("a") as file:
                file.write(text)
        elif not target.startswith("tests/"):
            (root / target).write_text(text)
    return root


def run(project, *command):
    environment = os.environ | {"PYTHONPATH": str(project), "DIFFABS_JAX_CACHE": str(ROOT / ".jax_cache")}
    environment.pop("DIFFABS_TEST_PART", None)  # this process may run a part of the tests, the inner one all
    return subprocess.run(
        [sys.executable, "-m", *command], cwd=project, env=environment, capture_output=True, text=True
    )


def test_the_page_adds_two_parts_in_under_80_lines_each():
    files = {target: text.count("\n") for target, text in BLOCKS if "," not in target}
    assert len(files) == 2
    assert all(20 < lines < 80 for lines in files.values()), files


@pytest.mark.slow
def test_new_parts_pass_once_they_are_listed(project):
    conformance = (
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "tests/test_conformance.py",
        "-k",
        "brush or scheduled or exported",
    )
    before = run(project, *conformance)
    assert before.returncode == 1, before.stdout
    assert "Brush" in before.stdout
    assert "Scheduled" in before.stdout
    parts = project / "tests" / "support" / "parts.py"
    text = parts.read_text()
    for target, line in BLOCKS:
        if family := re.search(r"add to (\w+)", target):
            opening = f"{family[1]}: dict[str, Any] = {{\n"
            assert opening in text
            text = text.replace(opening, opening + line)
    parts.write_text(text)
    after = run(project, *conformance)
    assert after.returncode == 0, after.stdout
    assert int(re.search(r"(\d+) passed", after.stdout)[1]) >= 12  # both parts, all their conformance tests


@pytest.mark.slow
def test_new_parts_are_on_the_command_line(project):
    listed = run(project, "diffabs", "list", "roads", "--json")
    assert '"brush"' in listed.stdout, listed.stderr
    command = re.search(r"^    diffabs (simulate .*)$", (ROOT / "docs" / "adding.md").read_text(), re.MULTILINE)[1]
    simulated = run(project, "diffabs", *command.split(), "--json")
    assert simulated.returncode == 0, simulated.stderr
    assert '"stopped": true' in simulated.stdout
