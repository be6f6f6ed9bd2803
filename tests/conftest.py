"""Every test runs in float64 unless it says otherwise, and compiled functions are kept between runs.

Compiling is what the tests cost and running is next to nothing, so XLA optimises nothing, here and in the processes
that are started: two to three times as fast. Nor does it split a program into parts that cores compile at the same
time: they are busy, and each part costs. DIFFABS_TEST_XLA=default is the compiler that users have."""

import gc
import importlib.metadata
import os
import pathlib
import signal

from marks import readable_id
from project import CACHE
from seams import replace_seam

QUICK = [
    *("--xla_backend_optimization_level=0", "--xla_cpu_parallel_codegen_split_count=1"),
    # These passes copy the program of a run again and again, to evaluate how often its loop repeats.
    "--xla_disable_hlo_passes=while-loop-invariant-code-motion,simplify-while-loops",
]
if importlib.metadata.version("jaxlib").startswith("0.10."):  # later ones end the process that names it
    QUICK.append("--xla_cpu_use_fusion_emitters=false")

if os.environ.get("DIFFABS_TEST_XLA") != "default" and "XLA_FLAGS" not in os.environ:  # a worker inherits it
    os.environ["XLA_FLAGS"] = " ".join(QUICK)
os.environ.setdefault("DIFFABS_ENGINE", "xla")  # and in the processes that are started; `users_engine` has the default
os.environ["JAX_COMPILATION_CACHE_DIR"] = os.environ.get("DIFFABS_JAX_CACHE", CACHE)
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"  # programs without the lines of Python that each operation is from

# A background job ignores SIGINT, and one under nohup SIGHUP. So would the processes that tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

gc.disable()  # until all is imported: what imports make stays, and looking through it took a fourth of the time

import jax  # noqa: E402  after its environment
import jaxtyping  # noqa: E402  before diffabs, whose shapes are then those of jaxtyping
import numpy as np  # noqa: E402
import pytest  # noqa: E402
import shape_checks  # noqa: E402

shape_checks.install()
jax.config.update("jax_enable_x64", True)

DEAREST = """
conformance kernel sweep deferred tune export sealed riccati proofs roads sweep_statistics blocks certificate linearize
real_rig batch kinks margins delay cli_tune rollout cli refusals papers sweep_kill kernel_start explore cli_design
kernel_tangents frames adaptive gradients arm_basin servo followed_slides tuning
"""  # the last ones for what is slow in them, or because they would end the run


def pytest_make_parametrize_id(config: pytest.Config, val: object, argname: str) -> str | None:
    """Ids of texts and of functions without a name; None leaves the others to pytest."""
    if isinstance(val, str):
        return readable_id(val)
    return argname if getattr(val, "__name__", "") == "<lambda>" else None


@pytest.hookimpl(trylast=True)  # after the choice by mark
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]):
    """Files are handed out whole (`--dist loadfile`), so that one worker compiles what the tests of a file share: those
    that take longest come first, and the workers end together.

    DIFFABS_TEST_PART=K/N keeps the tests K, K + N, K + 2 N, ... of those chosen."""
    if part := os.environ.get("DIFFABS_TEST_PART"):
        chosen, count = map(int, part.split("/"))
        config.hook.pytest_deselected(items=[item for i, item in enumerate(items) if i % count != chosen])
        items[:] = items[chosen::count]
    first = {f"test_{name}": place for place, name in enumerate(DEAREST.split())}
    items.sort(key=lambda item: first.get(item.path.stem, len(first)))


def pytest_collection_finish():
    """A worker's heap is large and nearly all of it stays: looking through it for cycles took a tenth of the time."""
    gc.freeze()  # without a look at it: the cycles that imports left in it are few
    gc.set_threshold(200_000, 10, 50)
    gc.enable()


@pytest.fixture
def refused_shapes():
    """For tests of the package's own words about a wrong shape: without the checks of annotations."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(autouse=True)
def _float64():
    """A test that leaves another precision behind is an error."""
    yield
    assert jax.config.jax_enable_x64


@pytest.fixture(autouse=True)
def _handlers():
    """A command in this process hears the signals itself; the test after it gets the handlers that pytest had."""
    numbers = [number for name in ("SIGINT", "SIGTERM", "SIGHUP") if (number := getattr(signal, name, None))]
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        if signal.getsignal(number) is not handler:
            signal.signal(number, handler)


@pytest.fixture(scope="module")
def any_step_is_stable():
    """Loading a scenario without the seconds of the stability check, which has tests of its own."""
    with pytest.MonkeyPatch.context() as patch:
        replace_seam(patch, "stable_step", lambda loop: np.inf)
        yield


@pytest.fixture(autouse=True, scope="session")
def without_load():
    """No lines on stderr that depend on the machine's load: of commands in this process, no wait is long."""
    with pytest.MonkeyPatch.context() as patch:
        replace_seam(patch, "patience", np.inf)
        yield


@pytest.fixture(autouse=True, scope="session")
def without_stability_of_single_runs():
    """`measure` and `rollout` without the seconds in which the check of a step compiles, which has tests of its own."""
    with pytest.MonkeyPatch.context() as patch:
        replace_seam(patch, "measured_step", lambda loop, solver: [])
        yield


@pytest.fixture
def users_engine(monkeypatch: pytest.MonkeyPatch):
    """The default engine is that of users. Elsewhere it is XLA: kernels are compiled only where tests ask for them."""
    monkeypatch.delenv("DIFFABS_ENGINE")


@pytest.fixture
def file(tmp_path: pathlib.Path):
    """Write a scenario file."""

    def write(text: str, name: str = "mine.toml") -> pathlib.Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture(scope="session")
def native_prover() -> None:
    """The native prover; a machine without a compiler skips the test."""
    from diffabs.compiler.runtime.toolchain import NoCompiler
    from diffabs.robust.reach import engine

    try:
        engine.library()
    except NoCompiler as error:
        pytest.skip(str(error))
