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
    ("margins: noise acts at instants", OPENED, "and not _nothing(equation)", "",
     f"{TEST}::test_noise_is_a_disturbance_and_limits_do_not_act"),
    ("margins: the search for rest begins where the run does", OPENED,
     "there.at[0].set(around.setpoint) if around.frozen else there", "there",
     f"{TEST}::test_the_brake_lab_rig_and_a_filtered_sensor_come_to_rest"),
    ("margins: a delay of whole periods is none", TRANSFER, "for _ in range(round(shifts)):", "for _ in range(0):",
     f"{TEST}::test_python_control_there_and_back"),
    ("margins: the worst is the best", "linear/robustness.py", "return {name: max(self.systems",
     "return {name: min(self.systems", f"{TEST}::test_a_band_is_of_the_corners_and_of_samples_between"),
]  # fmt: skip
