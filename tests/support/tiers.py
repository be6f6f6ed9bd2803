"""Run a tier of the tests and write into docs/test-status.md when it ran, on which commit, how long, and what failed.

    python tests/support/tiers.py fast | nightly | weekly [JOB ...]

fast      tests without the mark `slow`: every change, `make test`
nightly   a twentieth of the slow tests and a seventh of the mutants, others each day, and fast tests of the engine
          with the compiler flags that users have: at most 25 minutes on 2 cores
weekly    all slow tests, all fast tests with these flags, all mutants, and the fuzzers

Each part of the slow tests has processes of its own: JAX keeps compiled programs, some 35 MB for each slow test.

JOB: only jobs whose name contains one of these texts. Each job writes its row when it ends, so the rows of a tier may
be of several days and commits. The exit status is 1 if something failed. A job that is interrupted writes nothing."""

import datetime
import os
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from project import ROOT

PAGE = ROOT / "docs" / "test-status.md"
OUT = ROOT / "out" / "tiers"
PYTEST = ("-m", "pytest", "-n", "2", "--dist", "loadfile", "--no-loadscope-reorder")
ENGINE = ("tests/core", "tests/engine", "tests/objectives", "tests/controllers", "tests/actuators")
USERS_FLAGS = MappingProxyType({"DIFFABS_TEST_XLA": "default"})
SHOWN_FAILURES = 12
SLOW_PARTS = 6
SLOW_NIGHTS, MUTANT_NIGHTS = 20, 7  # nights in which all slow tests, all mutants have their turn


class Job(NamedTuple):
    """A part of a tier: its name, the arguments of Python, and what it adds to the environment."""

    name: str
    arguments: tuple[str, ...]
    environment: Mapping[str, str] = MappingProxyType({})


def jobs_of_tier(tier: str, today: datetime.date) -> list[Job]:
    """Return the jobs of a tier on a day. Raises KeyError for a tier that does not exist."""
    mutants, fuzz, day = "tests/support/mutants.py", "tests/support/fuzz_", today.toordinal()

    def slow_tests(name: str, part: int, parts: int) -> Job:
        return Job(name, (*PYTEST, "-m", "slow"), MappingProxyType({"DIFFABS_TEST_PART": f"{part}/{parts}"}))

    return {
        "fast": [Job("fast tests", (*PYTEST, "-m", "not slow"))],
        "nightly": [
            slow_tests("a twentieth of the slow tests", day % SLOW_NIGHTS, SLOW_NIGHTS),
            Job("outputs of the commands", ("-m", "pytest", "-n", "0", "tests/docs/test_commands_page.py")),
            Job("a notebook", ("-m", "pytest", "-n", "0", "tests/docs/test_notebook.py")),
            Job("the engine's tests, users' flags", (*PYTEST, "-m", "not slow", *ENGINE), USERS_FLAGS),
            Job("a seventh of the mutants", (mutants, "--part", f"{day % MUTANT_NIGHTS}/{MUTANT_NIGHTS}")),
        ],
        "weekly": [
            *(slow_tests(f"slow tests, part {k + 1} of {SLOW_PARTS}", k, SLOW_PARTS) for k in range(SLOW_PARTS)),
            Job("fast tests, users' flags", (*PYTEST, "-m", "not slow"), USERS_FLAGS),
            Job("all mutants", (mutants,)),
            Job("scenarios of the fuzzer", (f"{fuzz}scenarios.py", "--count", "20000", "--seed", "0")),
            Job("files of the fuzzer", (f"{fuzz}files.py", "--count", "2000", "--seed", "0")),
        ],
    }[tier]


def run_job(job: Job) -> tuple[str, list[str]]:
    """Run a job, print what it prints, and return its outcome in a few words and the names of what failed."""
    OUT.mkdir(parents=True, exist_ok=True)
    report = OUT / f"{re.sub(r'[^a-z0-9]+', '-', job.name)}.xml"
    report.unlink(missing_ok=True)
    more = (f"--junitxml={report}",) if "pytest" in job.arguments else ()
    command = [sys.executable, *job.arguments, *more]
    with subprocess.Popen(
        command, cwd=ROOT, env={**os.environ, **job.environment}, stdout=subprocess.PIPE, text=True
    ) as running:
        assert running.stdout is not None
        lines = [print(line, end="", flush=True) or line for line in running.stdout]
    if report.exists():
        return _read_report(report)
    failed = [line.strip() for line in lines if re.search(r"SURVIVES|IS OUT OF DATE|^FAILED", line)]
    last = next((line.strip() for line in reversed(lines) if line.strip()), "nothing printed")
    return last, failed or ([last] if running.returncode else [])


def _read_report(report: os.PathLike[str]) -> tuple[str, list[str]]:
    cases = list(ElementTree.parse(report).iter("testcase"))
    failed = [f"{one.get('classname')}::{one.get('name')}" for one in cases if _has(one, "failure", "error")]
    skipped = sum(_has(one, "skipped") for one in cases)
    return f"{len(cases) - len(failed) - skipped} passed, {skipped} skipped, {len(failed)} failed", failed


def _has(case: ElementTree.Element, *kinds: str) -> bool:
    return any(case.find(kind) is not None for kind in kinds)


def write_status(tier: str, jobs: list[Job], new: Job, commit: str, minutes: float, outcome: str) -> None:
    """Replace the row of one job in the tier's section of docs/test-status.md; rows of other jobs stay."""
    text = PAGE.read_text(encoding="utf-8")
    old = re.compile(rf"^## {tier.capitalize()}\n.*?(?=^## |\Z)", re.MULTILINE | re.DOTALL)
    found = old.search(text)
    rows = dict(re.findall(r"^\| ([^|]+?) (\|.*)$", found[0] if found else "", re.MULTILINE))
    rows[new.name] = f"| {datetime.date.today()} | {commit} | {minutes:.1f} | {outcome.replace('|', ' ')} |"
    none = "| | | | not run yet |"
    section = [f"## {tier.capitalize()}", "", "| job | date | commit | minutes | outcome |", "|---|---|---|---|---|"]
    section += [f"| {job.name} {rows.get(job.name, none)}" for job in jobs]
    PAGE.write_text(old.sub(lambda _: "\n".join([*section, "", ""]), text).rstrip() + "\n", encoding="utf-8")


def _describe_commit() -> str:
    """Return the short name of the commit; "-dirty" follows if a file other than the page differs from it."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", f":!{PAGE.relative_to(ROOT)}")
    return git("rev-parse", "--short", "HEAD") + ("-dirty" if changed else "")


def main(tier: str, names: list[str]) -> int:
    """Run a tier, or the jobs of these names, and write the rows."""
    commit = _describe_commit()
    jobs, status = jobs_of_tier(tier, datetime.date.today()), 0
    for job in jobs:
        if names and not any(name in job.name for name in names):
            continue
        start = time.monotonic()
        outcome, failed = run_job(job)
        if failed:
            status = 1
            more = f" and {len(failed) - SHOWN_FAILURES} more" if len(failed) > SHOWN_FAILURES else ""
            outcome += ": " + ", ".join(f"`{name}`" for name in failed[:SHOWN_FAILURES]) + more
        write_status(tier, jobs, job, commit, (time.monotonic() - start) / 60, outcome)
    return status


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1], sys.argv[2:]))
