"""Signals, states and metrics have names of their own: two of one name would be taken for each other in a proof or a
file."""

import collections
import textwrap
from typing import Any, NamedTuple

import jax.numpy as jnp
import pytest
from commands import run
from mutants import killed_by

import diffabs as d
from diffabs import controllers, objectives, references, stops
from diffabs.core.protocols import Memory
from diffabs.core.pytree import param, pytree
from diffabs.robust.reach import RunClaim, cover_box
from diffabs.robust.reach.equations import derive_equations

NAMES = ["t", "time", "target", "setpoint", "feedforward", "command", "control", "sample", "units", "metrics"]
SOLVER = d.FixedStep(1e-2, 0.1)


class Output(NamedTuple):
    """[m]"""

    position: Any

    units = {"position": "m"}  # noqa: RUF012  # as every output has it


@pytree
class Decay:
    """x' = u - x."""

    rate: Any = param(default=1.0, unit="1/s", above=0.0)
    shows, control_unit = Output, "m/s"

    def start(self, initial: Any) -> tuple[Any]:
        return (0.0 * self.rate,)

    def derivative(self, t: Any, state: Any, control: Any) -> tuple[Any]:
        return (control - self.rate * state[0],)

    def project(self, state: Any) -> Any:
        return state

    def output(self, state: Any) -> Any:
        return self.shows(*[state[0]] * len(self.shows._fields))

    def holding(self, output: Any, target: Any) -> Any:
        return 0.0 * target


@pytree
class Twice:
    """A controller with a filter x' = e - x and the held number 3."""

    gain: Any = param(default=1.0, unit="1")

    def start(self, signal: Any) -> Memory:
        return Memory(flow={"x": 0.0 * signal.target}, held={"x": jnp.asarray(3.0)})

    def flow(self, t: Any, memory: Memory, signal: Any) -> Any:
        return {"x": signal.target - signal.measured.position - memory.flow["x"]}

    def output(self, t: Any, memory: Memory, signal: Any) -> Any:
        return self.gain * memory.flow["x"] + 0.0 * memory.held["x"]


def loop_of(plant: Any, controller: Any = None) -> d.Loop:
    return d.Loop(
        plant=plant, initial=(), reference=references.Setpoint(), controller=controller or controllers.PID(kp=1.0),
        stop=stops.NoStop(),
    )  # fmt: skip


def shown_as(name: str) -> d.Loop:
    """A loop whose plant has a second output of this name."""
    shows = collections.namedtuple("Shows", ["position", name])
    shows.units = {"position": "m", name: "m"}
    return loop_of(pytree(type("Named", (Decay,), {"shows": shows}))())


@killed_by("loop.closed_loop", '"metrics", "units"}', '"metrics"}', case="units")
@pytest.mark.parametrize("name", NAMES)
def test_an_output_with_the_name_of_a_signal_is_refused(name):
    loop, why = shown_as(name), rf"^plant.shows: no output can be called {name}, like a signal of the loop"
    for use in (
        lambda: d.check(loop),
        lambda: d.measure(loop, SOLVER, {}),
        lambda: d.rollout(loop, SOLVER),
        lambda: d.run_batch(loop, d.Batch({"plant.rate": [1.0, 2.0]}), SOLVER, {}),
        lambda: derive_equations(loop, ["plant.rate"]),
        lambda: cover_box(loop, {"plant.rate": (1.0, 2.0)}, [RunClaim(f"greatest {name}", 2.0)], horizon=0.5),
    ):
        with pytest.raises(ValueError, match=why):
            use()


def test_an_output_of_another_name_is_not_refused():
    """`output` is no signal of its own."""
    for name in ("output", "measured", "speed"):
        assert d.check(shown_as(name))


@pytest.mark.slow
def test_no_command_takes_a_loop_whose_output_is_called_command(tmp_path, monkeypatch):
    (tmp_path / "named.py").write_text(
        textwrap.dedent("""
        from types import MappingProxyType
        from typing import NamedTuple
        from diffabs.core.pytree import param, pytree

        class Output(NamedTuple):
            position: float
            command: float
            units = MappingProxyType({"position": "m", "command": "V"})

        @pytree
        class NamedPlant:
            k: float = param(default=1.0, unit="1", above=0.0)
            shows, control_unit = Output, "V"
            start = lambda self, initial: Output(0.0 * self.k, 1000.0 + 0.0 * self.k)
            derivative = lambda self, t, state, control: Output(-self.k * state.position, 0.0 * state.command)
            project = output = lambda self, state: state
            holding = lambda self, output, target: 0.0 * target
            usual_parts = lambda self: {"initial": ()}
        """)
    )
    scenario = tmp_path / "named.toml"
    scenario.write_text(
        'plant = "named-plant"\nstop = "no-stop"\n[reference]\ntype = "setpoint"\n[controller]\ntype = "pid"\n'
        "[solver]\nstep = 1e-3\nduration = 0.5\n"
    )
    monkeypatch.chdir(tmp_path)
    for words in (
        ("prove", "named.toml", "--over", "plant.k=1:2", "--claim", "max_command=2"),
        ("simulate", "named.toml"),
    ):
        error = run(*words, "--parts", "named", status=2).stderr
        assert "plant.shows: no output can be called command" in error


@killed_by("robust.reach.equations", "short.count(name) == 1", "True")
def test_states_of_one_name_keep_flow_and_held():
    """A state is looked up by its name, so a bound of the held number would pass for one of the filter."""
    equations = derive_equations(loop_of(Decay(), Twice()), ["plant.rate"])
    assert equations.states == ("plant.0", "controller.flow.x", "controller.held.x", "t")


@killed_by("loop.arguments", 'RESERVED_METRICS = ("", ', "RESERVED_METRICS = (")
@pytest.mark.parametrize("name", ["", "stopped", "diverged", "timed_out"])
def test_a_metric_with_the_name_of_another_result_is_refused(name):
    """A table of runs has the flags as columns; an empty name is that of the plant's audit."""
    measured = {name: objectives.IAE()}
    for use in (
        lambda: d.measure(loop_of(Decay()), SOLVER, measured),
        lambda: d.run_batch(loop_of(Decay()), d.Batch({"plant.rate": [1.0]}), SOLVER, measured),
    ):
        with pytest.raises(ValueError, match=f"^objectives: no metric can be called {name!r}"):
            use()
