"""Does every test that should fail, fail? A test names with `killed_by` a change of the package that it notices.

    python tests/support/mutants.py [--part K/N] [--jobs JOBS] [WORD ...]

makes each change in a copy of the project and runs the test. WORD: only mutants whose file or test contains it. Part K
of N are the mutants K, K + N, ... of the list. The exit status is 1 if a test passes in spite of its change."""

import argparse
import ast
import contextlib
import functools
import os
import pathlib
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import pytest
from project import ROOT

TESTS = ROOT / "tests"
LIMIT_S = 300.0  # for one test; the slowest takes a minute when nothing is compiled yet
COPIED = ("diffabs", "tests", "experiments", "docs", "examples", "benchmarks")


class Mutant(NamedTuple):
    """A change of the text `old` in `file` of diffabs to `new`, and the test that fails then, as pytest names it."""

    file: str
    old: str
    new: str
    test: str


def killed_by(module: str, old: str, new: str, case: str | None = None) -> pytest.MarkDecorator:
    """Return a mark for a test that fails where each `old` in a module of diffabs is replaced by `new`.

    module: "loop.run", or the path of a file that is no module, "compiler/native/drive.h"
    case: the id of the parameters with which it fails; by default with any"""
    return pytest.mark.killed_by(module, old, new, case)


def find_mutants(tests: pathlib.Path = TESTS) -> list[Mutant]:
    """Return the mutants of all tests in a folder, as their source says, in the order of files and lines."""
    return [mutant for file in sorted(tests.rglob("test_*.py")) for mutant in _read_marks(file, tests)]


def module_file(module: str) -> str:
    """Return the path of a mark's module in diffabs: that of a package is its `__init__.py`."""
    if "/" in module:
        return module
    path = module.replace(".", "/")
    return f"{path}/__init__.py" if (ROOT / "diffabs" / path).is_dir() else f"{path}.py"


def _read_marks(file: pathlib.Path, tests: pathlib.Path) -> Iterator[Mutant]:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    for prefix, body in [("", tree.body), *((f"{node.name}::", node.body) for node in classes)]:
        for test in body:
            if not isinstance(test, ast.FunctionDef):
                continue
            for mark in test.decorator_list:
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "killed_by":
                    given = {one.arg: ast.literal_eval(one.value) for one in mark.keywords}
                    texts = [ast.literal_eval(one) for one in mark.args]
                    case = f"[{given['case']}]" if "case" in given else ""
                    yield Mutant(
                        module_file(texts[0]), *texts[1:], f"{file.relative_to(tests)}::{prefix}{test.name}{case}"
                    )


def judge(mutant: Mutant, folder: pathlib.Path, limit: float = LIMIT_S) -> str:
    """Return what becomes of a mutant of the project in `folder`: "dies", "SURVIVES", "dies: no end after ... s", or
    what is wrong with its mark. The folder is left as it was.

    limit: time for the test [s]"""
    path = folder / "diffabs" / mutant.file
    source = path.read_text(encoding="utf-8")
    if mutant.old not in source:
        return "IS OUT OF DATE: its text is not in the file"
    path.write_text(source.replace(mutant.old, mutant.new), encoding="utf-8")
    try:
        return run_tests([mutant.test], folder, limit)
    finally:
        path.write_text(source, encoding="utf-8")


def run_tests(tests: list[str], folder: pathlib.Path, limit: float | None = None, *, must_pass: bool = False) -> str:
    """Return "SURVIVES" if all tests pass against the package in `folder`, "dies" if one fails, or "dies: no end".

    limit: time for all of them [s]; raises RuntimeError, with the output, if pytest could not run them, or if one fails
    that must pass"""
    environment = {
        **os.environ,
        "PYTHONPATH": str(folder),
        "DIFFABS_JAX_CACHE": str(ROOT / ".jax_cache"),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    command = [sys.executable, "-m", "pytest", "-qx", "-p", "no:cacheprovider", *(f"tests/{test}" for test in tests)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, cwd=folder, env=environment, start_new_session=True, **pipes) as running:
        try:
            output, _ = running.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            return f"dies: no end after {limit:g} s"
        finally:
            with contextlib.suppress(ProcessLookupError):  # what the test has started ends with it
                os.killpg(running.pid, signal.SIGKILL)
    if must_pass and running.returncode == 1:
        raise RuntimeError(f"a test fails without its mutant:\n{output[-4000:]}")
    if running.returncode > 1:  # neither passed nor failed: the test does not exist, or nothing could be imported
        raise RuntimeError(output)
    return "dies" if running.returncode else "SURVIVES"


def copy_project(folder: pathlib.Path) -> None:
    """Copy the package, its tests, experiments, examples and pages; raises RuntimeError if Python finds another one."""
    for name in COPIED:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    command = [sys.executable, "-c", "import diffabs; print(diffabs.__file__)"]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    found = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True).stdout
    if not pathlib.Path(found.strip()).is_relative_to(folder):
        raise RuntimeError(f"the tests would import {found.strip()}, not the copy in {folder}")


def run_mutants(mutants: list[Mutant], jobs: int) -> int:
    """Run mutants in so many copies of the project at a time, print what becomes of each, and return the number that
    survives. Raises RuntimeError if a test fails without its change."""
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(jobs) as pool:
        folders: queue.SimpleQueue[pathlib.Path] = queue.SimpleQueue()
        for job in range(jobs):
            folder = pathlib.Path(name).resolve() / str(job)
            copy_project(folder)
            folders.put(folder)

        def use_folder(work: functools.partial[str]) -> str:
            folder = folders.get()
            try:
                return work(folder=folder)
            finally:
                folders.put(folder)

        tests = sorted({mutant.test for mutant in mutants})
        shares = [tests[job::jobs] for job in range(jobs) if tests[job::jobs]]
        list(pool.map(use_folder, [functools.partial(run_tests, share, must_pass=True) for share in shares]))
        survivors = 0
        verdicts = pool.map(use_folder, [functools.partial(judge, mutant) for mutant in mutants])
        for mutant, verdict in zip(mutants, verdicts, strict=True):
            survivors += not verdict.startswith("dies")
            print(f"{mutant.file}: {mutant.old!r} -> {mutant.new!r}: {mutant.test}: {verdict}", flush=True)
    return survivors


def main() -> int:
    """Run the mutants that the command line names."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("words", nargs="*", metavar="WORD")
    parser.add_argument("--part", default="0/1", metavar="K/N")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args()
    part, parts = map(int, asked.part.split("/"))
    words = asked.words or [""]
    chosen = [one for one in find_mutants() if any(word in one.file or word in one.test for word in words)][part::parts]
    survivors = run_mutants(chosen, asked.jobs)
    print(f"{len(chosen) - survivors} of {len(chosen)} mutants die")
    return 1 if survivors else 0


if __name__ == "__main__":
    raise SystemExit(main())
