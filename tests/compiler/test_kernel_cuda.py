"""The kernels of a GPU: text run thread by thread on the processor, machine code where NVRTC is found, and on a GPU
where there is one (marker gpu)."""

import ctypes
import dataclasses
import importlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import marks
import numpy as np
import pytest
import test_kernel_native
import test_kernel_parts as cases
import test_kernel_tangents
from cuda_on_processor import Processor
from kernels import FOLDER, applied, both, same
from mutants import killed_by
from project import ROOT
from seams import replace_seam
from test_kernel import AT_ONCE, DIVERGING, KEYS, LOOP, MEASURED, NEVER, SOLVER, VALUES

import diffabs as d
from diffabs import scenario
from diffabs.compiler.emit import cuda
from diffabs.compiler.runtime import gpu, library_cache, nvrtc
from diffabs.compiler.runtime.toolchain import NoCompiler
from diffabs.engine.drive import kernel as native
from diffabs.loop import ensemble
from diffabs.scenario.defaults import braking

pytestmark = pytest.mark.xdist_group("kernel cuda")
ON_GPU = jax.default_backend() == "gpu"
TANGENTS = ("of both", "eleven tangents", "several tangents for several gains")


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch):
    monkeypatch.setenv(library_cache.CACHE, FOLDER)
    native._run.clear_cache()
    yield
    native._run.clear_cache()


@pytest.fixture
def processor(monkeypatch):
    found = Processor()
    replace_seam(monkeypatch, "find_gpu", lambda: found)
    return found


class TestText:
    """By stand-ins for CUDA's own names."""

    @killed_by("compiler/native/threads.h", "j = (i64)atomicAdd((u64*)next, (u64)1);", "j = count;")
    @killed_by("compiler/native/threads.h", "arrays.carry);\n    begin(b, s, 0);\n  }", "arrays.carry);\n  }")
    @killed_by("compiler/native/threads.h", "*next = threads;", "*next = threads + 1;")
    @pytest.mark.slow
    def test_runs_are_those_of_xla(self, processor):
        """Lanes that begin beyond their stop, diverge and run out of time among them; noise to the last digits."""
        found, expected = both(LOOP, VALUES, SOLVER, MEASURED, KEYS)
        assert np.flatnonzero(expected.diverged).tolist() == [AT_ONCE, DIVERGING]
        assert expected.timed_out[NEVER]
        assert processor.rooms
        same(found, expected, rtol=1e-13, atol=1e-15)

    @pytest.mark.slow
    def test_runs_in_single_precision(self, processor):
        with jax.enable_x64(False):
            values = {"initial.speed": np.linspace(27.0, 33.0, 12) / 3.6}
            found, expected = both(LOOP, values, SOLVER, MEASURED, KEYS[:12])
        assert found.metrics["iae"].dtype == np.float32
        same(found, expected, rtol=2e-4, atol=1e-6)

    @pytest.mark.slow
    @killed_by(
        "compiler/native/lane.h",
        "T most(T a, T b) { return a == a ? higher(a, b) : a; }",
        "T most(T a, T b) { return higher(a, b); }",
    )
    @killed_by("compiler/native/lane.h", "x < high ? (V)x : greatest", "true ? (V)x : greatest")
    @killed_by("compiler/native/lane.h", "both.from = x;", "both.to = (V)x;")
    def test_rules_are_those_of_jax(self, processor):
        """Every rule in one kernel, NaN and infinite arguments among them."""
        test_kernel_native.test_rules_are_those_of_jax()

    def test_ends_of_functions(self, processor):
        x = np.array([np.inf, -np.inf, np.nan, 0.0, -0.0, 1.0, -1.0, 710.0, -746.0, 1e300, -1e300])
        names = (*test_kernel_native.REAL, *test_kernel_native.EXACT)
        found = applied({name: getattr(jnp, name) for name in names}, x)
        for name in names:
            with np.errstate(all="ignore"):
                expected = getattr(jnp if name == "sign" else np, name)(x)
            np.testing.assert_allclose(found[name], expected, rtol=1e-15, atol=0, err_msg=name)

    def test_of_no_lanes(self, processor):
        assert applied({"f": jnp.sin}, np.ones(1)[:1])["f"].shape == (1,)

    @pytest.mark.slow
    def test_under_vmap(self, processor):
        def at(mass):
            lanes = d.Batch(VALUES, KEYS)
            loop = d.replace(LOOP, {"plant.mass": mass})
            return d.run_batch(loop, lanes, SOLVER, MEASURED, together=False, accepted=True, engine="kernel").metrics

        mass = float(LOOP.plant.mass)
        two = jax.device_get(jax.vmap(at)(jnp.array([0.97 * mass, mass])))["iae"]
        np.testing.assert_array_equal(two[1], at(mass)["iae"])
        assert not np.any(two[0] == two[1])

    @pytest.mark.slow
    @pytest.mark.parametrize("way", marks.cases(TANGENTS, *TANGENTS[:2]))
    def test_derivatives_are_those_of_xla(self, way, processor):
        test_kernel_tangents.TestLaunch().test_derivatives_are_those_of_xla(way)

    @pytest.mark.slow
    @pytest.mark.parametrize(("family", "name"), cases.CASES, ids=map("-".join, cases.CASES))
    def test_a_part(self, family, name, processor):
        """With fixed steps: with adaptive ones a part has the same operations."""
        cases.test_a_part(family, name, "fixed")

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", cases.SOLVERS)
    @pytest.mark.parametrize("name", scenario.names())
    def test_a_scenario(self, name, kind, processor):
        cases.test_a_scenario(name, kind)

    @pytest.mark.slow
    def test_objectives(self, processor):
        cases.test_objectives()


