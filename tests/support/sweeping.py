"""What the tests of sweeps share: a study of a quarter of a second, and processes that run it."""

import os
import socket
import subprocess
import sys
import time

import jax

from diffabs.scenario import section_sweep
from diffabs.scenario.scenario import loads
from diffabs.uncertainty.sweep.manifest import MANIFEST_FORMAT


def rig(start, stop):
    """The head of a scenario: the mirrored rig brakes from one speed to another [km/h]."""
    return f"""
plant = "mirrored-rig"
[initial]
speed_kmh = {start}
[stop]
type = "speed-reached"
speed_kmh = {stop}
[controller]
type = "state-feedback"
gain = [-4000.0, -40.0]"""


def tune_section(iterations, overshoot):
    """Its section [tune]: the gain, over two masses."""
    return f"""
[tune]
iterations = {iterations}
[tune.free]
"controller.gain" = [[-1e4, -60.0], [-100.0, -20.0]]
[tune.objective]
iae = 1.0
[tune.over]
"plant.mass" = [5.3, 6.2]
[tune.limits]
overshoot = {overshoot}
"""


PATIENCE = 300.0  # s for anything that takes seconds on an idle machine
SCENARIO = f"""{rig(30.0, 25.0)}
[sensor]
type = "noise"
slip = 0.005
period = 2e-3
[solver]
step = 1e-3
duration = 0.25
[sweep]
samples = 3200
chunk = 64
seed = 3
check = 0
[sweep.over]
"plant.mass" = {{ low = 5.3, high = 6.2 }}
"initial.speed_kmh" = {{ low = 28.0, high = 34.0 }}
"""


def described(text):
    return section_sweep.build_study(loads(text.encode(), "small", "small.toml"))


def manifest(samples, chunk, variables=("plant.mass",), objectives=("iae",), **study):
    """Of a sweep that was never run."""
    space = {"variables": {path: {"type": "uniform", "low": 0.0, "high": 1.0} for path in variables}}
    table = {
        "samples": samples,
        "chunk": chunk,
        "seed": 0,
        "dtype": "float64",
        "failures": {},
        "success": True,
        "loop": {},
        "parts": {},
    }
    table |= {"solver": {"step": 1e-3, "duration": 1.0}, "space": {**space, "design": {"type": "random"}}}
    table["objectives"] = {name: {} for name in objectives}
    return {"format": MANIFEST_FORMAT, "study": table | study, "versions": {}, "source": {}}


def chunks(folder):
    """Names of the finished chunks."""
    return {path.name for path in (folder / "chunks").glob("*.parquet")}


def command(scenario, folder, *args):
    return [sys.executable, "-m", "diffabs", "sweep", str(scenario), "--out", str(folder), "--json", *map(str, args)]


def environment():
    """What this process has compiled, others read; those that are killed must not write there."""
    return os.environ | {
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "1e6",
    }


def started(*words, **options):
    """A process whose output can be read."""
    return subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(), **options
    )


def until(condition, process):
    """Wait while the process runs. Whether the condition came true."""
    end = time.monotonic() + PATIENCE
    while process.poll() is None:
        if condition():
            return True
        assert time.monotonic() < end
        time.sleep(1e-3)
    return False


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]
