"""Mutations of the kernel for `mutations.py`: name, file, old, new, test."""

GRAPH, ARRAYS, NUMBERS, DRAWS, NESTED = (
    f"kernel/{name}.py" for name in ("graph", "arrays", "elementwise", "draws", "nested")
)
HEADER = "kernel/native/functions.h"
RUNS, FUNCTIONS = "test_kernel.py::TestRuns::test_are_those_of_xla", "test_kernel_native.py"
RULES = f"{FUNCTIONS}::test_rules_are_those_of_jax"
ULPS = f"{FUNCTIONS}::test_elementary_functions_are_right_to_a_unit_in_the_last_place[float64-]"
OBJECTION = "test_kernel.py::TestObjections"

BINDING, TANGENTS, LAUNCH = "kernel/binding.py", "kernel/tangents.py", "test_kernel_tangents.py::TestLaunch"
PUSHED, ENGINES = f"{LAUNCH}::test_derivatives_are_those_of_xla", "test_kernel_engines.py"
SCENARIO = "test_kernel_tangents.py::test_a_scenario[slip-lmi"

KERNEL = [
    ("kernel: a digit of log(2)", HEADER, "0x1.a39ef35793c76p-33", "0x1.a39ff35793c76p-33", ULPS),
    ("kernel: a coefficient of atan", HEADER, "0.05876946456", "0.05876946466", ULPS),
    ("kernel: NaN is no extreme", "kernel/native/lanes.h", "REALLY(mask_max)(x, R_MASK(cmpeq)(x, x), x, y)",
     "REALLY(max)(x, y)", RULES),
    ("kernel: a lane takes its neighbour's lane", "kernel/native/drive.h", "lane[p] >= 0 && !get(on[q], p - q*LANES)",
     "lane[p] >= 0 && !get(on[q], 0)", RUNS),
    ("kernel: what belongs to a lane is not worked out anew", "kernel/native/drive.h", "if (fresh) begin(b, s, q);",
     "", RUNS),
    ("kernel: equal operations are those of equal arguments in any order", GRAPH, '"add", "mul", "and"',
     '"add", "sub", "mul", "and"', "test_kernel.py::TestGraph::test_equal_operations_are_one"),
    ("kernel: a NaN is not less, so it is not greater or equal", GRAPH, 'CONTRARY = {"eq": "ne", "ne": "eq"}',
     'CONTRARY = {"eq": "ne", "ne": "eq", "lt": "le"}', RULES),
    ("kernel: an infinite inverse", GRAPH, "if inverse.op == \"const\" and not",
     "if False and not", "test_kernel.py::TestGraph::test_a_divisor_of_before_the_step_is_inverted_there"),
    ("kernel: a half is rounded up", NUMBERS, '"TO_NEAREST_EVEN"', '"NEVER"', RULES),
    ("kernel: of equal ones the last", ARRAYS, "better = graph.op(\"or\", graph.op(beyond, x, best), nan)",
     "better = graph.op(\"not\", graph.op(beyond, best, x))", RULES),
    ("kernel: one round of threefry less", DRAWS, "for i in range(5):", "for i in range(4):", RULES),
    ("kernel: a rule for batches by its place", NESTED, "or not _says_any(eqn)", "",
     f"{OBJECTION}::test_of_an_operation"),
    ("kernel: parameters are not looked at", "kernel/primitives.py", "sorted(set(eqn.params) - RULES[name].known)",
     "[]", f"{OBJECTION}::test_of_a_parameter_that_is_not_known"),
    ("kernel: flags do not name a library", "kernel/compilers.py", "repr((made, FLAGS, _processor()))", "repr(made)",
     "test_kernel.py::TestLibrary::test_is_another_for_other_flags_and_processors"),
    ("kernel: the manifest does not name the engine", "sweep/study.py", 'if self.engine != "xla":', "if False:",
     "test_kernel.py::TestSweep::test_is_that_of_xla_and_says_what_made_it"),
    ("kernel: bits are counted in pairs", NUMBERS, "x, 0, 0x33333333", "x, 0, 0x13333333", RULES),
    ("tangents: are multiplied by what they are divided by", TANGENTS,
     'graph.op("mul", args[0], graph.op("div", graph.const(1, node.dtype), args[1]))',
     'graph.op("mul", args[0], args[1])', f"{PUSHED}[of both]"),
    ("tangents: nothing follows from what moves later", TANGENTS, "if reached == do[Level.STEP]:", "if True:",
     f"{LAUNCH}::test_only_what_moves_is_carried"),
    ("tangents: the second is the first", TANGENTS, "values + [_copy(new[x.id], k)", "values + [_copy(new[x.id], 0)",
     f"{PUSHED}[three tangents]"),
    ("tangents: each launch has the first ones", BINDING, "jnp.pad(x, wide), first, first + each,",
     "jnp.pad(x, wide), 0, each,", f"{PUSHED}[eleven tangents]"),
    ("tangents: one launch for each", BINDING, "MOST = 8 ", "MOST = 1 ",
     f"{LAUNCH}::test_tangents_are_one_launch[8-1]"),
    ("tangents: of a batch in another order", BINDING, "x = jnp.moveaxis(x, 0, at)\n    return",
     "x = jnp.moveaxis(x[::-1], 0, at)\n    return", f"{PUSHED}[three tangents]"),
    ("kernel: a batch of gains has the first one", BINDING, "jnp.moveaxis(x, axis, 0)\n    if shared:",
     "0 * x + jnp.moveaxis(x, axis, 0)[:1]\n    if shared:", f"{PUSHED}[for several gains]"),
    ("kernel: reverse mode is JAX's to refuse", BINDING, "pe.custom_partial_eval_rules[operation] = _unknown", "",
     f"{LAUNCH}::test_reverse_mode_is_refused"),
    ("kernel: second derivatives of the first alone", BINDING, "    if begins is not None:\n        raise",
     "    if False:\n        raise", f"{LAUNCH}::test_second_derivatives_are_refused"),
    ("kernel: an objection names no part", "kernel/primitives.py", "error.method = error.method or _asked_by(eqn)",
     "pass", f"{ENGINES}::TestTune::test_of_what_has_no_rule_names_the_part"),
    ("tangents: a step is repeated before one knows what follows", "simulate/pursuit.py",
     "next=select(last.moved, last.words, new.point.words)", "next=before.words", f"{SCENARIO}-adaptive]"),
    ("tangents: the last step is not repeated", "simulate/pursuit.py", "return self.ahead.running | self.waits",
     "return self.ahead.running", f"{SCENARIO}-adaptive]"),
    ("tangents: by steps that end on no kink", "simulate/native.py", "else method.located()", "else method",
     "test_kernel_tangents.py::test_steps_end_on_kinks_where_those_of_xla_do"),
    ("kernel: it looks for enough at other instants", "simulate/native.py", "ROUND // BLOCK", "1",
     f"{ENGINES}::test_a_map_of_starts_is_that_of_xla"),
    ("kernel: reverse mode of a tuning is forward mode", "tune/problem.py", "REVERSE if mode is Mode.REVERSE else None",
     "None", f"{ENGINES}::TestTune::test_in_reverse_mode_is_refused"),
    ("kernel: a tuning does not look whether it can be", "tune/problem.py", "line := line or found.objection()",
     "line := line", f"{ENGINES}::TestTune::test_without_a_compiler"),
    ("kernel: a tuning is always XLA's", "tune/problem.py", "together=together, engine=self.engine)", "together=True)",
     f"{ENGINES}::TestTune::test_without_a_compiler"),
    ("kernel: rare failures are always XLA's", "reliability/failure.py", ", engine=study.engine)", ")",
     f"{ENGINES}::TestRare::test_objection"),
    ("kernel: design points in reverse mode", "reliability/failure.py",
     'forward if study.engine == "kernel" else slopes', "slopes", f"{ENGINES}::TestRare::test_is_that_of_xla[True]"),

]  # fmt: skip
