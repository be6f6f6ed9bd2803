"""A sweep on a Dask cluster: the same table to the bit, whoever dies; one line where there is no cluster to use."""

import dataclasses
import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import dask.config
import jax
import jax.numpy as jnp
import psutil
import pytest
from commands import assert_one_error_line, left_in, run
from distributed import Client, LocalCluster
from mutants import killed_by
from seams import replace_seam
from sweeping import PATIENCE, SCENARIO, chunks, command, described, environment, free_port, started, until

from diffabs.host.process import core_count
from diffabs.uncertainty.sweep import SweepError, cluster, sweep
from diffabs.uncertainty.sweep.cluster import Dask
from diffabs.uncertainty.sweep.manifest import Seals, describe_owner

pytestmark = pytest.mark.usefixtures("without_load", "any_step_is_stable", "compiled_before")


@pytest.fixture(scope="module")
def compiled_before():
    """Workers read what was compiled."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment().items():
            patch.setenv(name, value)
        yield


@pytest.fixture(autouse=True, scope="module")
def nobody_left_behind():
    yield
    deadline = time.monotonic() + PATIENCE
    while there := [text for text in map(told, psutil.Process().children(recursive=True)) if "spawn_main" in text]:
        assert time.monotonic() < deadline, there
        time.sleep(0.1)


def told(process):
    try:
        return " ".join(process.cmdline())
    except psutil.NoSuchProcess:
        return ""


@pytest.fixture(scope="module")
def study(any_step_is_stable):
    return described(SCENARIO)


@pytest.fixture(scope="module")
def alone(study, tmp_path_factory):
    """The table as this process computes it."""
    return sweep(study, tmp_path_factory.mktemp("alone") / "out")


@pytest.fixture(scope="module")
def address(compiled_before):
    """A scheduler with two workers, which gives up a chunk when a worker dies of it."""
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50) as workers,
    ):
        yield workers.scheduler_address


@pytest.fixture(scope="module")
def inside():
    """A scheduler and a worker that are threads of this process: there at once."""
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=":0", silence_logs=50
    ) as workers:
        yield workers.scheduler_address


def pids(address):
    with Client(address) as client:
        return sorted(client.run(os.getpid).values())


# The same table


@pytest.mark.slow
def test_a_worker_makes_the_same_table(study, alone, inside, tmp_path):
    found = sweep(study, tmp_path / "out", on=Dask(inside))
    assert found.complete
    assert found.digest == alone.digest


@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, 5])
def test_workers_that_are_killed_change_no_bit(study, alone, address, tmp_path, kills):
    """Each with two chunks in hand, at equal distances."""
    due = [(k + 1) * study.samples // (kills + 2) for k in range(kills)]
    killed = []

    def kill(at):
        if due and at.here >= due[0]:
            due.pop(0)
            killed.append(pids(address)[0])
            os.kill(killed[-1], signal.SIGKILL)

    found = sweep(study, tmp_path / "out", on=Dask(address), progress=kill)
    assert len(set(killed)) == kills
    assert not due
    assert found.complete
    assert found.digest == alone.digest
    assert sorted(left_in(tmp_path / "out" / "chunks")) == sorted(path.name for path in alone.files.values())


@pytest.mark.slow
def test_arrays_of_jax_reach_the_workers_whole(study, alone, address, tmp_path):
    """The default of their processes is float32."""
    loop = jax.tree.map(jnp.asarray, study.loop)
    found = sweep(dataclasses.replace(study, loop=loop), tmp_path / "out", on=Dask(address))
    assert found.digest == alone.digest


@pytest.mark.slow
def test_two_sweeps_at_once_do_not_exchange_chunks(study, alone, address, tmp_path):
    other = Dask(address).run(dataclasses.replace(study, seed=4), range(50), lambda: False)
    next(other)  # it has chunks in hand, and some are done
    found = sweep(study, tmp_path / "out", on=Dask(address))
    other.close()
    assert found.digest == alone.digest


@pytest.mark.slow
def test_stopped_and_continued_by_the_other_engine(study, alone, address, tmp_path):
    part = sweep(study, tmp_path / "out", on=Dask(address), stopping=lambda: True)
    assert 0 < len(part.files) <= 4
    assert sweep(study, tmp_path / "out", resume=True).digest == alone.digest


@pytest.fixture
def scenario(file):
    return file(SCENARIO)


@pytest.mark.slow
def test_the_command_with_workers_of_its_own(scenario, alone, tmp_path):
    result = run("sweep", scenario, "--out", tmp_path / "out", "--on", "dask", "--workers", "2", "--json")
    assert json.loads(result.stdout)["digest"] == alone.digest
    assert result.stderr == ""


class Processes:
    """A scheduler and workers as processes of their own, by their documented commands."""

    def __init__(self, folder):
        self.folder, self.running = folder, []
        self.address = f"tcp://127.0.0.1:{free_port()}"
        host, port = self.address.removeprefix("tcp://").split(":")
        self.start("scheduler", "--host", host, "--port", port, "--dashboard-address", ":0")

    def start(self, *args, path=()):
        with (self.folder / f"{len(self.running)}.log").open("w") as log:
            words = [str(pathlib.Path(sys.executable).with_name("dask")), *args]
            more = {"PYTHONPATH": os.pathsep.join([*map(str, path), *sys.path])}
            self.running.append(subprocess.Popen(words, stdout=log, stderr=log, cwd=self.folder, env=os.environ | more))

    def worker(self, *path):
        """`path`: folders whose packages it finds first."""
        self.start("worker", self.address, "--nthreads", "1", "--no-dashboard", path=path)

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
    return run("sweep", scenario, "--out", out, "--on", "dask", "--scheduler", address, "--json", *args,
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
    replace_seam(monkeypatch, "timeout_seconds", 60.0)
    out = tmp_path / "out"
    with Processes(tmp_path) as processes:
        processes.worker()
        args = ["--on", "dask", "--scheduler", processes.address, "--samples", "64000"]
        with started(*command(scenario, out, *args)) as process:
            assert until(lambda: chunks(out), process)
            processes.running[0].kill()
            stdout, stderr = process.communicate(timeout=PATIENCE)
    assert (process.returncode, stdout) == (1, "")
    lines = [line for line in stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert lines[0].endswith("; finished chunks are kept; --resume continues")
    assert "Traceback" not in stderr
    assert run("sweep", scenario, "--out", out, "--samples", "64000", "--resume", "--json").exit_code == 0


# Kills of the command itself


def by_itself(scenario, out):
    """The command with two workers, in a session of its own, after its first chunk; and its workers."""
    args = ["--on", "dask", "--workers", "2", "--samples", "32000"]
    process = started(*command(scenario, out, *args), start_new_session=True)
    assert until(lambda: chunks(out), process)
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
    assert not psutil.wait_procs(children, timeout=PATIENCE)[1]
    assert 0 < len(chunks(out)) < 500
    document = json.loads(run("sweep", scenario, "--out", out, "--samples", "32000", "--resume", "--json").stdout)
    other = json.loads(run("sweep", scenario, "--out", tmp_path / "whole", "--samples", "32000", "--json").stdout)
    assert document["digest"] == other["digest"]


@killed_by("uncertainty.sweep.cluster", "if stopping() and not client.nthreads():", "if False:")
@pytest.mark.parametrize(
    ("threads", "stopped", "somebody"), [({}, True, False), ({}, False, True), ({"a": 1}, True, True)]
)
def test_an_interrupted_client_without_workers_ends_at_once(threads, stopped, somebody):
    """Ctrl-C in a terminal ends the workers, too: sometimes none comes back."""
    looks = iter([False, False, True])
    client, finished = SimpleNamespace(nthreads=lambda: threads), SimpleNamespace(has_ready=lambda: next(looks))
    assert cluster._wait_for_chunk(client, finished, lambda: stopped) is somebody


# Workers of its own


def family():
    me = psutil.Process()
    return [me, *me.children(recursive=True)]


def listening():
    """Interfaces and ports of this process and its children."""
    inside = [c for process in family() for c in process.net_connections(kind="inet")]
    return {(c.laddr.ip, c.laddr.port) for c in inside if c.status == psutil.CONN_LISTEN}


@pytest.mark.slow
@killed_by(
    "uncertainty.sweep.cluster", 'worker_dashboard_address=f"{LOOPBACK_ADDRESS}:0"', 'worker_dashboard_address=":0"'
)
def test_nobody_else_reaches_scheduler_workers_and_their_pages():
    before = listening()
    with Dask(workers=1)._client() as client:
        there = listening() - before
        assert client.cluster.dashboard_link.startswith("http://127.0.0.1:")
    assert len(there) >= 4  # scheduler, worker, nanny, and at least one page
    assert {ip for ip, _ in there} == {"127.0.0.1"}


def test_a_worker_that_is_killed_while_it_starts_is_one_line(scenario, tmp_path):
    ended = threading.Event()

    def kill():
        while not ended.wait(0.02):
            for process in family()[1:]:
                if "spawn_main" in told(process):
                    process.kill()

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        result = run("sweep", scenario, "--out", tmp_path / "o", "--on", "dask", "--workers", "2", status=2)
    finally:
        ended.set()
        killer.join()
    assert_one_error_line(result)
    assert "the workers could not be started on this machine: " in result.stderr


# No cluster to use


@pytest.fixture
def impatient(monkeypatch):
    replace_seam(monkeypatch, "timeout_seconds", 1.0)


@pytest.mark.parametrize(
    "where",
    [
        "tcp://127.0.0.1:1",
        *(
            pytest.param(where, marks=pytest.mark.slow)
            for where in (
                "tcp://127.0.0.1",
                "http://127.0.0.1:80",
                "nowhere.invalid:8786",
                "127.0.0.1",
                "tls://[::1]:1",
            )
        ),
    ],
)
def test_a_scheduler_that_cannot_be_reached(scenario, tmp_path, impatient, where):
    result = by_command(scenario, tmp_path / "out", where, status=2)
    assert_one_error_line(result)
    assert f"the scheduler at {where} cannot be reached: " in result.stderr
    assert left_in(tmp_path) <= {scenario.name}


@killed_by("uncertainty.sweep.cluster", "if where is self.scheduler:", "if False:")
@pytest.mark.slow
def test_a_scheduler_that_is_gone_leaves_nothing_behind(study, alone, inside, tmp_path, impatient):
    """No thread of a client that would block the next one, and no folder that only `resume` would take."""
    before = set(threading.enumerate())
    with pytest.raises(SweepError, match="cannot be reached: Timed out trying to connect"):
        sweep(study, tmp_path, on=Dask("tcp://127.0.0.1:1"))
    assert set(threading.enumerate()) == before
    assert sweep(study, tmp_path, on=Dask(inside)).digest == alone.digest


@pytest.mark.slow
@killed_by("uncertainty.sweep.cluster", "await asyncio.wait_for(call(), TIMEOUT_SECONDS + 1)", "await call()")
def test_what_listens_but_is_no_scheduler(study, tmp_path, impatient):
    """It never says a word; so that nobody waits for ever if we did, it is gone after a while."""
    with socket.create_server(("127.0.0.1", 0)) as mute:
        end = threading.Timer(20.0, mute.close)
        end.start()
        where = f"tcp://127.0.0.1:{mute.getsockname()[1]}"
        try:
            with pytest.raises(SweepError, match=f"the scheduler at {where} cannot be reached: no answer within 1 s"):
                sweep(study, tmp_path / "none", on=Dask(where))
            assert end.is_alive()
        finally:
            end.cancel()


@pytest.mark.slow
def test_a_scheduler_without_workers(scenario, tmp_path, impatient):
    with LocalCluster(n_workers=0, dashboard_address=":0", silence_logs=50) as empty:
        result = by_command(scenario, tmp_path / "out", empty.scheduler_address, status=2)
    assert_one_error_line(result)
    assert "the scheduler has no worker within 1 s" in result.stderr


def pretended(folder, name, version):
    """A folder that makes a package look like another version of it."""
    metadata = folder / f"{name}-{version}.dist-info" / "METADATA"
    metadata.parent.mkdir(parents=True)
    metadata.write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    return folder


def renumbered(folder, version):
    """A folder that makes diffabs say another version of itself."""
    folder.mkdir(parents=True)
    (folder / "sitecustomize.py").write_text(f'import diffabs\n\ndiffabs.__version__ = "{version}"\n')
    return folder


def without(folder, name):
    """A folder that makes a package look as if it were not installed."""
    (folder / f"{name}.py").parent.mkdir(parents=True)
    (folder / f"{name}.py").write_text(f"raise ModuleNotFoundError(\"No module named '{name}'\")\n")
    return folder


@killed_by(
    "uncertainty.sweep.cluster", "_check_worker(get_worker().address, _result_versions(study.engine), versions)", "pass"
)
def test_a_worker_that_joins_later_has_the_same_versions(study, monkeypatch):
    monkeypatch.setattr(cluster, "get_worker", lambda: SimpleNamespace(address="tcp://late:1"))
    owner = describe_owner(study)
    seal, versions = Seals(owner).of(0), owner["versions"] | {"jax": "0.1"}
    with pytest.raises(SweepError, match=r'worker tcp://late:1: jax is "\S+" there, "0.1" here; results would'):
        cluster.compute_chunk(study, seal, versions)


def test_a_number_of_workers_that_cannot_be():
    with pytest.raises(ValueError, match=r"workers = 0 is outside \[1, 65536\]"):
        Dask(workers=0)
    assert Dask().workers == core_count()


@killed_by(
    "uncertainty.sweep.cluster", "for line in describe_differences(worker_versions, own_versions):", "for line in ():"
)
@pytest.mark.slow
def test_a_worker_with_other_versions(scenario, tmp_path):
    """Of the package and of JAX; and one that has no diffabs at all."""
    there = {
        'diffabs is "9.9" there, ': renumbered(tmp_path / "a", "9.9"),
        'jax is "0.1" there, ': pretended(tmp_path / "b", "jax", "0.1"),
        "a worker cannot say its versions: ModuleNotFoundError(\"No module named 'diffabs'\")": without(
            tmp_path / "c", "diffabs"
        ),
    }
    for needed, folder in there.items():
        with Processes(folder) as processes:
            processes.worker(folder)
            with Client(processes.address, timeout=60) as client:
                client.wait_for_workers(1, timeout=60)
            result = by_command(scenario, folder / "out", processes.address, status=2)
        assert_one_error_line(result)
        assert needed in result.stderr, result.stderr
        assert "cannot say" in needed or result.stderr.endswith("; results would not be those of one run\n")
