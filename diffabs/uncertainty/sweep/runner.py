"""Execution of chunks in compiled functions.

A sample that `simulate` would refuse does not run; its row gives the reason.

A block is a fixed number of runs with one structure of the loop. On D devices, D blocks run at once, each in a program
of its own. A program sharded over the devices (`shard_map`) would differ for each D, and round differently. This
program is the same for all D, so the result of a run does not depend on D.

Without alternative parts a block is a whole chunk. With them a chunk is sorted into blocks of an eighth. Copies, which
do not run, fill the last block of each structure.
"""

import contextlib
import functools
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from diffabs.compiler.runtime.toolchain import NoCompiler
from diffabs.core.jax_flags import default_flags
from diffabs.core.protocols import Objective
from diffabs.core.types import Bool, Int, JsonObject, Params, Part, PyTree
from diffabs.engine.drive.engine import EngineError
from diffabs.engine.solvers import Solver
from diffabs.host.process import default_devices, default_platform
from diffabs.loop.admissible import batch_admissibility
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.loop.ensemble import run_batch
from diffabs.uncertainty.sweep.study import FLAG_COLUMNS, Study, noise_key, precision

BLOCKS_PER_CHUNK = 8

Columns = dict[str, np.ndarray]


class _Block(NamedTuple):
    """A block of runs of one chunk, with their parameters.

    Attributes:
        chunk: Place of the chunk in a list of chunks.
        lanes: Places of the runs in the chunk.
        values: Values of the parameters, by path, shape (block,).
        samples: Numbers of the samples, shape (block,).
    """

    chunk: int
    lanes: np.ndarray
    values: dict[str, np.ndarray]
    samples: np.ndarray


