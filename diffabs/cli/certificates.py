"""Shared code of the commands that prove: the task of a scenario, its document, and errors as one line.

Everything here needs the extra `design`. Modules that need the extra are imported only when a command runs.
"""

import contextlib
import functools
import pathlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from diffabs.cli import console
from diffabs.core.types import JsonObject
from diffabs.host.separated import read_decimal
from diffabs.host.values import ScenarioError, format_given
from diffabs.scenario import proving
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.robust.design import Certificate
    from diffabs.robust.design.loop_task import ProofTask


def read_proof_task(scenario: Scenario, gain: str | None = None, *, weighed: bool = False) -> "ProofTask":
    """Return the linear systems of a scenario with the gain `k1,k2,...` to certify; default: that of the controller."""
    read = None if gain is None else functools.partial(_read_gain, gain)
    return proving.build_proof_task(scenario, read, weighed=weighed)


def _read_gain(text: str, states: Sequence[str]) -> np.ndarray:
    words = text.strip().removeprefix("[").removesuffix("]").split(",")
    try:
        values = np.array([read_decimal(word) for word in words])
    except ValueError:
        raise ScenarioError(f"--gain {format_given(text)}: numbers are needed, as in --gain=-11753,-48") from None
    if not np.isfinite(values).all():
        raise ScenarioError(f"--gain {format_given(text)} is outside (-inf, inf): a gain is finite")
    if len(values) != len(states):
        raise ScenarioError(
            f"--gain {format_given(text)} has {len(values)} of {len(states)} numbers, one for each of"
            f" {', '.join(states)}"
        )
    return values


def proof_document(
    scenario: Scenario,
    task: "ProofTask",
    proof: "Certificate | None" = None,
    out: pathlib.Path | None = None,
    **values: Any,
) -> JsonObject:
    """Return the JSON document of a proof; `values` are further arguments of `describe_proof`."""
    values = proving.describe_proof(task, proof, **values)
    document = console.document("design", scenario, values, "cvxpy", "clarabel", "scipy")
    return document | {"files": {"out": str(out)} if out and proof else {}}


@contextlib.contextmanager
def report_design_errors() -> Iterator[None]:
    """Turn errors of `diffabs.robust.design` into one line."""
    try:
        yield
    except ModuleNotFoundError as error:
        console.fail(" ".join(str(error).split()))
    except np.linalg.LinAlgError as error:
        console.fail(f"the linear algebra failed: {error}", console.FAILED)
    except ValueError as error:
        raise ScenarioError(str(error)) from None
