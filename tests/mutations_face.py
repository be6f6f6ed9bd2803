"""Mutations of margins, export, frames, figures and pages for `mutations.py`: name, file, old, new, test."""

OPENED, MARGINS, TRANSFER, TEST = (
    *(f"linear/{name}.py" for name in ("opened_loop", "stability_margins", "transfer")), "test_margins.py",
)  # fmt: skip
CONTROL = f"{TEST}::test_margins_are_those_of_python_control"

FACE = [
    ("margins: the phase above -pi/2", MARGINS, "phases = np.angle(-_response", "phases = np.angle(-1j * _response",
     f"{CONTROL}[continuous]"),
    ("margins: the factor is the gain", MARGINS, "-1 / values[real]", "-values[real]", f"{CONTROL}[sampled]"),
    ("margins: the peak is the grid's", MARGINS, "while high - low > 1e-9 * high:", "while False:",
     f"{CONTROL}[continuous]"),
    ("margins: a delay crosses once", MARGINS, "times = 1 + math.floor((system.delay - first) * w / (2 * math.pi))",
     "times = 1", f"{TEST}::test_a_delay_can_bring_back_what_it_took"),
    ("margins: a rising gain takes stability, too", MARGINS, "2 * times if falling else -2 * times", "2 * times",
     f"{TEST}::test_a_delay_can_bring_back_what_it_took"),
    ("margins: the ends of the axis are none", MARGINS, "[end for end in ends if _real(system, end)]", "[]",
     f"{TEST}::test_ends_of_the_axis"),
    ("margins: a sampled loop's delay is not sampled anew", MARGINS,
     "loop.period is None or not math.isfinite(guess)", "True",
     f"{TEST}::test_the_delay_margin_of_a_sampled_loop_is_where_it_turns_unstable"),
    ("margins: the delay of the computer is forgotten", OPENED, "delay += float(sampled.delay) if sampled else 0.0",
     "pass", f"{TEST}::test_closed_is_the_loop_of_the_certificates[sampled, half a period late]"),
    ("margins: the actuator's delay is forgotten", OPENED,
     "delay = float(sum(block.time for block in blocks if isinstance(block, Delay)))", "delay = 0.0",
     f"{TEST}::test_a_pure_delay_turns_the_phase_and_nothing_else"),
    ("margins: a part of a period is whole", OPENED, "rest = max(delay - whole * self.period, 0.0)", "rest = 0.0",
     f"{TEST}::test_a_sampled_loop_behind_a_delay_is_that_of_a_step_response"),
    ("margins: a command at its limit stays there", OPENED, "OFFSETS = (0.0, 1e-4, -1e-4, 1e-2, -1e-2)",
     "OFFSETS = (0.0,)", f"{TEST}::test_noise_is_a_disturbance_and_limits_do_not_act"),
    ("margins: noise acts at instants", "core/tracing.py", "not _zero(step) and not needed", "not needed",
     f"{TEST}::test_noise_is_a_disturbance_and_limits_do_not_act"),
    ("margins: the search for rest begins where the run does", OPENED,
     "there.at[0].set(around.setpoint) if around.frozen else there", "there",
     f"{TEST}::test_the_brake_lab_rig_and_a_filtered_sensor_come_to_rest"),
    ("margins: a delay of whole periods is none", TRANSFER, "for _ in range(round(shifts)):", "for _ in range(0):",
     f"{TEST}::test_python_control_there_and_back"),
    ("margins: the worst is the best", "linear/robustness.py", "return {name: max(self.systems",
     "return {name: min(self.systems", f"{TEST}::test_a_band_is_of_the_corners_and_of_samples_between"),
]  # fmt: skip

