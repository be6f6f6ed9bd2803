"""Shared code of the commands that prove: the document of a proof, and errors as one line.

Everything here needs the extra `design`. Modules that need the extra are imported only when a command runs.
"""

import contextlib
import pathlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from diffabs.cli import console
from diffabs.core.types import JsonObject
from diffabs.host.values import ScenarioError
from diffabs.scenario import proving
from diffabs.scenario.model import result_document
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.robust.design import Certificate
    from diffabs.robust.design.loop_task import ProofTask


def proof_document(
    scenario: Scenario,
    task: "ProofTask",
    proof: "Certificate | None" = None,
    out: pathlib.Path | None = None,
    **values: Any,
) -> JsonObject:
    """Return the JSON document of a proof; `values` are further arguments of `describe_proof`."""
    values = proving.describe_proof(task, proof, **values)
    document = result_document("design", scenario, values, "cvxpy", "clarabel", "scipy")
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
