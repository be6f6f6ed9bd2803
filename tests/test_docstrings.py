"""Every function that a package exports says what it returns, and names each of its arguments."""

import ast
import importlib
import inspect
import re

import jax.numpy as jnp
import numpy as np
import pytest

PACKAGES = ("design", "identify", "linear", "reliability", "roads", "scenario", "sweep", "tune")
PACKAGES = ("diffabs", *(f"diffabs.{name}" for name in PACKAGES))


def exported():
    """Functions and classes of ours by their names, in one order; what is exported lazily is imported for type checkers
    in the text of the package."""
    found = {}
    for package in map(importlib.import_module, PACKAGES):
        imports = [x for x in ast.walk(ast.parse(inspect.getsource(package))) if isinstance(x, ast.ImportFrom)]
        for name in (alias.asname or alias.name for line in imports for alias in line.names):
            item = getattr(package, name, None)
            ours = not name.startswith("_") and getattr(item, "__module__", "").startswith("diffabs")
            if ours and (inspect.isfunction(item) or inspect.isclass(item)):
                found[f"{item.__module__}.{item.__qualname__}"] = item
    return dict(sorted(found.items()))


EXPORTED = exported()


@pytest.mark.parametrize("name", EXPORTED)
def test_it_has_a_docstring_that_begins_with_a_sentence(name):
    first = (inspect.getdoc(EXPORTED[name]) or "").split("\n\n")[0]
    assert re.search(r"[.:;]($|\s)", first), first


@pytest.mark.parametrize("name", [name for name, item in EXPORTED.items() if inspect.isfunction(item)])
def test_every_argument_is_named(name):
    """As python-control asks it of its own functions. What a run is asked for stands in the contract, protocols.py."""
    text = inspect.getdoc(EXPORTED[name])
    missing = [arg for arg in inspect.signature(EXPORTED[name]).parameters if not re.search(rf"\b{arg}\b", text)]
    assert missing == []


def test_the_example_of_lqr():
    from diffabs.linear import lqr

    (example,) = re.findall(r"^ +(lqr\(.*\)\.gain) +# (.*)$", inspect.getdoc(lqr), re.MULTILINE)
    got, said = eval(example[0], {"lqr": lqr, "jnp": jnp}), eval(example[1], {"sqrt": np.sqrt})
    np.testing.assert_allclose(got, said, rtol=1e-12)


def test_the_example_of_replace():
    import diffabs as d

    (example,) = re.findall(r"^ +(replace\(.*\))$", inspect.getdoc(d.replace), re.MULTILINE)
    from diffabs import controllers, plants

    loop = d.braking(plant=plants.MirroredRig(), controller=controllers.StateFeedback(gain=(-1e4, -50.0)))
    changed = eval(example, {"replace": d.replace, "loop": loop})
    assert (float(changed.plant.mass), float(changed.controller.gain[0])) == (5.3, -9e3)