EXPORT, WORDS, DEVICE, TESTS = "export/c99.py", "export/c_words.py", "export/device.py", "test_export.py"
LOWERED, BLOCK = "export/lowered.py", "export/structured_text.py"
PARTS = f"{TESTS}::test_what_is_exported_commands_what_the_parts_do"
FACE += [
    ("export: a comparison the other way round", WORDS, 'CHOSEN = {"lower": "<", "higher": ">"}',
     'CHOSEN = {"lower": ">", "higher": "<"}', f"{PARTS}[PID, filtered derivative-float64]"),
    ("export: a selection the other way round", WORDS, 'return f"{which} ? {yes} : {no}"',
     'return f"{which} ? {no} : {yes}"', f"{PARTS}[conditional integration-float64]"),
    ("export: the target moves once a period", EXPORT, "i < {self.device.moves}", "i < 1",
     f"{PARTS}[filtered target-float64]"),
    ("export: what is returned is read too late", EXPORT,
     'yield from self.words.operations(nodes, "  ")\n        if moving:\n            yield from self._moves(moving)\n',
     'if moving:\n            yield from self._moves(moving)\n        yield from self.words.operations(nodes, "  ")\n',
     f"{TESTS}::test_a_target_that_moves_is_returned_as_it_was"),
    ("export: samples are not counted", DEVICE, "return inner, state.samples + 1, command",
     "return inner, state.samples, command", f"{PARTS}[observer-float64]"),
    ("export: memory that the command does not need at once", LOWERED, "if not more:\n                break",
     "if kept:\n                break", f"{TESTS}::test_memory_behind_memory_is_kept"),
    ("export: numbers of seven digits", WORDS, 'np.format_float_positional(x, trim="0")',
     'np.format_float_positional(x, precision=7, trim="0")',
     f"{TESTS}::test_a_whole_run_is_what_the_exported_controller_does"),
    ("export: an estimator is exported as it starts", DEVICE, "if offers(reference) or moves:", "if False:",
     f"{TESTS}::test_the_target_can_come_from_outside"),
    ("export: the coefficients of rounding", "export/difference_equations.py", "ROUNDING = 1e-12", "ROUNDING = 0.0",
     f"{TESTS}::test_the_command_writes_a_file_that_compiles"),
]  # fmt: skip

FRAMES = "test_frames.py"
FACE += [
    ("frames: rounding is a number", "core/summary.py", "NOTHING = 1e-14", "NOTHING = 0.0",
     f"{FRAMES}::test_rounding_is_no_number"),
    ("frames: a run goes on after its end", "simulate/frames.py", "[:count]) for name, (unit, values)",
     ") for name, (unit, values)", f"{FRAMES}::test_frames_have_units_and_end_where_the_run_does"),
    ("frames: the control has no plant", "simulate/frames.py", "plant.control_unit if plant is not None else RELATIVE",
     "RELATIVE", f"{FRAMES}::test_frames_have_units_and_end_where_the_run_does"),
    ("frames: what diverged counts", "simulate/frames.py", '"reached its stop {end}" if run.stopped',
     '"reached its stop {end}" if True', f"{FRAMES}::test_a_run_says_what_it_is"),
    ("frames: HTML as it comes", "core/summary.py", "<strong>{html.escape(self.title)}</strong>",
     "<strong>{self.title}</strong>", f"{FRAMES}::test_a_summary_is_text_and_html"),
    ("frames: who was refused has failed", "sweep/results.py", "{name: failed & run for", "{name: failed for",
     f"{FRAMES}::test_what_was_missed_or_refused_is_told_apart"),
    ("frames: a sweep without units", "sweep/study.py", "if path in declared}", "if False}",
     f"{FRAMES}::test_the_frame_of_a_sweep_has_units_and_says_what_failed"),
    ("frames: before is after", "tune/result.py", '("objective", *self.objective)',
     '("objective", *self.objective[::-1])', f"{FRAMES}::test_a_tuning_has_a_table"),
    ("frames: deviations of nobody", "identify/fit.py", "deviations.get(name))", "0.0)",
     f"{FRAMES}::test_an_identification_has_a_table"),
]  # fmt: skip

PAGES, DOCS, TABLES = "test_journeys.py", "test_docs.py", "../docs/parameters.py"
PRINTS = f"{PAGES}::test_its_code_prints_what_the_page_says"
FACE += [
    ("pages: a frame without its time", "simulate/frames.py", '.set_index("t")', "", f"{PRINTS}[journeys/pandas.md]"),
    ("pages: a sampled system without a period", "linear/transfer.py",
     "period=float(found.dt) if found.dt else None", "period=None", f"{PRINTS}[journeys/python-control.md]"),
    ("pages: the greatest of many is the least", "simulate/frames.py", "good.min(), good.max()",
     "good.max(), good.min()", f"{PRINTS}[journeys/lanes.md]"),
    ("pages: a block after another is not run", "../tests/pages.py", "for block in blocks(text):",
     "for block in blocks(text)[:1]:", f"{PAGES}::test_what_a_page_says_it_prints_is_seen_and_written"),
    ("reference: an open end is closed", TABLES, """left = "(" if "above" in bound or low""", """left = "(" if low""",
     f"{DOCS}::test_the_reference_shows_unit_and_range_of_every_parameter"),
    ("reference: a value has no unit", TABLES, """named = {"unit": "Unit of the value", """, "named = {",
     f"{DOCS}::test_a_part_becomes_a_table"),
]  # fmt: skip