MOST = {"float32": (168, 16), "float64": (255, 1600)}  # registers of a thread (255 is all it can have), bytes spilled
LARGE = {"slip-real": {"float32": 160}}  # bytes spilled by a program of two to three times the size
FAST = ("slip-lmi", "arm-balance")


class TestMachineCode:
    @pytest.fixture(autouse=True)
    def _compiler(self):
        try:
            nvrtc.nvrtc_version()
        except NoCompiler as error:
            pytest.skip(str(error))

    @pytest.mark.parametrize("architecture", ["sm_80", "sm_90"])
    @pytest.mark.parametrize("dtype", MOST)
    @pytest.mark.parametrize(
        "name", [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in scenario.names()]
    )
    def test_of_a_scenario_stays_in_registers(self, name, dtype, architecture, monkeypatch):
        monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
        source = cuda.emit_cuda(*importlib.import_module("bench_gpu").translated(name, dtype))
        code = nvrtc.build_cubin(source.text, architecture)
        assert code.read_bytes()[:4] == b"\x7fELF"
        used = nvrtc.parse_register_usage(code.with_suffix(".log").read_text())["run_all"]
        most, spilled = MOST[dtype]
        assert used["registers"] <= most
        assert used["spilled"] <= LARGE.get(name, {}).get(dtype, spilled)

    def test_of_a_wrong_text_is_an_objection(self, tmp_path, monkeypatch):
        monkeypatch.setenv(library_cache.CACHE, str(tmp_path))
        with pytest.raises(NoCompiler, match=r"NVRTC, sm_90: kernel.cu\(1\): error"):
            nvrtc.build_cubin("nonsense", "sm_90")
        assert not [*tmp_path.iterdir()]


