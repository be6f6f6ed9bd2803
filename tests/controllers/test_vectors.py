"""Every part with a vector among its parameters takes it as a tuple and as a list, as its docstring may show it."""

import dataclasses

import numpy as np
import parts
import pytest
from mutants import killed_by

import diffabs as d
from diffabs.loop.contracts import find_misfits
from diffabs.parts.objectives import IAE
from diffabs.parts.plants import QuarterCar

SOLVER = d.FixedStep(1e-5, 3e-5)


def vectors(kind):
    """The names of a part's parameters that are no single number."""
    fields = dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ()
    return [field.name for field in fields if "spec" in field.metadata and field.metadata["spec"].shape != ()]


KINDS = {
    f"{module.__name__.rpartition('.')[2]}.{name}": kind
    for module in parts.FAMILIES
    for name, kind in vars(module).items()
    if isinstance(kind, type) and vectors(kind)
}


def placed(name, part):
    """A loop with the part, and the objectives of its run: a brake, or a balance for a part that fits no brake."""
    family = name.partition(".")[0]
    objectives = {"x": part if family == "objectives" else IAE()}
    around = {"roads": {"plant": QuarterCar(road=part)}, "objectives": {}}.get(family, {family[:-1]: part})
    for make in (d.braking, d.balancing):
        loop = make(**around)
        if not list(find_misfits(loop, {f"objectives.{one}": objective for one, objective in objectives.items()})):
            return loop, objectives
    raise AssertionError(name)


@killed_by(
    "parts.roads.patches", "edges = jnp.asarray(self.edges)", "edges = np.asarray(self.edges)", case="roads.Patches"
)
@killed_by(
    "parts.controllers.gain_schedule",
    "map(jnp.asarray, (self.speeds",
    "((self.speeds",
    case="controllers.ScheduledFeedback",
)
@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_a_vector_is_an_array_or_a_tuple_or_a_list(name):
    ours = KINDS[name]()
    values = {field: np.asarray(getattr(ours, field)).tolist() for field in vectors(KINDS[name])}
    found = []
    for change in ({}, {field: tuple(value) for field, value in values.items()}, values):
        loop, objectives = placed(name, dataclasses.replace(ours, **change))
        d.check(loop, SOLVER)
        found.append(float(d.measure(loop, SOLVER, objectives).metrics["x"]))
    assert np.isfinite(found[0])
    assert found[1:] == [found[0]] * 2