FIGURES = "test_figures.py"
FACE += [
    ("figures: labels at every mark", "plot/style.py", "one.set_minor_formatter(NullFormatter())", "pass",
     f"{FIGURES}::test_labels_of_a_logarithmic_axis_do_not_touch[(0.2, 0.9)]"),
    ("figures: a long axis has numbers", "plot/style.py", "few = low > 0 and", "few = low > 0 or",
     f"{FIGURES}::test_a_long_axis_has_powers_and_a_short_one_numbers"),
    ("figures: T where S is", "plot/frequency.py", "(1 / (1 + main), COLOURS[1]", "(main / (1 + main), COLOURS[1]",
     f"{FIGURES}::test_the_curves_of_a_loop_are_its_response"),
    ("figures: a map of one colour", "plot/sweeps.py", "np.maximum.at(table, cell, values)", "table[:] = values.max()",
     "test_plot_sweep.py::test_a_map_where_nothing_failed_is_over_what_moves_the_metric"),
]  # fmt: skip

PAGE, WRITING, REPORT = "report/page.py", "report/writing.py", "test_report.py"
NUMBERS = f"{REPORT}::test_a_picture_has_the_numbers_that_it_shows"
SELF = f"{REPORT}::test_a_report_stands_for_itself"
FACE += [
    ("report: names as they come", WRITING, "autoescape=True", "autoescape=False",
     f"{REPORT}::test_hostile_names_are_text[tune]"),
    ("report: numbers as they are shown", PAGE, "repr(value))]", "number(value))]",
     f"{REPORT}::test_numbers_are_those_of_the_document[tune]"),
    ("report: any file is a picture", PAGE, "kind = IMAGES.get(path.suffix.lower())",
     'kind = IMAGES.get(path.suffix.lower(), "image/png")',
     f"{REPORT}::test_figures_outside_of_the_folder_are_not_shown"),
    ("a sampled filter may be as fast as it likes", "controllers/sampled.py", "array(cutoff) * array(period) < 2",
     "array(cutoff) * array(period) < 200",
     "test_refusals.py::test_a_filter_too_fast_for_its_samples_is_refused_where_it_grows"),
    ("a docstring names a module that has moved", "tune/constraints.py", "`design.interior.differentiable`",
     "`design.sensitivity`", "test_docstrings.py::test_what_is_named_is_there"),
    ("every control is a torque", "design/state_feedback.py", "in_words(line, units) for line",
     "line.replace('{control}', 'N m') for line", "test_linearize.py::test_what_is_neglected"),
    ("a filter sampled on the grid may be as fast as it likes", "controllers/sampled_on_grid.py",
     "within_period(self.controller,", "within_period(None,",
     "test_refusals.py::test_a_filter_too_fast_for_its_samples_is_refused_where_it_grows"),
    ("progress: a status wraps", "cli/progress.py", "    if len(words) > room:\n", "    if False:\n",
     "test_progress.py::test_a_status_has_one_line"),
    ("report: a picture's numbers are the axes'", "plot/shown.py", "line.get_xdata(), line.get_ydata())",
     "line.get_ydata(), line.get_xdata())", NUMBERS),
    ("report: numbers of a picture are its first", "plot/shown.py", "np.linspace(0, len(there) - 1,",
     "np.linspace(0, min(MOST, len(there)) - 1,", NUMBERS),
    ("report: axes upside down", "plot/shown.py", "1 - place.y1, place.x1, 1 - place.y0",
     "place.y0, place.x1, place.y1", f"{REPORT}::test_axes_lie_where_the_picture_has_them"),
    ("report: numbers stay in the picture", "core/pictures.py", "return picture[:start] + picture[end:],",
     "return picture,", f"{REPORT}::test_numbers_of_a_picture_leave_no_trace_in_its_bytes"),
    ("report: any numbers are shown", PAGE, 'all(map(_is_series, one["series"])) and',
     'one["series"] is not None and', f"{REPORT}::test_a_picture_that_says_nonsense_is_only_a_picture"),
    ("report: any script may run", WRITING, 'return f"sha256-{', 'return "unsafe-inline" or f"sha256-{',
     f"{SELF}[sweep]"),
    ("report: pictures by their address", PAGE, 'f"data:{kind};base64,{text}"', "path.as_uri()", f"{SELF}[sweep]"),
    ("report: the command is not said", PAGE, '(content.get("made") or {}).get("command")', "None", f"{SELF}[tune]"),
    ("report: intervals on one side", "report/findings.py", "value - NORMAL * deviation", "value",
     f"{REPORT}::test_numbers_are_those_of_the_document[identify]"),
    ("report: a disproved gain is proved", PAGE, 'False: "disproved"', 'False: "proved"',
     f"{REPORT}::test_a_disproved_gain_is_said_to_be"),
    ("report: a certificate is believed", "report/proofs.py", "sum(not one.reason for one in proved)", "len(proved)",
     f"{REPORT}::test_a_certificate_says_what_is_proved"),
    ("report: files of others go", "cli/report.py", "and not (target.is_file() and ours(target))", "and False",
     f"{REPORT}::test_files_of_others_stay"),
    ("report: any JSON is a result", "report/documents.py", "if named and not found:", "if False:",
     f"{REPORT}::test_a_file_of_others_is_refused_in_one_line"),
    ("report: a result comes twice", "report/documents.py", "_home(kind, content, path))", "path)",
     f"{REPORT}::test_a_folder_of_results_is_one_file"),
    ("report: a sweep writes none", "cli/sweep.py", "report.write([out], out / report.NAME)", "pass",
     f"{REPORT}::test_a_sweep_with_figures_writes_its_report"),
    ("report: reproduce writes none of all", "cli/reproduce.py", 'if name == "all" else None', "if False else None",
     "test_cli_list_reproduce.py::test_reproduce_everything"),
    ("report: a chart upside down", "report/charts.py", "round(HEIGHT - BOTTOM - (y - low)", "round(TOP + (y - low)",
     f"{REPORT}::test_a_chart_has_its_points_where_they_are"),
    ("report: figures of a paper are left out", "report/experiments.py", "if pathlib.PurePath(name).name == name]",
     "if False]", "test_papers.py::test_a_report_has_every_number_and_figure[slip-lmi]"),
]  # fmt: skip

