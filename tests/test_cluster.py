"""A sweep on a Dask cluster: the same table to the bit, whoever dies; one line where there is no cluster to use."""

import dataclasses
import json
import math
import os
import pathlib
import signal
import socket
import subprocess
import sys
import time

import dask
import jax
import jax.numpy as jnp
import psutil
import pytest
from commands import assert_one_error_line, left_in, run
from distributed import Client, LocalCluster

from diffabs import console, variation
from diffabs.scenario import loads
from diffabs.sweep import cluster, sweep
from diffabs.sweep.cluster import Dask

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("cluster")]  # they share two workers

SCENARIO = """
plant = "mirrored-rig"
[initial]
speed_kmh = 30.0
[stop]
type = "speed-reached"
speed_kmh = 25.0
[controller]
type = "state-feedback"
gain = [-4000.0, -40.0]
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
[sweep.over]
"plant.mass" = [5.3, 6.2]
"initial.speed_kmh" = [28.0, 34.0]
"""
PATIENCE = 300.0  # s for anything that takes seconds on an idle machine


@pytest.fixture(autouse=True, scope="module")
def quick():
    """No lines that depend on the machine's load; workers read what was compiled before."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(console, "PATIENCE", math.inf)
        patch.setattr("diffabs.scenario.stable_step", lambda loop: math.inf)
        patch.setenv("JAX_COMPILATION_CACHE_DIR", jax.config.jax_compilation_cache_dir)
        patch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "1e6")
        yield


@pytest.fixture(autouse=True, scope="module")
def nobody_left_behind(quick):
    yield
    deadline = time.monotonic() + 30
    while there := [text for text in map(told, psutil.Process().children(recursive=True)) if "spawn_main" in text]:
        assert time.monotonic() < deadline, there
        time.sleep(0.1)


def told(process):
    try:
        return " ".join(process.cmdline())
    except psutil.NoSuchProcess:
        return ""


def described(text):
    return variation.study(loads(text.encode(), "small", "small.toml"))


@pytest.fixture(scope="module")
def study(quick):
    return described(SCENARIO)


@pytest.fixture(scope="module")
def alone(study, tmp_path_factory):
    """The table as this process computes it."""
    return sweep(study, tmp_path_factory.mktemp("alone") / "out")


@pytest.fixture(scope="module")
def address(quick):
    """A scheduler with two workers, which gives up a chunk when a worker dies of it."""
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50) as workers,
    ):
        yield workers.scheduler_address


def pids(address):
    with Client(address) as client:
        return sorted(client.run(os.getpid).values())


# The same table


@pytest.mark.parametrize("kills", [1, pytest.param(5, marks=pytest.mark.slow)])
def test_workers_that_are_killed_change_no_bit(study, alone, address, tmp_path, kills):
    """Each with two chunks in hand, at equal distances."""
    due = [(k + 1) * study.samples // (kills + 2) for k in range(kills)]
    killed = []

    def kill(at):
        if due and at.here >= due[0]:
            due.pop(0)
            killed.append(pids(address)[0])
            os.kill(killed[-1], signal.SIGKILL)

    found = sweep(study, tmp_path / "out", engine=Dask(address), progress=kill)
    assert len(set(killed)) == kills
    assert not due
    assert found.complete
    assert found.digest == alone.digest
    assert sorted(left_in(tmp_path / "out" / "chunks")) == sorted(path.name for path in alone.files.values())


def test_arrays_of_jax_reach_the_workers_whole(study, alone, address, tmp_path):
    """The default of their processes is float32."""
    loop = jax.tree.map(jnp.asarray, study.loop)
    found = sweep(dataclasses.replace(study, loop=loop), tmp_path / "out", engine=Dask(address))
    assert found.digest == alone.digest


def test_two_sweeps_at_once_do_not_exchange_chunks(study, alone, address, tmp_path):
    other = Dask(address).run(dataclasses.replace(study, seed=4), range(50), lambda: False)
    next(other)  # it has chunks in hand, and some are done
    found = sweep(study, tmp_path / "out", engine=Dask(address))
    other.close()
    assert found.digest == alone.digest


def test_stopped_and_continued_by_the_other_engine(study, alone, address, tmp_path):
    part = sweep(study, tmp_path / "out", engine=Dask(address), stopping=lambda: True)
    assert 0 < len(part.files) <= 4
    assert sweep(study, tmp_path / "out", resume=True).digest == alone.digest


@pytest.fixture
def scenario(file):
    return file(SCENARIO)


@pytest.mark.slow
def test_the_command_with_workers_of_its_own(scenario, alone, tmp_path):
    result = run("sweep", scenario, "--out", tmp_path / "out", "--engine", "dask", "--workers", "2", "--json")
    assert json.loads(result.stdout)["digest"] == alone.digest
    assert result.stderr == ""


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Processes:
    """A scheduler and workers as processes of their own, by their documented commands."""

    def __init__(self, folder):
        self.folder, self.running = folder, []
        self.address = f"tcp://127.0.0.1:{free_port()}"
        host, port = self.address.removeprefix("tcp://").split(":")
        self.start("scheduler", "--host", host, "--port", port, "--dashboard-address", ":0")

    def start(self, *args):
        log = (self.folder / f"{len(self.running)}.log").open("w")
        command = [str(pathlib.Path(sys.executable).with_name("dask")), *args]
        self.running.append(subprocess.Popen(command, stdout=log, stderr=log, cwd=self.folder))
        log.close()

    def worker(self):
        self.start("worker", self.address, "--nthreads", "1", "--no-dashboard")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in reversed(self.running):
            process.terminate()
        for process in reversed(self.running):
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def by_command(scenario, out, address, *args, status=0):
    return run("sweep", scenario, "--out", out, "--engine", "dask", "--scheduler", address, "--json", *args,
               status=status)  # fmt: skip


@pytest.mark.slow
def test_a_scheduler_and_two_workers_in_processes_of_their_own(scenario, alone, tmp_path):
    with Processes(tmp_path) as processes:
        processes.worker()
        processes.worker()
        with Client(processes.address, timeout=60) as client:
            client.wait_for_workers(2, timeout=60)
        result = by_command(scenario, tmp_path / "out", processes.address)
        assert json.loads(result.stdout)["digest"] == alone.digest
        assert result.stderr == ""


@pytest.mark.slow
def test_a_scheduler_that_dies_ends_it_with_one_line(scenario, alone, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "TIMEOUT", 60.0)
    out = tmp_path / "out"
    with Processes(tmp_path) as processes:
        processes.worker()
        command = [sys.executable, "-m", "diffabs", "sweep", scenario, "--out", out, "--engine", "dask", "--json"]
        args = ["--scheduler", processes.address, "--samples", "64000"]
        with subprocess.Popen(
            [*map(str, command), *args], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            until(lambda: list(out.glob("chunks/*.parquet")), process)
            processes.running[0].kill()
            stdout, stderr = process.communicate(timeout=PATIENCE)
    assert (process.returncode, stdout) == (1, "")
    lines = [line for line in stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert lines[0].endswith("; finished chunks stay, --resume goes on")
    assert "Traceback" not in stderr
    assert run("sweep", scenario, "--out", out, "--samples", "64000", "--resume", "--json").exit_code == 0


# Kills of the command itself


def until(condition, process):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.01)


def by_itself(scenario, out):
    """The command with two workers, in a session of its own, after its first chunk; and its workers."""
    command = [sys.executable, "-m", "diffabs", "sweep", scenario, "--out", out, "--engine", "dask", "--workers", "2"]
    process = subprocess.Popen(
        [*map(str, command), "--json", "--samples", "32000"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until(lambda: list(out.glob("chunks/*.parquet")), process)
    children = psutil.Process(process.pid).children(recursive=True)
    assert sum("spawn_main" in told(child) for child in children) == 2
    return process, children


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_the_command_is_killed_or_interrupted(scenario, tmp_path, how):
    """SIGINT as a terminal sends it: to the workers, too. Nobody is left behind, and it goes on without a cluster."""
    out = tmp_path / "out"
    process, children = by_itself(scenario, out)
    with process:
        os.killpg(process.pid, how) if how == signal.SIGINT else process.kill()
        stdout, stderr = process.communicate(timeout=PATIENCE)
    assert stdout == ""
    assert process.returncode == (130 if how == signal.SIGINT else -signal.SIGKILL), stderr
    if how == signal.SIGINT:
        assert stderr.splitlines()[-1].endswith("--resume")
        assert "Traceback" not in stderr
    assert not psutil.wait_procs(children, timeout=30)[1]
    assert 0 < len(list(out.glob("chunks/*.parquet"))) < 500
    document = json.loads(run("sweep", scenario, "--out", out, "--samples", "32000", "--resume", "--json").stdout)
    other = json.loads(run("sweep", scenario, "--out", tmp_path / "whole", "--samples", "32000", "--json").stdout)
    assert document["digest"] == other["digest"]


# No cluster to use


@pytest.mark.parametrize(
    "where", ["tcp://127.0.0.1:1", "tcp://127.0.0.1", "http://127.0.0.1:80", "nowhere.invalid:8786", "127.0.0.1"]
)
def test_a_scheduler_that_cannot_be_reached(scenario, tmp_path, monkeypatch, where):
    monkeypatch.setattr(cluster, "TIMEOUT", 1.0)
    result = by_command(scenario, tmp_path / "out", where, status=2)
    assert_one_error_line(result)
    assert f"the scheduler at {where} cannot be reached: " in result.stderr


def test_a_scheduler_without_workers(scenario, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "TIMEOUT", 1.0)
    with LocalCluster(n_workers=0, dashboard_address=":0", silence_logs=50) as empty:
        result = by_command(scenario, tmp_path / "out", empty.scheduler_address, status=2)
    assert_one_error_line(result)
    assert "the scheduler has no worker within 1 s" in result.stderr
