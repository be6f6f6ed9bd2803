"""Mutations of margins and export for `mutations.py`: name, file, old, new, test."""

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
    ("margins: noise acts at instants", "core/tracing.py", "not _zero(step) and any(", "any(",
     f"{TEST}::test_noise_is_a_disturbance_and_limits_do_not_act"),
    ("margins: the search for rest begins where the run does", OPENED,
     "there.at[0].set(around.setpoint) if around.frozen else there", "there",
     f"{TEST}::test_the_brake_lab_rig_and_a_filtered_sensor_come_to_rest"),
    ("margins: a delay of whole periods is none", TRANSFER, "for _ in range(round(shifts)):", "for _ in range(0):",
     f"{TEST}::test_python_control_there_and_back"),
    ("margins: the worst is the best", "linear/robustness.py", "return {name: max(self.systems",
     "return {name: min(self.systems", f"{TEST}::test_a_band_is_of_the_corners_and_of_samples_between"),
]  # fmt: skip

EXPORT, DEVICE, TESTS = "export/c99.py", "export/device.py", "test_export.py"
PARTS = f"{TESTS}::test_what_is_exported_commands_what_the_parts_do"
FACE += [
    ("export: a comparison the other way round", EXPORT, 'CHOSEN = {"lower": "<", "higher": ">"}',
     'CHOSEN = {"lower": ">", "higher": "<"}', f"{PARTS}[PID, filtered derivative-float64]"),
    ("export: a selection the other way round", EXPORT, 'return f"{which} ? {yes} : {no}"',
     'return f"{which} ? {no} : {yes}"', f"{PARTS}[conditional integration-float64]"),
    ("export: the target moves once a period", EXPORT, "i < {self.device.moves}", "i < 1",
     f"{PARTS}[filtered target-float64]"),
    ("export: what is returned is read too late", EXPORT, "late = {node.id: node for node in [*stored.values(), *more]",
     "late = {node.id: node for node in [*stored.values()]",
     f"{TESTS}::test_a_target_that_moves_is_returned_as_it_was"),
    ("export: samples are not counted", DEVICE, "return inner, state.samples + 1, command",
     "return inner, state.samples, command", f"{PARTS}[observer-float64]"),
    ("export: memory that the command does not need at once", EXPORT, "if not more:\n                break",
     "if kept:\n                break", f"{TESTS}::test_memory_behind_memory_is_kept"),
    ("export: numbers of seven digits", EXPORT, 'np.format_float_positional(x, trim="0")',
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

FIGURES = "test_figures.py"
FACE += [
    ("figures: labels at every mark", "plot/runs.py", "one.set_minor_formatter(NullFormatter())", "pass",
     f"{FIGURES}::test_labels_of_a_logarithmic_axis_do_not_touch[(0.2, 0.9)]"),
    ("figures: a long axis has numbers", "plot/runs.py", "few = low > 0 and", "few = low > 0 or",
     f"{FIGURES}::test_a_long_axis_has_powers_and_a_short_one_numbers"),
    ("figures: T where S is", "plot/frequency.py", "(1 / (1 + main), COLOURS[1]", "(main / (1 + main), COLOURS[1]",
     f"{FIGURES}::test_the_curves_of_a_loop_are_its_response"),
    ("figures: a map of one colour", "plot/sweeps.py", "np.maximum.at(table, cell, values)", "table[:] = values.max()",
     "test_plot_sweep.py::test_a_map_where_nothing_failed_is_over_what_moves_the_metric"),
]  # fmt: skip
