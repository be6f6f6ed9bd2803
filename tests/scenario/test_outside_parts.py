"""Plausible mistakes in a module of `--parts`: each is one line that names the class and what is wrong with it."""

import sys
from collections.abc import Iterator

import pytest
from commands import assert_one_error_line, run
from marks import readable_id
from mutants import killed_by
from seams import replace_seam

HEAD = """import jax.numpy as jnp
from diffabs.core.protocols import Memory, no_flow, no_memory
from diffabs.core.pytree import param, pytree
"""
ROAD = f"""{HEAD}
@pytree
class Brush:
    mu0: float = param(default=0.9, unit="1")

    def friction(self, slip, speed=0.0, distance=0.0):
        return self.mu0 * jnp.tanh(20.0 * slip)
"""
CONTROLLER = f"""{HEAD}
@pytree
class Prop:
    kp: float = param(default=200.0, unit="control/signal", low=0.0)
    start = no_memory
    flow = no_flow

    def output(self, t, memory, signal):
        return jnp.clip(self.kp * (signal.target - signal.measured.slip), 0.0, 90.0)
"""
MU = "return self.mu0 * jnp.tanh(20.0 * slip)"
COMMAND = "return jnp.clip(self.kp * (signal.target - signal.measured.slip), 0.0, 90.0)"
BLOCK = "a sensor, controller or actuator"
# module, its text, words after `diffabs`, the line
MISTAKES = [
    (
        "misspelled",
        ROAD.replace("friction", "friktion"),
        "list",
        "class Brush lacks friction of a road; it has friktion",
    ),
    ("plain", ROAD.replace("@pytree\n", ""), "list", "class Brush is not made with @pytree"),
    (
        "startless",
        CONTROLLER.replace("start = no_memory", ""),
        "list",
        f"class Prop lacks start of {BLOCK}; it has flow, output",
    ),
    (
        "outptu",
        CONTROLLER.replace("def output", "def outptu"),
        "list",
        f"class Prop lacks output of {BLOCK}; it has flow, outptu, start",
    ),
    ("file.py", ROAD, "list", "--parts file.py is a file; give the module's name, without folder and .py"),
    ("none", ROAD.replace(MU, "1.0"), "list", "Brush.friction returns None; one number is needed"),
    ("pair", ROAD.replace(MU, "return slip, slip"), "list", "Brush.friction returns values of shape (2,)"),
    ("text", ROAD.replace(MU, "return 'mu'"), "list", "Brush.friction returns 'mu'; one number is needed"),
    ("axis", ROAD.replace(MU, "return slip * jnp.ones(2)"), "list", "Brush.friction returns values of shape (2,)"),
    (
        "short",
        ROAD.replace("slip, speed=0.0, distance=0.0", "slip"),
        "show slip-lmi --set road=brush",
        "Brush.friction() takes 2 positional arguments but 4 were given",
    ),
    (
        "driving",
        ROAD.replace(MU, f"{MU.replace('return ', 'return -')}"),
        "show slip-lmi --set road=brush",
        "road: friction = -0.685 at slip 0.05; at least 0 is needed: such a road drives",
    ),
    (
        "resting",
        ROAD.replace(MU, f"{MU} + 0.1"),
        "show slip-lmi --set road=brush",
        "road: friction = 0.1 at slip 0; 0 is needed",
    ),
    (
        "negative",
        ROAD,
        "show slip-lmi --set road=brush --set road.mu0=-0.1",
        "road: friction = -0.0762 at slip 0.05; at least 0 is needed",
    ),
    (
        "memory_first",
        CONTROLLER.replace("self, t, memory", "self, memory"),
        "show slip-lmi --set controller=prop",
        "Prop.output() takes 3 positional arguments but 4 were given",
    ),
    (
        "flowing",
        CONTROLLER.replace("flow = no_flow", "flow = lambda self, t, memory, signal: 1.0"),
        "show slip-lmi --set controller=prop",
        "controller.flow returns float; () is needed, like memory.flow",
    ),
    (
        "start_alone",
        CONTROLLER.replace("start = no_memory", "start = lambda self: Memory()"),
        "show slip-lmi --set controller=prop",
        "controller.start fails: TypeError: ",
    ),
    (
        "commandless",
        CONTROLLER.replace(COMMAND, "pass"),
        "show slip-lmi --set controller=prop",
        "controller.output returns None; one real number is needed",
    ),
]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Iterator[None]:
    """An empty working directory; modules, parts and the Python path are as before afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    replace_seam(monkeypatch, "outside_named", {})
    known = set(sys.modules)
    yield
    for name in set(sys.modules) - known:
        if "." not in name and getattr(sys.modules[name], "__file__", "") == str(tmp_path / f"{name}.py"):
            del sys.modules[name]


@killed_by("scenario.outside", 'if name.endswith(".py"):', "if False:", case="file.py")
@killed_by("scenario.outside", "_find_incomplete_class(module) or ", "", case="misspelled")
@killed_by("scenario.outside", "return -len(close), len(contract - methods)", "return 0, 0", case="outptu")
@killed_by("scenario.outside", 'value.dtype.kind in "OSU"', "False", case="none")
@killed_by("parts.roads.sign", "mu * slips >= 0)", "mu * slips >= -9)", case="driving")
@killed_by("parts.roads.sign", "slips == 0, abs(mu) <= MAX_FRICTION_AT_REST", "slips == 0, True", case="resting")
@killed_by("scenario.outside", "if road is not None and (line", "if False and (line", case="negative")
@pytest.mark.parametrize(
    ("module", "text", "command", "line"), MISTAKES, ids=[readable_id(mistake[0]) for mistake in MISTAKES]
)
def test_a_mistake_in_a_part_of_ones_own_is_one_line(module, text, command, line, tmp_path):
    (tmp_path / f"{module.removesuffix('.py')}.py").write_text(text)
    assert_one_error_line(result := run(*command.split(), "--parts", module, status=2))
    assert line in result.stderr


@killed_by("scenario.outside", "if any(getattr", "if all(getattr")
def test_a_module_may_hold_other_classes_beside_its_parts(tmp_path):
    helper = (
        "\n@pytree\nclass Table:\n    def look_up(self):\n        return 1.0\n\nclass Plain:\n    def say(self): ...\n"
    )
    (tmp_path / "beside.py").write_text(f"{ROAD}{helper}")
    assert 'type = "brush"' in run("show", "slip-lmi", "--set", "road=brush", "--parts", "beside").stdout