@killed_by(
    "compiler.runtime.nvrtc",
    "repr((NVRTC_FLAGS, nvrtc_version(), architecture))",
    "repr((nvrtc_version(), architecture))",
)
def test_machine_code_is_made_once(tmp_path, monkeypatch):
    """For the same text, flags and architecture."""
    made = []
    monkeypatch.setenv(library_cache.CACHE, str(tmp_path))
    replace_seam(monkeypatch, "nvrtc_version", lambda: (13, 5))
    replace_seam(monkeypatch, "compile_cubin", lambda *args: (made.append(args), (b"code", "what was said"))[1])
    path = nvrtc.build_cubin("text", "sm_90")
    assert nvrtc.build_cubin("text", "sm_90") == path
    assert (len(made), path.read_bytes(), path.with_suffix(".log").read_text()) == (1, b"code", "what was said")
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".cubin", ".log"]
    others = {nvrtc.build_cubin("text", "sm_80"), nvrtc.build_cubin("other", "sm_90")}
    replace_seam(monkeypatch, "nvrtc_flags", (*nvrtc.NVRTC_FLAGS, "-w"))
    assert len({path, *others, nvrtc.build_cubin("text", "sm_90")}) == 4


class TestObjections:
    def test_without_nvrtc(self, monkeypatch):
        monkeypatch.setattr(nvrtc.importlib.util, "find_spec", lambda name: None)
        monkeypatch.setattr(nvrtc.ctypes, "CDLL", lambda path: (_ for _ in ()).throw(OSError(path)))
        with pytest.raises(NoCompiler, match="no CUDA compiler; the package nvidia-cuda-nvrtc"):
            nvrtc._load_nvrtc.__wrapped__()

    @killed_by("compiler.runtime.gpu", 'if not capability.replace(".", "").isdigit():', "if False:")
    def test_of_a_gpu_of_another_make(self, monkeypatch):
        replace_seam(monkeypatch, "gpu_devices", lambda: [Home("gpu", "gfx942")])
        line = "kernels are for processors and NVIDIA's GPUs, not for gpu gfx942"
        assert ensemble.kernel_objection(LOOP, VALUES, SOLVER, MEASURED) == line
        replace_seam(monkeypatch, "gpu_devices", lambda: [Home("gpu", "9.0")])
        assert gpu.find_gpu().architecture == "sm_90"


@dataclasses.dataclass(frozen=True)
class Home:
    """What JAX says of a device."""

    platform: str
    compute_capability: str


class Context(NamedTuple):
    """What XLA says of a call."""

    stream: int


class Driver:
    """Stands in for the driver: remembers what it is asked."""

    def __init__(self, failing=""):
        self.asked, self.launches, self.failing = [], [], failing

    def __getattr__(self, name):
        def call(*args):
            self.asked.append(name)
            if name == "cuGetErrorName":
                args[1]._obj.value = b"CUDA_ERROR_OUT_OF_MEMORY"
                return 0
            if name in ("cuDeviceGetAttribute", "cuOccupancyMaxActiveBlocksPerMultiprocessor"):
                args[0]._obj.value = 132 if name == "cuDeviceGetAttribute" else 3
            if name == "cuLaunchKernel":
                given = [ctypes.cast(args[9][i], ctypes.POINTER(ctypes.c_uint64))[0] for i in range(4)]
                self.launches.append((args[1], args[4], args[8].value, given))
            return 2 if name == self.failing else 0

        return call