TEXT = f"{TESTS}::test_structured_text_commands_what_the_parts_do"
OPERATIONS = f"{TESTS}::test_structured_text_knows_every_kind_of_operation"
FACE += [
    ("st: a selection the other way round", BLOCK, "return f\"SEL({', '.join(args)})\"",
     "return f\"SEL({args[0]}, {args[2]}, {args[1]})\"", f"{TEXT}[conditional integration-float64]"),
    ("st: a limit the other way round", BLOCK, "{'<' if op == 'lower' else '>'}", "{'>' if op == 'lower' else '<'}",
     f"{TEXT}[PID, filtered derivative-float64]"),
    ("st: the target moves before it is read", BLOCK,
     "yield from self._operations(live([*stored.values(), *more]), indent)",
     "yield from self._moves(indent) if more else ()\n        "
     "yield from self._operations(live([*stored.values(), *more]), indent)",
     f"{TESTS}::test_what_a_sample_stores_does_not_change_while_the_target_moves"),
    ("st: the target moves once too often", BLOCK, "self.device.moves - 1", "self.device.moves",
     f"{TEXT}[filtered target-float64]"),
    ("st: it never begins anew", BLOCK, "IF reset OR NOT started", "IF NOT started",
     f"{TESTS}::test_a_block_begins_anew_when_it_is_told_to"),
    ("st: numbers are rounded where they are cut off", BLOCK, "_TRUNC_{after}", "_TO_{after}", OPERATIONS),
    ("st: floor is rounding", BLOCK, '(">", "-") if op == "floor"', '(">", "+") if op == "floor"', OPERATIONS),
    ("st: numbers of C", BLOCK, '.replace("e", "E")', "",
     f"{TESTS}::test_a_whole_run_is_what_the_function_block_does"),
    ("st: words of the language are names", BLOCK, "or name.lower() in RESERVED:", "or False:",
     f"{TESTS}::test_a_name_that_structured_text_does_not_have_is_refused[step]"),
]  # fmt: skip

