"""Tests of the prover need a C++ compiler."""

import pytest

from diffabs.compiler.runtime.toolchain import NoCompiler
from diffabs.reach import engine


@pytest.fixture(scope="session")
def native_prover() -> None:
    """The native prover; a machine without a compiler skips the test."""
    try:
        engine.library()
    except NoCompiler as error:
        pytest.skip(str(error))
