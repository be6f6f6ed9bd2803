"""Lowering rules for programs within a program: calls, conditionals and loops of known length."""

import jax
import jax.extend.core as jex
import numpy as np

from diffabs.compiler.ir import Graph, NodeArray
from diffabs.compiler.lower.rules import (
    Unsupported,
    as_node_array,
    inline_program,
    lowering_rule,
    map_entries,
    scalar_array,
)
from diffabs.core.tracing import scan_input_counts
from diffabs.core.types import Equation

MAX_UNROLLED_STEPS = 64  # bound on the length of a scan, because its steps are unrolled


@lowering_rule(
    "jit pjit closed_call core_call remat remat2 checkpoint",
    "jaxpr call_jaxpr name inline in_shardings out_shardings in_layouts out_layouts donated_invars ctx_mesh keep_unused"
    " compiler_options_kvs prevent_cse differentiated policy",
)
@lowering_rule("custom_jvp_call", "call_jaxpr jvp_jaxpr_fun num_consts symbolic_zeros")
@lowering_rule("custom_vjp_call", "call_jaxpr fwd_jaxpr_thunk bwd num_consts out_trees symbolic_zeros")
def _call(graph: Graph, eqn: Equation, ins: list[NodeArray]) -> list[NodeArray]:
    return inline_program(graph, eqn.params["call_jaxpr" if "call_jaxpr" in eqn.params else "jaxpr"], ins)


@lowering_rule("custom_vmap_call", "call rule in_tree out_tree")
def _custom_vmap_any(graph: Graph, eqn: Equation, ins: list[NodeArray]) -> list[NodeArray]:
    """Lower the identity of a boolean whose custom rule for vmap is `any` over the batch; refuse other rules.

    `core.lanes.any_lane` is such a call.
    """
    call = eqn.params["call"].jaxpr
    scalar = len(ins) == 1 and eqn.invars[0].aval.dtype == bool and ins[0].ndim == 0
    if not scalar or call.eqns or call.invars != call.outvars or not _is_any_rule(eqn):
        raise Unsupported("custom_vmap_call", "its rule for batches is not `any`")
    return [scalar_array(graph.any(ins[0].item()))]


def _is_any_rule(eqn: Equation) -> bool:
    """Return whether a custom rule for vmap computes `any` over the batch, by a test on three batches of two values."""
    debug_info = jex.DebugInfo("kernel", "any", None, None)
    body = jex.Jaxpr((), list(eqn.invars), list(eqn.outvars), [eqn], eqn.effects, debug_info)
    batched = jax.vmap(lambda x: jex.jaxpr_as_fun(jex.ClosedJaxpr(body, ()))(x)[0])
    # The lowering may itself run under a trace. The test needs numbers.
    with jax.ensure_compile_time_eval():
        return all(bool(batched(np.array(x)).all()) == any(x) for x in ([False, False], [False, True], [True, True]))


@lowering_rule("cond", "branches")
def _cond(graph: Graph, eqn: Equation, ins: list[NodeArray]) -> list[NodeArray]:
    index, operands, branches = ins[0].item(), ins[1:], eqn.params["branches"]
    if index.op == "const":
        # XLA clamps an index that is out of range.
        return inline_program(graph, branches[int(np.clip(index.attr, 0, len(branches) - 1))], operands)
    # A chain of conditionals: branch i replaces the result so far where the index is at least i.
    outputs = inline_program(graph, branches[0], operands)
    for i, branch in enumerate(branches[1:], 1):
        condition = graph.convert(index, bool)
        if len(branches) > 2:
            condition = graph.op("ge", index, graph.const(i, index.dtype))
        branch_outputs = inline_program(graph, branch, operands)
        flat = [[node for array in arrays for node in array.flat] for arrays in (outputs, branch_outputs)]
        gated = iter(graph.gate(condition, *flat))
        outputs = [map_entries(lambda _: next(gated), array) for array in outputs]  # noqa: B023  used at once
    return outputs


@lowering_rule("scan", "length reverse jaxpr num_consts num_carry linear unroll _split_transpose ft_in ft_out")
def _scan(graph: Graph, eqn: Equation, ins: list[NodeArray]) -> list[NodeArray]:
    p = eqn.params
    if p["length"] > MAX_UNROLLED_STEPS:
        raise Unsupported("scan", f"of {p['length']} steps within a step; {MAX_UNROLLED_STEPS} are the most")
    try:
        constants, many = scan_input_counts(p, len(ins))
    except ValueError as error:
        raise Unsupported("scan", str(error)) from None
    fixed, carry, rows = ins[:constants], ins[constants : constants + many], ins[constants + many :]
    if not p["length"] and len(eqn.outvars) > many:
        raise Unsupported("scan", "of no steps with outputs")
    order = range(p["length"])[:: -1 if p["reverse"] else 1]
    outputs: dict[int, list[NodeArray]] = {}
    for i in order:
        outs = inline_program(graph, p["jaxpr"], [*fixed, *carry, *(as_node_array(row[i]) for row in rows)])
        carry, outputs[i] = outs[:many], outs[many:]
    # A reversed scan fills its outputs from the end, so they are sorted by index.
    return [*carry, *(np.stack(column) for column in zip(*(outputs[i] for i in sorted(outputs)), strict=True))]