class TestDriver:
    def start(self, driver, count, monkeypatch, tmp_path):
        replace_seam(monkeypatch, "load_driver", lambda: driver)
        code = tmp_path / "one.cubin"
        code.write_bytes(b"")
        arrays = gpu._pack_addresses([1, 2, 3, 4, 5, 6], [1, 1, 2, 2])
        assert [x or 0 for x in arrays] == [1, 0, 2, 0, 3, 4, 0, 5, 6, 0]
        on = gpu.CudaDevice("sm_90")
        on.start(code, arrays, 4096, count, Context(77))
        return on, code, arrays

    @killed_by("compiler.runtime.gpu", "ctypes.c_int64(blocks * cuda.THREADS_PER_BLOCK)", "ctypes.c_int64(blocks)")
    @killed_by(
        "compiler.runtime.gpu", "cuda.THREADS_PER_BLOCK, context.stream, arrays", "cuda.THREADS_PER_BLOCK, 0, arrays"
    )
    @killed_by(
        "compiler.runtime.gpu",
        "min(loaded.blocks, -(-count // cuda.THREADS_PER_BLOCK))",
        "-(-count // cuda.THREADS_PER_BLOCK)",
    )
    def test_is_told_of_arrays_threads_and_lanes(self, monkeypatch, tmp_path):
        """No more blocks than there are lanes for, nor than the device holds; one thread first; XLA's stream."""
        for count, blocks in ((1000, 8), (10**6, 3 * 132)):
            driver = Driver()
            self.start(driver, count, monkeypatch, tmp_path)
            first, second = driver.launches
            shared = 4096 + cuda.COUNTER
            assert first == (1, 1, 77, [1, shared, 4096, blocks * cuda.THREADS_PER_BLOCK])
            assert second == (blocks, cuda.THREADS_PER_BLOCK, 77, [1, shared, 4096, count])
            assert driver.asked.count("cuCtxPushCurrent_v2") == driver.asked.count("cuCtxPopCurrent_v2") == 2

    def test_loads_machine_code_once(self, monkeypatch, tmp_path):
        driver = Driver()
        on, code, arrays = self.start(driver, 10, monkeypatch, tmp_path)
        on.start(code, arrays, 4096, 10, Context(77))
        assert driver.asked.count("cuModuleLoadData") == 1
        assert len(driver.launches) == 4

    @killed_by(
        "compiler.runtime.gpu",
        '    finally:\n        _call_driver("cuCtxPop',
        '    except ZeroDivisionError:\n        _call_driver("cuCtxPop',
    )
    def test_objects(self, monkeypatch, tmp_path):
        driver = Driver(failing="cuModuleLoadData")
        with pytest.raises(RuntimeError, match=r"cuModuleLoadData: CUDA_ERROR_OUT_OF_MEMORY \(2\)"):
            self.start(driver, 10, monkeypatch, tmp_path)
        assert driver.asked.count("cuCtxPushCurrent_v2") == driver.asked.count("cuCtxPopCurrent_v2") == 1


@pytest.mark.gpu
@pytest.mark.skipif(not ON_GPU, reason="JAX runs on no GPU")
class TestGPU:
    """On an NVIDIA H200 they passed on 2026-11-27 with JAX 0.11.2 (docs/performance.md); no machine of CI has a GPU."""

    def test_runs_are_those_of_xla(self):
        found, expected = both(LOOP, VALUES, SOLVER, MEASURED, KEYS)
        same(found, expected, rtol=1e-12, atol=1e-14)

    def test_rules_are_those_of_jax(self):
        test_kernel_native.test_rules_are_those_of_jax()

    @pytest.mark.parametrize("way", test_kernel_tangents.WAYS)
    def test_derivatives_are_those_of_xla(self, way):
        test_kernel_tangents.TestLaunch().test_derivatives_are_those_of_xla(way)

    @pytest.mark.parametrize("kind", cases.SOLVERS)
    @pytest.mark.parametrize("name", scenario.names())
    def test_a_scenario(self, name, kind):
        cases.test_a_scenario(name, kind)

    def test_objectives(self):
        cases.test_objectives()

    def test_in_single_precision(self):
        cases.test_in_single_precision()

    def test_more_lanes_than_threads(self):
        count = 300_000
        lanes = d.Batch({"initial.speed": np.linspace(26.0, 33.0, count) / 3.6})
        loop = d.replace(LOOP, {"sensor": braking(plant=LOOP.plant).sensor})
        solver = d.FixedStep(2e-3, 0.5)
        run = d.run_batch(loop, lanes, solver, MEASURED, together=False, accepted=True, engine="kernel")
        few = d.Batch({"initial.speed": np.asarray(lanes.values["initial.speed"])[:: count // 50]})
        expected = d.run_batch(loop, few, solver, MEASURED, together=False, accepted=True)
        np.testing.assert_allclose(run.metrics["iae"][:: count // 50], expected.metrics["iae"], rtol=1e-12)
