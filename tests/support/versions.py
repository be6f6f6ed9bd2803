"""Run tests under other versions of Python and JAX.

    python tests/support/versions.py python3.11=0.10 python3.12=0.11 python3.13=0.12 python3.14=pre

`pre` is JAX's newest pre-release, which may be newer than the package allows. Each pair gets a virtual environment of
its own below --out, with the package, its extras and the tests' group. The fast tests run with the compiler flags that
users have: how long XLA compiles a loop depends on its version. Prints a line for each pair; exits with 1 if one has
failed.
"""

import argparse
import os
import pathlib
import subprocess
import sys

from project import ROOT

PRE_RELEASES = "https://us-python.pkg.dev/ml-oss-artifacts-published/jax/simple/"  # of JAX, built each night


def environment(folder: pathlib.Path, python: str, jax: str) -> pathlib.Path:
    """The interpreter of a virtual environment with this JAX. Raises CalledProcessError."""
    interpreter = folder / "bin" / "python"
    if not interpreter.exists():
        subprocess.run([python, "-m", "venv", folder], check=True)
    pip = [interpreter, "-m", "pip", "install", "--quiet"]
    subprocess.run([*pip, "--upgrade", "pip>=25.1"], check=True, cwd=ROOT)
    release = [] if jax == "pre" else [f"jax=={jax}.*"]
    subprocess.run([*pip, *release, "--editable", ".[all]"], check=True, cwd=ROOT)
    subprocess.run([*pip, "--group", "test"], check=True, cwd=ROOT)
    if jax == "pre":  # last, and apart from the package, whose limit would exclude it
        subprocess.run([*pip, "--pre", "--upgrade", "--extra-index-url", PRE_RELEASES, "jax", "jaxlib"], check=True)
    return interpreter


def main() -> int:
    """Run each pair. Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+", metavar="PYTHON=JAX")
    parser.add_argument("--tests", nargs="+", metavar="FILE", default=["tests"])
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "out" / "versions")
    options = parser.parse_args()
    pairs = [tuple(pair.rpartition("=")[::2]) for pair in options.pairs]
    if not all(python and jax for python, jax in pairs):
        parser.error("a pair is PYTHON=JAX, as in python3.13=0.12 or python3.14=pre")
    failed = 0
    for python, jax in pairs:
        folder = options.out.absolute() / f"{pathlib.Path(python).name}-jax-{jax}"
        try:
            interpreter = environment(folder, python, jax)
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"{python} with JAX {jax}: not installed: {error}", flush=True)
            failed += 1
            continue
        pytest = ["-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "-m", "not slow", "-p", "no:cacheprovider"]
        flags = {**os.environ, "DIFFABS_TEST_XLA": "default"}
        status = subprocess.run([interpreter, *pytest, *options.tests], cwd=ROOT, env=flags).returncode
        print(f"{python} with JAX {jax}: {'passed' if status == 0 else 'FAILED'}", flush=True)
        failed += status != 0
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
