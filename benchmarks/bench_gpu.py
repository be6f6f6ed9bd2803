"""Closed loops per second on an NVIDIA GPU: a kernel of diffabs, its XLA path, and diffrax, on the problem of the peers
(peers/problem.py), at equal accuracy; and what share of the card's FP32 rate the kernel's own arithmetic is. With
--lorenz the Lorenz ensemble of bench_yardsticks.py follows, by 1,000 equal steps: kernel, and diffrax under vmap.

The rate is measured first, by a kernel that only multiplies and adds. The share counts the real additions,
multiplications and divisions of a step as the program has them, one each, times the steps of the runs; selections,
comparisons, elementary functions and whole numbers count nothing. Times are medians of `--rounds`, or one if a call
takes longer than 10 s. Each row is printed when it is measured, since XLA may take minutes.

With --machine-code no GPU is asked for: registers and spills of the packaged scenarios for sm_80 and sm_90, as NVRTC's
assembler tells them.

    python benchmarks/bench_gpu.py [--lanes 131072 1048576] [--dtypes float32 float64] [--rounds 5] [--lorenz 768000]
    python benchmarks/bench_gpu.py --machine-code
"""

import argparse
import ctypes
import functools
import itertools
import pathlib
import statistics
import time
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import record
from jax.experimental.buffer_callback import buffer_callback
from peers import on_devices, problem, reference
from rich.console import Console
from rich.table import Column, Table

import diffabs
from diffabs import scenario
from diffabs.compiler import pipeline
from diffabs.compiler.emit import cuda
from diffabs.compiler.ir import UpdateLevel, is_real, live_nodes
from diffabs.compiler.program import ScalarProgram
from diffabs.compiler.runtime import gpu, nvrtc
from diffabs.core.pytree import get
from diffabs.engine.drive import kernel as native

ACCURACY = 1e-4
STEPS, TOLERANCES, TOLERANCES_OF_DIFFRAX = (1e-3, 5e-4, 2e-4, 1e-4), (1e-5, 5e-6, 1e-6), (1e-6, 1e-7, 1e-8, 3e-9)
CONTENDERS = ("kernel", "XLA", "diffrax")
SLOW = 10.0  # s: a call that takes longer is timed once
COUNTED = {"add": 1, "sub": 1, "mul": 1, "div": 1}
TURNS, CHAINS, THREADS = 1 << 15, 8, 1 << 20  # of the kernel that measures the card
RATE = f"""
struct Arrays {{ void* data[3]; }};
extern "C" __global__ void begin_all(const Arrays arrays, void* shared, long long* next, long long threads) {{}}
extern "C" __global__ void run_all(const Arrays arrays, const void* shared, long long* next, long long count) {{
  float x[{CHAINS}];
  const float a = 0.999f, b = threadIdx.x*1e-3f;
  for (int k = 0; k < {CHAINS}; k++) x[k] = b + k;
  for (int i = 0; i < {TURNS}; i++)
    for (int k = 0; k < {CHAINS}; k++) x[k] = a*x[k] + b;
  float sum = 0;
  for (int k = 0; k < {CHAINS}; k++) sum += x[k];
  if (sum == 12345.f) ((float*)arrays.data[1])[0] = sum;
}}
"""