MAT = "test_matlab.py"
FACE += [
    ("mat: the last sample, repeated", "simulate/matlab.py", "values[:rows]", "values",
     f"{MAT}::test_a_mat_file_has_what_the_csv_has"),
    ("mat: rows", "simulate/matlab.py", ', oned_as="column"', "", f"{MAT}::test_a_mat_file_has_metrics_and_parameters"),
    ("mat: a file over another", "cli/main.py", "if places[one] == places[other]:", "if False:",
     f"{MAT}::test_what_cannot_be_written_is_said_first"),
]  # fmt: skip

PLANT_C, MOCKUP, GLUE, FMU = "export/plant_c.py", "export/mockup.py", "export/fmi2.c", "test_fmu.py"
RUNS = f"{FMU}::test_an_fmu_runs_as_the_simulation_does"
FACE += [
    ("fmu: a step without its projection", PLANT_C, "plant.project(rk4_step(", "(lambda x: x)(rk4_step(",
     f"{RUNS}[a wheel that locks]"),
    ("fmu: the numbers of the scenario for good", PLANT_C, "m->v[{self.places[path]}]\" if where",
     "begun[{self.places[path]}]\" if where == \"v\" and path != CONTROL else f\"m->v[{self.places[path]}]\" if where",
     f"{FMU}::test_parameters_are_the_importers"),
    ("fmu: results are stored one by one", PLANT_C, "yield from (f\"  m->{array}[{k}] = n{k};\" for k in results)",
     "yield from (f\"  m->{array}[{k}] = n{(k + 1) % len(results)};\" for k in results)", f"{RUNS}[balance]"),
    ("fmu: parameters change while it runs", GLUE, "(m->phase == RUNNING && at[i] != OUTPUTS)", "0",
     f"{FMU}::test_parameters_are_the_importers"),
    ("fmu: one step, however long", GLUE, ": ceil(whole);", ": 1.0;",
     f"{FMU}::test_steps_of_any_length_are_taken_by_whole_ones"),
    ("fmu: any importer's plant", GLUE, "|| strcmp(guid, GUID) != 0", "",
     f"{FMU}::test_who_asks_for_another_is_given_none"),
    ("fmu: a state is not kept", GLUE, "{ return copied(c, state); }", "{ return copied(c, c); }",
     f"{FMU}::test_a_state_can_be_kept_and_taken_again"),
    ("fmu: indices from 0", MOCKUP, "enumerate(variables, 1)", "enumerate(variables)",
     f"{FMU}::test_the_description_says_what_is_what"),
    ("fmu: units are forgotten", MOCKUP, '{"unit": printable(one.unit)}', "{}",
     f"{FMU}::test_the_description_says_what_is_what"),
    ("fmu: the archive has the hour", MOCKUP, "zipfile.ZipInfo(path, LONG_AGO)", "path",
     f"{FMU}::test_the_description_says_what_is_what"),
]  # fmt: skip

PROGRESS = "test_progress.py"
FACE += [
    ("progress: compiling within compiling counts twice", "core/stopwatch.py", "while self._spans and",
     "while False and", f"{PROGRESS}::test_spans_that_overlap_count_once"),
    ("progress: XLA is not listened to", "core/stopwatch.py", "if event.startswith(TOLD):", "if False:",
     f"{PROGRESS}::test_what_jax_compiles_is_counted"),
    ("progress: compiling is needed again", "cli/progress.py", "spent = now - start - stopwatch.compiled(start)",
     "spent = now - start", f"{PROGRESS}::test_what_is_left_does_not_count_compiling"),
    ("progress: what was there is done by now", "cli/progress.py", "self.first = self.first or (now, far.done)",
     "self.first = self.first or (now, 0.0)", f"{PROGRESS}::test_what_was_there_before_is_no_pace"),
    ("progress: a line for every second", "cli/progress.py", "if told != (told := words):", "if True:",
     f"{PROGRESS}::test_every_wait_says_how_long_it_takes"),
    ("progress: documents do not say", "cli/console.py", '"of it compiling": round(compiling, 1)',
     '"of it compiling": 0.0', f"{PROGRESS}::test_documents_say_how_long_they_took"),
]  # fmt: skip