class Runner:
    """A runner of a study's chunks on devices of this process.

    A process compiles once for each structure of the loop, also for other runners and other numbers.
    """

    def __init__(self, study: Study, devices: Sequence[PyTree] | None = None):
        """Set the `study` and the `devices`, one for each block that runs at a time; by default all local ones once."""
        self.study = study
        self.devices: list[PyTree] = list(devices or default_devices())
        self.size: int = study.chunk if not study.parts else -(-study.chunk // BLOCKS_PER_CHUNK)
        self._pool = ThreadPoolExecutor(len(self.devices))

    def run(self, chunks: Sequence[int]) -> list[Columns]:
        """Return the columns of each of the `chunks`, by name.

        They are sample, parameters, metrics, stopped, diverged, and refused (the reason, or '').
        """
        return self._run_drawn([self._draw_chunk(c) for c in chunks])

    def run_samples(self, samples: Sequence[int]) -> Columns:
        """Return the columns of at most a chunk of single `samples`, with the program of a chunk."""
        rows = [self.study.draw(i, i + 1) for i in samples]
        drawn = {path: np.concatenate([row[path] for row in rows]) for path in rows[0]}
        return self._run_drawn([{"sample": np.asarray(samples), **drawn}])[0]

    @default_flags()
    def _run_drawn(self, drawn: list[Columns]) -> list[Columns]:
        """Return the columns of chunks, from their samples and drawn values."""
        for columns in drawn:
            columns |= {name: np.zeros(len(columns["sample"]), self.study.dtype) for name in self.study.objectives}
            columns |= {name: np.zeros(len(columns["sample"]), bool) for name in FLAG_COLUMNS[:-1]}
            columns |= {FLAG_COLUMNS[-1]: np.full(len(columns["sample"]), "", object)}
        for names, blocks in self._sort_into_blocks(drawn).items():
            run = partial(self._run_on_device, self._variant(names))
            for k in range(0, len(blocks), len(self.devices)):
                together = blocks[k : k + len(self.devices)]  # at most one for each device
                for block, block_columns in zip(together, self._pool.map(run, together, self.devices), strict=True):
                    for name, column in block_columns.items():
                        drawn[block.chunk][name][block.lanes] = column[: len(block.lanes)]
        return drawn

    def _draw_chunk(self, chunk: int) -> Columns:
        start, stop = self.study.bounds(chunk)
        return {"sample": np.arange(start, stop), **self.study.draw(start, stop)}

    def _sort_into_blocks(self, drawn: list[Columns]) -> dict[tuple[str, ...], list[_Block]]:
        """Return the blocks, grouped by the names of their parts."""
        blocks: dict[tuple[str, ...], list[_Block]] = {}
        for c, columns in enumerate(drawn):
            names = np.array([np.asarray(columns[path], str) for path in self.study.parts]).T
            names = names.reshape(len(columns["sample"]), len(self.study.parts))
            values = self.study.numbers({path: columns[path] for path in self.study.space.paths})
            for kind in sorted(set(map(tuple, names.tolist()))):
                members = np.flatnonzero((names == np.array(kind, dtype=names.dtype)).all(axis=1))
                for k in range(0, len(members), self.size):
                    lanes = members[k : k + self.size]
                    # `resize` repeats the runs: a block of full size needs no second program.
                    filled = np.resize(lanes, self.size)
                    block = _Block(c, lanes, {p: v[filled] for p, v in values.items()}, columns["sample"][filled])
                    blocks.setdefault(kind, []).append(block)
        return blocks

    @default_flags()
    def _run_on_device(self, loop: Part, block: _Block, device: Any) -> Columns:
        with jax.default_device(device):
            admissibility = batch_admissibility(loop, block.values, self.study.solver)
        # A kernel is made for the default platform.
        elsewhere = device.platform != default_platform()
        with (
            jax.default_device(device) if elsewhere else contextlib.nullcontext(),
            precision(self.study.dtype),
            _convert_compiler_errors(),
        ):
            runs = admissibility.accepted & (np.arange(self.size) < len(block.lanes))  # the rest are copies
            arguments = jax.device_put(self._arguments(loop, block, runs), device)
            columns = jax.device_get(_measure_block(*arguments, self.study.solver, self.study.engine))
        return columns | {"refused": admissibility.texts.astype(object)}

    def _arguments(self, loop: object, block: _Block, accepted: Bool) -> tuple[PyTree, ...]:
        numbers = loop, dict(self.study.objectives), block.values
        converted = jax.tree.map(lambda x: np.asarray(x, self.study.dtype), numbers)
        return *converted, np.asarray(self.study.seed), block.samples.astype(np.uint32), accepted

    def _variant(self, names: tuple[str, ...]) -> Loop:
        return self.study.variant(dict(zip(self.study.parts, names, strict=True)))


@contextlib.contextmanager
def _convert_compiler_errors() -> Iterator[None]:
    """Raise EngineError if a kernel cannot be compiled, because of a full disk for example."""
    try:
        yield
    except NoCompiler as error:
        raise EngineError.of(error) from None


def find_study_objection(study: Study) -> str | None:
    """Return why the study's engine cannot make the runs of the first chunk, or None; it compiles, but runs nothing."""
    return _find_objection(study, default_platform())


@functools.lru_cache(maxsize=4)
def _find_objection(study: Study, platform: str) -> str | None:
    del platform
    runner = Runner(study, default_devices()[:1])
    try:
        for names, blocks in runner._sort_into_blocks([runner._draw_chunk(0)]).items():
            with precision(study.dtype), _convert_compiler_errors():
                # Lowering a program also compiles its kernel.
                arguments = runner._arguments(runner._variant(names), blocks[0], np.ones(runner.size, bool))
                _measure_block.lower(*arguments, study.solver, study.engine)
    except ValueError as error:
        return str(error)
    return None


@partial(jax.jit, static_argnames=("solver", "engine"))
def _measure_block(
    loop: Loop,
    objectives: Mapping[str, Objective],
    values: Params,
    seed: Int,
    samples: Int,
    accepted: Bool,
    solver: Solver,
    engine: str,
) -> JsonObject:
    """Return metrics and flags of a block; only the accepted samples run."""
    keys = jax.vmap(lambda sample: noise_key(seed, sample))(samples)
    runs = run_batch(loop, Batch(values, keys), solver, objectives, together=False, accepted=accepted, engine=engine)
    return runs.metrics | {"stopped": runs.stopped, "diverged": runs.diverged}