def rate(on: Any, rounds: int) -> float:
    """Return the card's single-precision operations per second, an addition and a multiplication each one."""
    code = on.compile(RATE)
    blocks = -(-THREADS // cuda.THREADS_PER_BLOCK) * cuda.THREADS_PER_BLOCK

    def start(context, outs, ins):
        addresses = (ctypes.c_void_p * 3)(on.address(ins), on.address(outs[0]), 0)
        on.start(code, addresses, on.address(outs[1]), blocks, context)

    shapes = [jax.ShapeDtypeStruct((1,), np.float32), jax.ShapeDtypeStruct((256,), np.uint8)]
    call = jax.jit(lambda x: buffer_callback(start, shapes)(x))
    jax.block_until_ready(call(jnp.zeros(1)))
    seconds = statistics.median(record.timed(lambda: jax.block_until_ready(call(jnp.zeros(1)))) for _ in range(rounds))
    return 2.0 * TURNS * CHAINS * held(on, code) / seconds


def held(on: Any, code: pathlib.Path) -> int:
    """Return how many threads a launch has: no more than the card holds at once."""
    blocks = next(one.blocks for (path, _), one in on._loaded.items() if path == code)
    return min(blocks, -(-THREADS // cuda.THREADS_PER_BLOCK)) * cuda.THREADS_PER_BLOCK


def arithmetic(program: ScalarProgram) -> int:
    """Return how many real operations a step has."""
    nodes = live_nodes(program.results["step"])
    return sum(COUNTED.get(node.op, 0) for node in nodes if node.level == UpdateLevel.STEP and is_real(node.dtype))


def programs() -> list[ScalarProgram]:
    """Return a list to which every program that is translated from now on is added."""
    found, source = [], cuda.emit_cuda
    cuda.emit_cuda = lambda program, shape: (found.append(program), source(program, shape))[1]
    return found


def solvers(masses, speeds, dtype):
    """Return, by name, the settings of each contender, and what makes its program for one. None stands for the setting
    of the kernel of the same kind, which solves by the same method; for the finest one if no kernel is measured."""
    from peers import ours

    def of(kind, engine):
        return lambda setting: ours.prepared_with(kind, engine, masses, speeds, setting, dtype)

    found = {
        "kernel, FixedStep": (STEPS, of("fixed", "kernel")),
        "kernel, Adaptive": (TOLERANCES, of("adaptive", "kernel")),
        "XLA, FixedStep": (None, of("fixed", "xla")),
        "XLA, Adaptive": (None, of("adaptive", "xla")),
    }
    try:
        from peers import diffrax_event
    except ImportError:
        return found
    solve = lambda setting: jax.vmap(functools.partial(diffrax_event.one, tolerance=setting))  # noqa: E731
    found["diffrax, Tsit5"] = (
        TOLERANCES_OF_DIFFRAX,
        lambda setting: on_devices.spread(solve(setting), masses, speeds, dtype),
    )
    return found


def measured(lanes, dtype, rounds, peak, operations, contenders=CONTENDERS):
    """Yield a row for each contender: its setting, error, runs per second, seconds to the result of its coarsest
    setting, compilation included, and the kernel's share of the card's rate.

    operations: real operations of a step, by kernel and type of its numbers, of what is compiled already; those of new
    kernels are added"""
    masses, speeds = problem.lanes(lanes)
    (right, _), seen, accurate = reference.answers(masses, speeds), programs(), {}
    jax.config.update("jax_enable_x64", dtype == "float64")
    for name, (settings, prepared) in solvers(masses, speeds, dtype).items():
        engine, _, kind = name.partition(", ")
        if engine not in contenders:
            continue
        points, known = [], len(seen)
        for setting in settings or [accurate.get(kind, STEPS[-1] if kind == "FixedStep" else TOLERANCES[-1])]:
            begun = time.perf_counter()
            run = prepared(setting)
            found = run()
            first = time.perf_counter() - begun
            error = float(problem.errors(found, right).max())
            points.append({"setting": setting, "error": error, "run": run, "first": first})
            if len(seen) > known:
                operations[name, dtype] = arithmetic(seen[-1])
            if error <= ACCURACY:
                break
        chosen = record.best(points, ACCURACY)
        once = record.timed(chosen["run"])
        taken = [once] if once > SLOW else [record.timed(chosen["run"]) for _ in range(rounds)]
        runs = lanes / statistics.median(taken)
        row = {"name": name, "lanes": lanes, "dtype": dtype, "setting": chosen["setting"], "error": chosen["error"]}
        row |= {"first": points[0]["first"], "runs": runs, "rounds": len(taken)}
        if engine == "kernel":
            accurate[kind] = chosen["setting"]
        if name == "kernel, FixedStep" and dtype == "float32" and (name, dtype) in operations:
            row["share"] = runs * float(np.mean(found[0])) / chosen["setting"] * operations[name, dtype] / peak
        yield row


def ensemble(lanes, dtype, rounds):
    """Yield a row for each contender on the Lorenz ensemble, on the device that JAX has."""
    import bench_yardsticks as yardsticks

    jax.config.update("jax_enable_x64", dtype == "float64")
    which, truth = yardsticks.checked(lanes)
    rho = yardsticks.rhos(lanes).astype(dtype)
    makers = {
        "Lorenz: kernel": yardsticks.by_diffabs("fixed", rho),
        "Lorenz: diffrax, RK4": yardsticks.by_diffrax("fixed", rho, lanes),
    }
    for name, prepared in makers.items():
        call = prepared(None)
        begun = time.perf_counter()
        error = yardsticks.worst(call(), which, truth)
        first = time.perf_counter() - begun
        runs = lanes / statistics.median(record.timed(call) for _ in range(rounds))
        row = {"name": name, "lanes": lanes, "dtype": dtype, "setting": 1 / yardsticks.STEPS, "error": error}
        yield row | {"first": first, "runs": runs, "rounds": rounds}


class Translated(Exception):
    """A program, and how it is to be run."""


def translated(name, dtype):
    """Return program and shape of a packaged scenario."""

    def launched(made, before, carry, shape):
        raise Translated(made, shape)

    one, path = scenario.load(name), "initial.theta" if name.startswith("arm") else "initial.speed"
    lanes = diffabs.Batch({path: np.full(2, float(get(one.loop, path)))}, np.arange(2))
    given = (one.loop, lanes, one.solver, one.objectives)
    with jax.enable_x64(dtype == "float64"), mock.patch.object(pipeline, "_launch_lanes", launched):
        native._run.clear_cache()
        try:
            diffabs.run_batch(*given, together=False, accepted=True, engine="kernel")
        except Translated as done:
            return done.args
    raise AssertionError("no kernel was asked for")


def in_registers(dtypes):
    """Print what a thread of each packaged scenario needs."""
    table = Table(Column(no_wrap=True), "numbers", "", "operations", "real ones", "registers", "bytes spilled")
    for name in scenario.names():
        for dtype in dtypes:
            program, shape = translated(name, dtype)
            source = cuda.emit_cuda(program, shape)
            operations = (len(live_nodes(program.results["step"])), arithmetic(program))
            for architecture in ("sm_80", "sm_90"):
                log = nvrtc.build_cubin(source.text, architecture).with_suffix(".log").read_text()
                used = nvrtc.parse_register_usage(log)["run_all"]
                numbers = map(str, (*operations, used["registers"], used["spilled"]))
                table.add_row(name, dtype, architecture, *numbers)
    Console().print(table)


def on_a_gpu(options):
    """Measure, print, write. Exits where JAX runs on no GPU."""
    on = gpu.find_gpu()
    if on is None:
        raise SystemExit("JAX runs on no GPU here: pip install jax[cuda13] on a machine with one")
    peak, rounds, rows = rate(on, options.rounds), options.rounds, []
    print(f"{on.architecture}, FP32, measured: {peak / 1e12:.1f} Tflop/s", flush=True)
    cases = [(n, dtype) for n in options.lanes for dtype in options.dtypes]
    operations: dict[tuple[str, str], int] = {}
    found = [measured(*case, rounds, peak, operations, options.contenders) for case in cases]
    found += [ensemble(n, dtype, rounds) for n in options.lorenz for dtype in options.dtypes]
    for row in itertools.chain.from_iterable(found):
        share = f"{row['share']:.1%}" if "share" in row else ""
        print(
            f"{row['name']:22} {row['lanes']:>9,} {row['dtype']} {row['setting']:<7g} error {row['error']:.1e} "
            f"first {row['first']:6.1f} s  {row['runs']:>13,.0f} runs/s ({row['rounds']}) {share}",
            flush=True,
        )
        rows.append(row)
        written = record.written("gpu", {"rows": rows, "fp32_flops": peak, "accuracy": ACCURACY}, options.out)
    print(written if rows else "nothing to measure")


def main():
    """Do what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, nargs="*", default=[1 << 17, 1 << 20])
    parser.add_argument("--dtypes", nargs="+", default=["float32", "float64"], choices=("float32", "float64"))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--contenders", nargs="+", default=list(CONTENDERS), choices=CONTENDERS)
    parser.add_argument("--lorenz", type=int, nargs="*", default=[], metavar="LANES")
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--machine-code", action="store_true")
    options = parser.parse_args()
    if options.machine_code:
        in_registers(options.dtypes)
    else:
        on_a_gpu(options)


if __name__ == "__main__":
    main()
