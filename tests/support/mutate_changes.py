"""Which changes of the lines that you wrote does no test notice? Cosmic Ray makes them one after the other.

    python tests/support/mutate_changes.py [--base main] [--tests tests/host/test_values.py ...]

takes the lines of diffabs/ that differ between HEAD and the base, changes operators, numbers and conditions in them,
and prints each change with which the tests still pass. It works in a worktree of its own, so commit first. By default
the tests are those in the folders that mirror the changed packages, without the slow ones."""

import argparse
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile

from project import CACHE, ROOT

TIMEOUT_S = 600.0  # for the tests of one change


def changed_files(base: str) -> list[str]:
    """Return the files of the package that differ between HEAD and the base."""
    names = ["git", "diff", "--name-only", "--diff-filter=d", f"{base}...HEAD", "--", "diffabs/*.py"]
    return subprocess.run(names, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()


def mirrored_tests(files: list[str]) -> list[str]:
    """Return the folders of tests that mirror the packages of these files, or all tests if a package has none."""
    folders = {f"tests/{pathlib.PurePath(file).parts[1]}" for file in files}
    return sorted(folders) if all((ROOT / folder).is_dir() for folder in folders) else ["tests"]


def configuration(files: list[str], tests: list[str], base: str) -> str:
    """Return the configuration of Cosmic Ray, as TOML."""
    command = f"{sys.executable} -m pytest -qx -n 0 -p no:cacheprovider -m 'not slow' {' '.join(tests)}"
    return f"""[cosmic-ray]
module-path = {files!r}
timeout = {TIMEOUT_S}
excluded-modules = []
test-command = "{command}"
[cosmic-ray.distributor]
name = "local"
[cosmic-ray.filters.git-filter]
branch = "{base}"
"""


def main() -> int:
    """Make the changes and print those that survive; the exit status is 1 if there are any."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--base", default="main")
    parser.add_argument("--tests", nargs="+", metavar="PATH")
    asked = parser.parse_args()
    files = changed_files(asked.base)
    if not files:
        print(f"no file of diffabs/ differs between HEAD and {asked.base}")
        return 0
    base = subprocess.run(
        ["git", "merge-base", asked.base, "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()
    with tempfile.TemporaryDirectory() as name:
        tree = pathlib.Path(name).resolve() / "tree"
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", tree], cwd=ROOT, check=True)
        try:
            (tree / "cosmic-ray.toml").write_text(configuration(files, asked.tests or mirrored_tests(files), base))
            environment = {**os.environ, "PYTHONPATH": str(tree), "DIFFABS_JAX_CACHE": CACHE}
            environment["PYTHONDONTWRITEBYTECODE"] = "1"

            def cosmic_ray(*command: str) -> str:
                program = pathlib.Path(sys.executable).parent / command[0]
                work = [program, *command[1:]]
                return subprocess.run(
                    work, cwd=tree, env=environment, stdout=subprocess.PIPE, text=True, check=True
                ).stdout

            cosmic_ray("cosmic-ray", "init", "cosmic-ray.toml", "session.sqlite")
            cosmic_ray("cr-filter-git", "session.sqlite", "--config", "cosmic-ray.toml")
            cosmic_ray("cosmic-ray", "baseline", "cosmic-ray.toml")
            cosmic_ray("cosmic-ray", "exec", "cosmic-ray.toml", "session.sqlite")
            report = cosmic_ray("cr-report", "--surviving-only", "--show-diff", "session.sqlite")
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", tree], cwd=ROOT, check=True)
            shutil.rmtree(tree, ignore_errors=True)
    print(report)
    return int("SURVIVED" in report.upper())


if __name__ == "__main__":
    raise SystemExit(main())
