"""Mutations of the kernel for `mutations.py`: name, file, old, new, test."""

GRAPH, ARRAYS, NUMBERS, DRAWS, NESTED = (
    f"kernel/{name}.py" for name in ("graph", "arrays", "elementwise", "draws", "nested")
)
HEADER = "kernel/native/functions.h"
RUNS, FUNCTIONS = "test_kernel.py::TestRuns::test_are_those_of_xla", "test_kernel_native.py"
RULES = f"{FUNCTIONS}::test_rules_are_those_of_jax"
ULPS = f"{FUNCTIONS}::test_elementary_functions_are_right_to_a_unit_in_the_last_place[float64-]"
OBJECTION = "test_kernel.py::TestObjections"

START = "test_kernel_start.py"
KEPT, FINGERPRINT = "kernel/kept.py", "core/fingerprint.py"

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
    ("kernel: parameters are not looked at", "kernel/primitives.py", "sorted(set(eqn.params) - one.known)", "[]",
     f"{OBJECTION}::test_of_a_parameter_that_is_not_known"),
    ("kernel: flags do not name a library", "kernel/compilers.py", "repr((made, FLAGS, _processor()))", "repr(made)",
     "test_kernel.py::TestLibrary::test_is_another_for_other_flags_and_processors"),
    ("kernel: the manifest does not name the engine", "sweep/study.py", 'if self.engine != "xla":', "if False:",
     "test_kernel.py::TestSweep::test_is_that_of_xla_and_says_what_made_it"),
    ("start: what JAX's cache gives back is written", KEPT, "jax.config.update(name, math.inf)", "pass",
     f"{START}::TestPrograms::test_are_whole_though_jax_has_a_cache_of_its_own"),
    ("start: a damaged program is taken", KEPT, 'hashlib.sha256(body).hexdigest() != told["digest"]', "not body",
     f"{START}::TestPrograms::test_that_are_not_whole_are_made_anew[damaged]"),
    ("start: constants do not name a program", KEPT, "(self.told, *around)", "around",
     f"{START}::TestPrograms::test_of_other_constants_are_others"),
    ("start: arguments do not name a program", KEPT, "fingerprint.digest(args,", "fingerprint.digest(None,",
     f"{START}::TestPrograms::test_of_another_structure_are_others[name]"),
    ("start: a part from outside is known by its name", FINGERPRINT,
     "if found is None or inspect.unwrap(found) is not x:", "if False:",
     f"{START}::TestWhatNobodyCanTell::test_a_part_from_outside"),
    ("start: a newer file is taken for the loaded one", FINGERPRINT, "if path.stat().st_ctime >= BEGAN:", "if False:",
     f"{START}::TestWhatNobodyCanTell::test_a_file_that_is_newer_than_what_was_loaded"),
    ("start: what was put into a module is not seen", FINGERPRINT, "*_settings(), *_held(),", "*_settings(),",
     f"{START}::TestSurroundings::test_differ_for_what_was_put_into_a_module"),
    ("start: settings are not seen", FINGERPRINT, "*_settings(), *_held(),", "*_held(),",
     f"{START}::TestSurroundings::test_differ_for_settings"),
    ("start: the types of what is given are not seen", FINGERPRINT, 'f"array {x.dtype} {x.shape}', 'f"array {x.shape}',
     f"{START}::TestDigest::test_of_what_is_given_is_that_of_types_and_shapes"),
]  # fmt: skip
