"""Does every test that should fail, fail? Breaks a copy of the package in one place at a time and runs the tests named.

    python tests/mutations.py [part of a name ...]

A mutation whose test does not end within LIMIT_S is dead too, and it is said. Exit status 1 if a mutation survives, if
its text is no longer in the file, or if a named test fails without it. Not
collected by pytest; run it weekly, and when a test is added: add a line to MUTATIONS (of
sweeps: in mutations_sweep.py, of the kernel: in mutations_kernel.py).
"""

import contextlib
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
from typing import NamedTuple

from mutations_kernel import KERNEL
from mutations_sweep import SWEEP

ROOT = pathlib.Path(__file__).resolve().parent.parent
LIMIT_S = 300.0  # for the test of a mutation; the slowest takes a minute when nothing is compiled yet


class Mutation(NamedTuple):
    """In diffabs/`file`, `old` becomes `new`; `test` (file::name, or file::name[case]) must then fail."""

    name: str
    file: str
    old: str
    new: str
    test: str


MUTATIONS = [
    Mutation(
        "a comparison that nobody looks at",
        "core/regime.py",
        "against = margin < -_rounding(x)",
        "against = margin < -jnp.inf",
        "test_kinks.py::test_who_looks_sees_what_is_contradicted_and_by_how_much[gt]",
    ),
    Mutation(
        "an integral that stays clamped where comparisons are held",
        "controllers/antiwindup.py",
        "jnp.not_equal(raw, limited) & ",
        "",
        "test_kinks.py::test_an_integral_that_was_clamped_goes_on",
    ),
    Mutation(
        "a search that nobody looks at",
        "core/regime.py",
        "next = below + jnp.where(high < -_rounding(x), 1, 0) - jnp.where(low < -_rounding(x), 1, 0)",
        "next = below",
        "test_kinks.py::test_a_derivative_through_a_kink_is_that_of_the_closed_form[a table]",
    ),
    Mutation(
        "rounding that is taken for a crossing",
        "core/regime.py",
        "most.eps**ROUNDING *",
        "0.0 *",
        "test_kinks.py::test_numbers_that_are_equal_to_rounding_say_nothing",
    ),
    Mutation(
        "a contrary with a number of its own",
        "core/kinks.py",
        "key = (y, x, not strict) if turned else (x, y, strict)",
        "key = (x, y, strict)",
        "test_kinks.py::test_a_program_is_the_function[a contrary]",
    ),
    Mutation(
        "comparisons of what is fixed",
        "core/kinks.py",
        "asks = name if moves and real",
        "asks = name if real",
        "test_kinks.py::test_a_program_is_the_function[of what is fixed]",
    ),
    Mutation(
        "an answer that contradicts nobody is held for ever",
        "core/regime.py",
        "against |= gives & (margin == 0) & (says() != taken)",
        "pass",
        "test_kinks.py::test_a_product_that_has_become_0_is_held_by_nobody",
    ),
    Mutation(
        "adaptive steps look at the first signal alone",
        "simulate/lengths.py",
        "    return 0.5 * jnp.max(jnp.stack(off))",
        "    return 0.5 * off[0]",
        "test_adaptive.py::test_the_error_of_a_step_is_that_of_the_worst_state",
    ),
    Mutation(
        "kinks that were not predicted stay in a step",
        "simulate/adaptive.py",
        "exact = fine & (((here.error <= 1) & (here.late <= 0)) | short)",
        "exact = fine & ((here.error <= 1) | short)",
        "test_adaptive.py::test_derivatives_on_limits_agree_with_differences_of_three_widths",
    ),
    Mutation(
        "what was not taken is repeated in no regime",
        "simulate/replay.py",
        "words = select(notes.moved, notes.words, following)",
        "words = notes.words",
        "test_adaptive.py::test_reverse_mode_is_forward_mode[slip-lmi]",
    ),
    Mutation(
        "a repeated step ends where it was noted",
        "simulate/replay.py",
        "    t = one.t + shift\n",
        "    shift *= 0.0\n    t = one.t + shift\n",
        "test_adaptive.py::test_a_derivative_through_a_relay_and_a_latch_is_that_of_fixed_steps",
    ),
    Mutation(
        "a derivative takes the steps of values",
        "simulate/lengths.py",
        "DERIVATIVES if self.notes else VALUES",
        "VALUES",
        "test_adaptive.py::test_derivatives_on_limits_agree_with_differences_of_three_widths",
    ),
    Mutation(
        "adaptive steps end on every instant of the grid",
        "simulate/lengths.py",
        "jnp.minimum(loop.next_tick(k, self.h), self.steps)",
        "jnp.minimum(k + 1, self.steps)",
        "test_adaptive.py::test_a_computer_strikes_on_its_own_clock_and_not_on_the_grid",
    ),
    Mutation(
        "a trajectory shows the end of the step",
        "simulate/methods.py",
        "        inside = (t < now.t) & (carry.past.until > carry.past.t)",
        "        inside = (t < now.t) & (carry.past.until < carry.past.t)",
        "test_adaptive.py::test_a_trajectory_is_kept_on_the_grid_and_changes_nothing",
    ),
    Mutation(
        "a trajectory takes the rates after a computer's instant for those before",
        "simulate/adaptive.py",
        "    return point.t, point.state.flow(), point.rate[0]",
        "    return point.t, point.state.flow(), jax.tree.map(lambda x: 0.0 * x, point.rate[0])",
        "test_adaptive.py::test_between_the_instants_of_a_computer_a_trajectory_is_that_of_fixed_steps",
    ),
    Mutation(
        "a repeated step has the rates of its beginning at its end",
        "simulate/replay.py",
        "system.rates(t, z, held, within)[0]) if pace.keeps",
        "begin.seen.rate) if pace.keeps",
        "test_adaptive.py::test_the_derivative_of_a_trajectory_is_that_of_fixed_steps[limits]",
    ),
    Mutation(
        "comparisons are seen a step too late",
        "simulate/foresight.py",
        "jnp.where(since < -least, -since, FAR)",
        "FAR",
        "test_adaptive.py::test_lines_say_when_comparisons_change_and_when_they_did",
    ),
    Mutation(
        "single precision is asked for what it has not",
        "simulate/methods.py",
        "ROUNDING = 32 ",
        "ROUNDING = 0 ",
        "test_adaptive.py::test_single_precision_asks_for_no_smaller_error_than_it_has",
    ),
    Mutation(
        "the Jacobian has one column",
        "simulate/lengths.py",
        "(moves) / size",
        "(moves * 0.0 + size[0]) / size",
        "test_adaptive.py::test_the_longest_stable_step_is_that_of_the_eigenvalues[arm-hanging]",
    ),
    Mutation(
        "derivatives without kinks",
        "simulate/methods.py",
        "dataclasses.replace(self, kinks=self.kinks is not False)",
        "dataclasses.replace(self, kinks=False)",
        "test_kinks.py::test_a_derivative_through_a_kink_is_that_of_the_closed_form[a jump]",
    ),
    Mutation(
        "a regime that leads away",
        "simulate/stepper.py",
        "fine &= carry.blunt | _plausible(carry, here) if kinks else True",
        "pass",
        "test_kinks.py::test_where_a_step_is_too_long_a_regime_is_not_believed",
    ),
    Mutation(
        "a slide that nobody gives up",
        "simulate/stepper.py",
        "tired & (search.which < kinks)",
        "tired & False",
        "test_kinks.py::test_a_run_that_slides_along_a_kink_is_a_run",
    ),
    Mutation(
        "a latch that takes rounding for a maximum",
        "references/peak_slip.py",
        "zero + LEAST, slip",
        "zero, slip",
        "test_blocks.py::test_latch_waits_for_the_brake",
    ),
    Mutation(
        "the later of two events in a step",
        "simulate/landing.py",
        "enough & ~at_once & tells.another",
        "enough & ~at_once & False",
        "test_blocks.py::test_two_events_in_one_step",
    ),
    Mutation(
        "a chattering relay runs on",
        "simulate/stepper.py",
        "jnp.where(lost, Condition.DIVERGED, condition)",
        "jnp.where(lost, Condition.TIMED_OUT, condition)",
        "test_blocks.py::test_what_switches_in_every_step_is_no_run",
    ),
    Mutation(
        "noise that does not make the deceleration fall",
        "core/loop.py",
        "((a >= 0) & ((b < 0) | (c < 0)))",
        "((a >= 0) & (c < 0))",
        "test_blocks.py::test_noise_of_a_sampled_accelerometer_latches_where_it_jumps_down",
    ),
    Mutation(
        "|e| without its zero",
        "objectives/tracking.py",
        "cubic.start * cubic.end < 0",
        "cubic.start * cubic.end < -1e9",
        "test_blocks.py::test_the_integral_of_an_error_that_changes_sign",
    ),
    Mutation(
        "rules of a part around a part that is not sound",
        "core/pytree.py",
        "found |= bool(within)",
        "found |= False",
        "test_plants.py::test_a_lever_on_a_broken_road_is_not_asked_for",
    ),
    Mutation(
        "a lever that locks itself and pushes the wheel off",
        "plants/lab_rig.py",
        "jnp.where(free, arm, 1.0)), jnp.inf)",
        "jnp.where(free, arm, 1.0)), quotient(self.weight_torque + torque, arm))",
        "test_plants.py::test_a_lever_that_locks_itself_further_on_is_no_run",
    ),
    Mutation(
        "a lever that may lock itself",
        "plants/lab_rig.py",
        "yield stays_below(friction, limit,",
        "yield stays_below(friction, 1e9 * limit,",
        "test_plants.py::test_a_lever_that_locks_itself_is_refused",
    ),
    Mutation(
        "a stuck wheel that rounding turns",
        "plants/lab_rig.py",
        "wheel = jnp.where(rests, 0.0, wheel)",
        "wheel = jnp.where(rests, wheel, wheel)",
        "test_plants.py::test_a_stuck_lab_wheel_stays_at_rest",
    ),
    Mutation(
        "a stuck wheel that no torque can hold",
        "plants/lab_rig.py",
        "held = arm > self.wheel_radius * mu",
        "held = arm > -jnp.inf",
        "test_plants.py::test_a_lab_wheel_that_no_torque_holds_turns_again",
    ),
    Mutation(
        "RK4 with a wrong weight",
        "simulate/rk4.py",
        "(0.5, 2.0), (0.5, 2.0)",
        "(0.5, 1.0), (0.5, 3.0)",
        "test_integrate.py::test_fourth_order",
    ),
    Mutation(
        "RK4 stage at the wrong time",
        "simulate/rk4.py",
        "rate = f(t + place * h,",
        "rate = f(t,",
        "test_integrate.py::test_fourth_order",
    ),
    Mutation(
        "a step without the derivative in its parameters",
        "simulate/rk4.py",
        "return jax.jvp(step, (moving,), (rates,))",
        "return jax.jvp(step, (moving,), ([*rates[:2], *(0.0 * r for r in rates[2:])],))",
        "test_checkpoints.py::test_reverse_forward_and_differences_agree_in_nested_scans",
    ),
    Mutation(
        "a scan that keeps every carry",
        "simulate/checkpoint.py",
        "SLOTS = 1800",
        "SLOTS = 10**9",
        "test_checkpoints.py::test_memory_of_reverse_mode_hardly_grows_with_the_number_of_steps",
    ),
    Mutation(
        "nested scans that make too few steps",
        "simulate/checkpoint.py",
        "return math.ceil(count / inner), inner",
        "return count // inner, inner",
        "test_checkpoints.py::test_nested_scans_make_enough_steps_and_keep_few_carries[1801]",
    ),
    Mutation(
        "a batch ends with its first lane",
        "simulate/drivers.py",
        "jax.lax.while_loop(lambda carry: anyone(carry.running), block",
        "jax.lax.while_loop(lambda carry: ~anyone(~carry.running), block",
        "test_rollout.py::test_a_batch_ends_with_its_last_lane",
    ),
    Mutation(
        "lanes that wait for each other's events",
        "simulate/checkpoint.py",
        "jnp.any(running, axis=0)",
        "jnp.all(running, axis=0)",
        "test_rollout.py::test_a_batch_ends_with_its_last_lane",
    ),
    Mutation(
        "structures that forget their class",
        "core/pytree.py",
        "    _register(new, [f.name for f in fields if f.name not in meta], meta)\n",
        "    jax.tree_util.register_dataclass(new, [f.name for f in fields if f.name not in meta], meta)\n",
        "test_pytree.py::test_structures_of_different_classes_differ",
    ),
    Mutation(
        "infinity inside every range",
        "core/pytree.py",
        " & ((abs(x) < math.inf) | self.infinite)",
        "",
        "test_pytree.py::test_check_returns_the_part_and_allows_declared_infinities",
    ),
    Mutation(
        "weak types stay weak",
        "core/pytree.py",
        "return jax.tree.map(lambda x: jnp.asarray(x, dtype), tree)",
        "return tree",
        "test_conformance.py::test_new_values_do_not_compile_again[plant: quarter car]",
    ),
    Mutation(
        "an odd curve that is even",
        "core/numerics.py",
        "return s * curve(s * x)",
        "return curve(s * x)",
        "test_conformance.py::test_road[SNOW]",
    ),
    Mutation(
        "a power with an infinite gradient at 0",
        "core/numerics.py",
        "jnp.log(jnp.where(fine, square, 1.0))",
        "jnp.log(square)",
        "test_conformance.py::test_road[RIG]",
    ),
    Mutation(
        "pchip with secants weighted the wrong way round",
        "roads/tabulated.py",
        "w0 * m[1:] + w1 * m[:-1]",
        "w1 * m[1:] + w0 * m[:-1]",
        "test_roads.py::test_tabulated_is_pchip",
    ),
    Mutation(
        "pchip with a steep end",
        "roads/tabulated.py",
        "jnp.where(steep, 3 * m0, d)",
        "d",
        "test_roads.py::test_tabulated_is_pchip",
    ),
    Mutation(
        "a peak without its derivative",
        "roads/optimum.py",
        "s0 - ratio(slope(s0), curvature)",
        "s0",
        "test_roads.py::test_gradient_of_burckhardt_peak",
    ),
    Mutation(
        "a ramp between patches that is a line",
        "roads/patches.py",
        "y * y * (3 - 2 * y)",
        "y",
        "test_roads.py::test_patches_are_c1",
    ),
    Mutation(
        "slip of the wrong sign",
        "plants/wheel.py",
        "return quotient(speed - wheel_speed,",
        "return quotient(wheel_speed - speed,",
        "test_plants.py::test_energy_only_goes_into_friction[quarter car]",
    ),
    Mutation(
        "a brake that turns a stopped wheel backwards",
        "plants/wheel.py",
        "return jnp.where(jnp.greater(speed, 0), rate, larger(rate, 0.0))",
        "return rate",
        "test_plants.py::test_a_stopped_wheel_stays_stopped_until_released[mirrored rig]",
    ),
    Mutation(
        "a plant that stops gradients",
        "plants/mirrored_rig.py",
        "wheel = quotient(push * self.wheel_radius - control, self.wheel_inertia)",
        'wheel = (__import__("jax").lax.stop_gradient(push) * self.wheel_radius - control) / self.wheel_inertia',
        "test_conformance.py::test_plant_jacobian[mirrored rig]",
    ),
    Mutation(
        "a lever without the brake's reaction",
        "plants/lab_rig.py",
        "normal = jnp.where(free, quotient(self.weight_torque + torque, jnp",
        "normal = jnp.where(free, quotient(self.weight_torque, jnp",
        "test_plants.py::test_lab_rig_derivative",
    ),
    Mutation(
        "holding torque of a wheel without inertia",
        "plants/quarter_car.py",
        "self.mass * self.radius + (1 - target) * self.inertia / self.radius",
        "self.mass * self.radius",
        "test_plants.py::test_holding_holds_the_slip[25.0-0.2-quarter car]",
    ),
    Mutation(
        "anti-windup that winds up",
        "controllers/antiwindup.py",
        "ratio(limited - raw, gain * self.tracking_time)",
        "ratio(raw - limited, gain * self.tracking_time)",
        "test_blocks.py::test_antiwindup",
    ),
    Mutation(
        "a derivative without its filter",
        "controllers/pid.py",
        "return PIDMemory(integral, self.cutoff * (error - memory.flow.filtered))",
        "return PIDMemory(integral, 0.0 * error)",
        "test_blocks.py::test_pi_and_filtered_derivative_to_a_step",
    ),
    Mutation(
        "a relay without hysteresis",
        "controllers/switching.py",
        "return (self.band + jnp.where",
        "return (0.0 * self.band + jnp.where",
        "test_blocks.py::test_relay_switches_on_the_far_side_of_its_band",
    ),
    Mutation(
        "a computer without delay",
        "controllers/sampled.py",
        "clock.t + self.delay",
        "clock.t",
        "test_blocks.py::test_sampled_is_a_zero_order_hold",
    ),
    Mutation(
        "events at the end of the step in which they are noticed",
        "simulate/landing.py",
        "jnp.where(earlier, before, jnp.where(enough, x + apart, guess)), enough & ~earlier",
        "x, True",
        "test_blocks.py::test_latch_finds_the_vertex",
    ),
    Mutation(
        "a latch that goes by the signed deceleration",
        "references/peak_slip.py",
        "return jnp.abs(signal.deceleration)",
        "return signal.deceleration",
        "test_estimator_bias.py::test_a_biased_accelerometer_misleads_the_latch_as_the_paper_has_it[0.1]",
    ),
    Mutation(
        "a ring of a delay that is not made longer for shorter steps",
        "actuators/delay.py",
        "capacity=times * self.capacity",
        "capacity=self.capacity",
        "test_accuracy.py::test_a_delay_keeps_its_time_at_a_shorter_step",
    ),
    Mutation(
        "an error estimate that forgets what a quarter step leaves",
        "simulate/accuracy.py",
        "error = jnp.abs(d1) + jnp.abs(d2) / (1 - jnp.minimum(q, SLOW))",
        "error = jnp.abs(d1)",
        "test_accuracy.py::test_the_error_of_a_smooth_loop_is_that_of_fourth_order",
    ),
    Mutation(
        "noise taken for the same at every step",
        "simulate/accuracy.py",
        "    if key is None:",
        "    if True:",
        "test_accuracy.py::test_other_noise_is_not_compared[0.00025]",
    ),
    Mutation(
        "a third gain that nobody sees",
        "core/pytree.py",
        "kinds.shape(value) != spec.shape",
        "False",
        "test_kinds.py::test_wrong_shapes_are_refused_under_transformations_too",
    ),
    Mutation(
        "a robust latch that is always armed",
        "references/peak_slip.py",
        "(m.latched < 0.5) & (m.greatest > self.arming)",
        "(m.latched < 0.5)",
        "test_blocks.py::test_robust_latch",
    ),
    Mutation(
        "a delay whose jumps nobody looks for",
        "actuators/delay.py",
        "(m.window[i, -1] > 0.5)",
        "(m.window[i, -1] > 2.0)",
        "test_delay.py::test_a_jump_comes_out_at_its_moment[0.0073-0.0026-False]",
    ),
    Mutation(
        "noise drawn off its period",
        "core/protocols.py",
        "self.on_grid & (self.k % n == 0)",
        "self.on_grid & (self.k % n == 1)",
        "test_blocks.py::test_noise",
    ),
    Mutation(
        "a biased accelerometer that reads true",
        "sensors/speed.py",
        "return self.bias - signal.deceleration",
        "return -signal.deceleration",
        "test_blocks.py::test_integrated_accelerometer",
    ),
    Mutation(
        "a speed seen low, its slip that of the true speed",
        "sensors/speed.py",
        "slip=(v - signal.wheel_speed) / jnp.maximum(v, self.floor), speed=v)",
        "speed=v)",
        "test_blocks.py::test_a_speed_seen_low_hides_slip",
    ),
    Mutation(
        "papers: eq. (8) of the arm with the l that it lacks",
        "papers/arm_equations.py",
        "eighth - m2 * lg * sin2",
        "eighth - m2 * l * lg * sin2",
        "test_papers_verdicts.py::test_what_the_printed_equations_of_motion_miss_of_their_own_lagrangian",
    ),
    Mutation(
        "papers: the variation of a torque without its falls",
        "papers/estimator_claims.py",
        'np.sum(np.abs(np.diff(seen(run)["torque"])))',
        'np.sum(np.maximum(np.diff(seen(run)["torque"]), 0))',
        "test_papers_verdicts.py::test_how_abruptly_each_controller_brakes",
    ),
    Mutation(
        "papers: a cost without that of the torque",
        "papers/lmi_claims.py",
        "-(Q + K.T @ K)",
        "-Q",
        "test_papers_verdicts.py::test_the_nearest_explanation_of_the_gain",
    ),
    Mutation(
        "units: what stands below the line stands above",
        "core/units.py",
        "exponent = int(power or 1) * (-1 if slash else 1)",
        "exponent = int(power or 1)",
        "test_servo.py::test_units_are_those_of_the_loop",
    ),
    Mutation(
        "overshoot: only above",
        "objectives/tracking.py",
        "jnp.where(sample.setpoint < 0, -1.0, 1.0)",
        "jnp.where(sample.setpoint < 0, 1.0, 1.0)",
        "test_servo.py::test_the_linear_servo_follows_its_closed_form",
    ),
    Mutation(
        "overshoot: an angle is limited like a slip",
        "objectives/tracking.py",
        'getattr(output, "highest", math.inf)',
        'getattr(output, "highest", 1.0)',
        "test_servo.py::test_the_linear_servo_follows_its_closed_form",
    ),
    Mutation(
        "stability: only at the limit of the controller",
        "simulate/stable_step.py",
        "for one in (loop, arrived)",
        "for one in (loop,)",
        "test_servo.py::test_the_step_is_judged_where_the_controller_is_not_at_its_limit",
    ),
    Mutation(
        "operating point: states of the controller left out",
        "linear/operating_point.py",
        "kept = plant | (found.K != 0)",
        "kept = plant | (found.K != found.K)",
        "test_servo.py::test_the_linear_model_is_the_one_written_by_hand",
    ),
    Mutation(
        "operating point: whatever does not rest has a model",
        "linear/operating_point.py",
        "if not found.residue < RESIDUE:",
        "if False:",
        "test_servo.py::test_what_has_no_linear_model_says_so",
    ),
    Mutation(
        "parts from outside: a name is taken twice",
        "scenario/registry.py",
        "if name in _packaged(family) or name in found:",
        "if name in found:",
        "test_servo.py::test_a_module_that_cannot_be_used_is_one_line",
    ),
    Mutation(
        "parts from outside: of another group",
        "scenario/outside.py",
        "entry_points(group=GROUP)",
        'entry_points(group="other")',
        "test_servo.py::test_an_installed_module_is_known_by_its_entry_point",
    ),
    Mutation(
        "parts from outside: --parts is not looked at",
        "cli/usage.py",
        "know(parts or ())",
        "know(())",
        "test_servo.py::test_simulate_prints_writes_and_draws",
    ),
    Mutation(
        "a part that is missing is taken from a brake",
        "scenario/registry.py",
        'own, units = getattr(plant, "usual_parts", dict), units_of(plant)',
        "own, units = braking().plant.usual_parts, units_of(plant)",
        "test_servo.py::test_what_a_plant_of_ones_own_needs_is_asked_for_by_name",
    ),
    Mutation(
        "IAE without abs",
        "objectives/tracking.py",
        "jnp.abs(whole))",
        "whole)",
        "test_conformance.py::test_errors_count_on_either_side[iae]",
    ),
    Mutation(
        "a peak at an instant, not between",
        "core/cubic.py",
        "return jnp.where(inside & (top > ends), top, ends)",
        "return ends",
        "test_blocks.py::test_the_integral_of_an_error_that_changes_sign",
    ),
    Mutation(
        "a road that nobody lists",
        "roads/__init__.py",
        "from diffabs.roads.tabulated import Tabulated as Tabulated\n",
        "from diffabs.roads.tabulated import PiecewiseCubic as PiecewiseCubic\n"
        "from diffabs.roads.tabulated import Tabulated as Tabulated\n",
        "test_conformance.py::test_every_exported_part_has_an_instance",
    ),
    Mutation(
        "a run that is never timed out",
        "simulate/outcome.py",
        "(carry.condition == Condition.TIMED_OUT) & ~diverged",
        "(carry.condition == Condition.LANDING) & ~diverged",
        "test_rollout.py::test_a_run_that_does_not_stop_is_charged_the_rest",
    ),
    Mutation(
        "a landing near the zero",
        "simulate/landing.py",
        "length = place - margin / jnp.where(at_place < 0, at_place, -jnp.inf)",
        "length = place",
        "test_blocks.py::test_relay_switches_on_the_far_side_of_its_band",
    ),
    Mutation(
        "a delay that knows no rates",
        "actuators/delay.py",
        "(h * rate for rate in passage.rates)",
        "(0.0 * rate for rate in passage.rates)",
        "test_order_of_events.py::test_converges_to_scipy[delay]",
    ),
    Mutation(
        "a delay whose kinks nobody looks for",
        "actuators/delay.py",
        "return jnp.any(jnp.stack(jumps))",
        "return jumps[0]",
        "test_delay.py::test_what_bends_comes_out_bent[True]",
    ),
    Mutation(
        "kinks of what is recorded do not count",
        "simulate/dynamics.py",
        "(seen[:2], seen.signals.recorded)",
        "seen[:2]",
        "test_delay.py::test_what_bends_comes_out_bent[True]",
    ),
    Mutation(
        "a jump that comes out on the grid, after its end",
        "actuators/delay.py",
        "jnp.where(newest, 1.0, -1.0) * _rounding(until + self.time)",
        "_rounding(until + self.time)",
        "test_delay.py::test_what_a_computer_says_comes_out_later[0.002]",
    ),
    Mutation(
        "a delay whose smooth pieces are kinks",
        "actuators/delay.py",
        "return _count([m.window[i, 1] for i in range(WINDOW)], t - self.time, m.place, m.last)",
        "return jnp.clip(jnp.sum(t - self.time >= m.window[:, 1]).astype(m.last.dtype), m.place, m.last)",
        "test_delay.py::test_nobody_looks_for_the_ends_of_smooth_pieces",
    ),
    Mutation(
        "a delay that overwrites what is still to come out",
        "actuators/delay.py",
        "window = jnp.where(count < size, rows, jnp.nan)",
        "window = rows",
        "test_delay.py::test_a_delay_that_has_no_room_has_no_value[0.0009-True]",
    ),
    Mutation(
        "a delay that sees no further than its window",
        "actuators/delay.py",
        "_piece(m.window, last).end)",
        "_piece(m.window, last).end + jnp.where(m.known == m.count, 0.0, 1.0))",
        "test_delay.py::test_steps_of_any_length",
    ),
    Mutation(
        "a series that records the first signal for all",
        "core/blocks.py",
        "            signal = block.output(t, m, signal)\n        return found\n\n    def record",
        "        return found\n\n    def record",
        "test_delay.py::test_what_bends_comes_out_bent[True]",
    ),
    Mutation(
        "a stop on the grid",
        "simulate/stepper.py",
        "| (to_grid & ~changes))",
        "| to_grid)",
        "test_rollout.py::test_speed_reached_lands_between_samples",
    ),
    Mutation(
        "a landing without derivative",
        "simulate/landing.py",
        "return -rises / jnp",
        "return 0.0 * rises / jnp",
        "test_gradients.py::test_gradient_of_every_objective_in_every_parameter[feedback]",
    ),
    Mutation(
        "derivatives of a moment that are those of a while before it",
        "simulate/landing.py",
        "share = ratio(zero - search.place, x - search.place)",
        "share = 0.0 * zero",
        "test_landing.py::test_derivatives_of_a_moment_are_those_at_the_zero[jacfwd]",
    ),
    Mutation(
        "a landing hundreds of steps away",
        "simulate/landing.py",
        "(search.tries < TRIES))\n\n\ndef _moves",
        "False)\n\n\ndef _moves",
        "test_landing.py::test_a_margin_that_falls_all_at_once_is_landed_on",
    ),
    Mutation(
        "an event at once whose moment has no derivative",
        "simulate/landing.py",
        "smooth & steep, length -",
        "smooth & steep & False, length -",
        "test_landing.py::test_the_moment_of_an_event_on_the_grid_is_differentiable[0.002]",
    ),
    Mutation(
        "an event whose moment has no derivative",
        "simulate/landing.py",
        "found = near | at_once",
        "found = at_once",
        "test_gradients.py::test_gradient_through_the_latch_agrees_with_a_wide_difference[0.0-published0]",
    ),
    Mutation(
        "stop_gradient in a plant",
        "plants/quarter_car.py",
        "mu = self.output(state).deceleration / GRAVITY",
        "mu = __import__('jax').lax.stop_gradient(self.output(state).deceleration / GRAVITY)",
        "test_gradients.py::test_sensitivity_of_the_conventional_brake",
    ),
    Mutation(
        "a run that outlives its horizon",
        "simulate/stepper.py",
        "(on_grid & (carry.k + 1 >= steps))",
        "(on_grid & False)",
        "test_rollout.py::test_a_run_that_does_not_stop_is_charged_the_rest",
    ),
    Mutation(
        "a diverged lane with metrics",
        "simulate/outcome.py",
        "jnp.where(diverged, jnp.nan, value)",
        "value",
        "test_rollout.py::test_a_diverging_lane_is_flagged_and_leaves_the_others_alone",
    ),
    Mutation(
        "a car that reverses",
        "plants/wheel.py",
        "return jnp.where(jnp.greater(speed, 0), speed, 0.0)",
        "return speed",
        "test_rollout.py::test_energy_never_increases_down_to_standstill[car]",
    ),
    Mutation(
        "friction with the wrong sign of slip",
        "plants/mirrored_rig.py",
        "slip_ratio(v, w, self.crawl_speed)",
        "slip_ratio(w, v, self.crawl_speed)",
        "test_oracle.py::test_random_scenario_agrees_with_scipy[2]",
    ),
    Mutation(
        "a stuck wheel that brakes with all its torque",
        "plants/lab_rig.py",
        "stuck = jnp.where(held, smaller(asked, capacity), capacity)",
        "stuck = capacity",
        "test_oracle.py::test_lab_rig_locks_and_stops_like_scipy",
    ),
    Mutation(
        "design: eq. (30) without Q",
        "design/sdp/inequalities.py",
        "[q_root @ x @ even, np.eye(n)], [f @ even, None, np.eye(m)]]",
        "[0 * q_root @ x @ even, np.eye(n)], [f @ even, None, np.eye(m)]]",
        "test_design.py::test_one_vertex_is_the_closed_form_over_ten_decades",
    ),
    Mutation(
        "design: trace Z unweighted",
        "design/sdp/program.py",
        "self.weight = weight / np.trace(weight)",
        "self.weight = np.eye(n) / n",
        "test_design.py::test_four_vertices_agree_with_the_program_by_hand",
    ),
    Mutation(
        "design: drift of a schedule forgotten",
        "design/sdp/program.py",
        "slope = rate / width / frame.tau",
        "slope = 0.0 * rate / width / frame.tau",
        "test_design.py::test_scheduled_gain",
    ),
    Mutation(
        "design: decay rate halved",
        "design/sdp/inequalities.py",
        "return drift - he(flow) - 2 * rate * x",
        "return drift - he(flow) - rate * x",
        "test_design.py::test_pole_regions",
    ),
    Mutation(
        "design: damping cone transposed",
        "design/sdp/inequalities.py",
        "-symmetric([[he(flow)], [-skew, he(flow)]])",
        "-symmetric([[he(flow)], [0 * skew, he(flow)]])",
        "test_design.py::test_pole_regions",
    ),
    Mutation(
        "design: checks switched off",
        "design/synthesis.py",
        "    missing = wanted - {claim.kind for claim in proof.claims}\n",
        '    return ""\n    missing = wanted - {claim.kind for claim in proof.claims}\n',
        "test_design.py::test_a_wrong_answer_called_optimal_is_not_believed[larger Z]",
    ),
    Mutation(
        "design: gap without the residual",
        "design/sdp/solver.py",
        " + float(np.abs(c - found) @ np.abs(self.y))",
        "",
        "test_design.py::test_a_gap_counts_what_the_multipliers_leave",
    ),
    Mutation(
        "design: input limit of another row",
        "design/sdp/program.py",
        "limit.limit * (1 - TIGHTER)",
        "3 * limit.limit",
        "test_design.py::test_guarantees_hold_while_the_system_switches",
    ),
    Mutation(
        "certify: discrete time taken for continuous",
        "design/bounds.py",
        "return math.exp(-2 * rate) * p - c.T @ p @ c",
        "return math.exp(-2 * rate) * p - c @ p @ c.T",
        "test_design.py::test_discrete_analysis_of_one_system",
    ),
    Mutation(
        "certify: multipliers not transformed",
        "design/analysis.py",
        "w = t @ w @ t.T / sizes[:, None, None]",
        "w = w / sizes[:, None, None]",
        "test_design.py::test_published_gain_has_no_common_lyapunov_matrix",
    ),
    Mutation(
        "certify: frame of the wrong form",
        "design/sdp/scaling.py",
        "whole = self.inverse.T @ p @ self.inverse",
        "whole = self.T.T @ p @ self.T",
        "test_design.py::test_verdicts[-76.7-True]",
    ),
    Mutation(
        "certify: rate of a schedule forgotten",
        "design/scheduled.py",
        "common = drift * (end - start)",
        "common = 0 * drift * (end - start)",
        "test_design.py::test_published_gain_is_proved_for_a_speed_that_cannot_jump",
    ),
    Mutation(
        "certify: L2 gain without the input",
        "design/bounds.py",
        "z = l2.output + l2.feedthrough @ self.k",
        "z = l2.output",
        "test_design.py::test_l2_gain_of_one_system_is_the_peak_of_its_frequency_response",
    ),
    Mutation(
        "sensitivity: implicit function with the wrong sign",
        "design/interior/differentiable.py",
        "step = -central_path.solved(hessian, by_problem)",
        "step = central_path.solved(hessian, by_problem)",
        "test_sensitivity.py::test_derivatives_of_a_design_are_differences[ones]",
    ),
    Mutation(
        "sensitivity: Hessian without the curvature of the cost",
        "design/interior/central_path.py",
        '2 * jnp.einsum("ij,abji->ba", total, curved)',
        '0 * jnp.einsum("ij,abji->ba", total, curved)',
        "test_sensitivity.py::test_derivatives_of_a_design_are_differences[ones]",
    ),
    Mutation(
        "sensitivity: path left too early",
        "design/interior/differentiable.py",
        "MU = 1e-8",
        "MU = 1e-3",
        "test_sensitivity.py::test_derivatives_of_a_design_are_differences[ones]",
    ),
    Mutation(
        "sensitivity: multipliers all alike",
        "design/interior/decay_rate.py",
        "2 * jnp.sum(weights * left)",
        "2 * jnp.sum(jnp.mean(weights, 0) * left)",
        "test_sensitivity.py::test_derivative_of_the_decay_is_a_difference_of_certificates[continuous]",
    ),
    Mutation(
        "sensitivity: decay without its end",
        "design/interior/decay_rate.py",
        "EXACT = 1e-8",
        "EXACT = 1e-2",
        "test_sensitivity.py::test_decay_is_what_can_be_proved[gain0-continuous]",
    ),
    Mutation(
        "riccati: S forgotten",
        "linear/riccati_batched.py",
        "a, q = A - times(B, transpose(S)), Q - times(S, transpose(S))",
        "a, q = A, Q",
        "test_riccati.py::test_care_is_scipys[2]",
    ),
    Mutation(
        "riccati: never refused",
        "linear/riccati_batched.py",
        "return jnp.where((error <= limit) & (moved <= limit), P, jnp.nan)",
        "return P",
        "test_riccati.py::test_nearly_unstabilisable_is_right_or_reported",
    ),
    Mutation(
        "riccati: Cayley with the wrong sign",
        "linear/riccati_batched.py",
        "return whole[:n, :n], -whole[:n, n:], whole[n:, :n]",
        "return whole[:n, :n], whole[:n, n:], -whole[n:, :n]",
        "test_riccati.py::test_care_is_scipys[2]",
    ),
    Mutation(
        "riccati: NaN in single precision",
        "linear/riccati.py",
        "if B.dtype != jnp.float64:",
        "if False:",
        "test_riccati.py::test_single_precision_is_refused[care]",
    ),
    Mutation(
        "riccati: derivative with the open loop",
        "linear/riccati.py",
        "closed = A - B @ jnp.linalg.solve(R, B.T @ P + S.T)",
        "closed = A",
        "test_riccati.py::test_gradients_are_differences[care]",
    ),
    Mutation(
        "riccati: gain with the other sign",
        "linear/regulator.py",
        "return Regulator(-jnp.linalg.solve(jnp.asarray(R, found.P.dtype), turned)",
        "return Regulator(jnp.linalg.solve(jnp.asarray(R, found.P.dtype), turned)",
        "test_riccati.py::test_the_rig_is_its_closed_form[q1-140.291806958]",
    ),
    Mutation(
        "values: unknown fields are passed over",
        "core/values.py",
        '            raise unknown(f"{dotted(path, key)} is not a field',
        '            continue\n            raise unknown(f"{dotted(path, key)} is not a field',
        "test_values.py::test_what_is_wrong_is_one_line",
    ),
    Mutation(
        "values: a NumPy number is written as it is",
        "core/values.py",
        "return value if type(value) in PLAIN else",
        "return value if isinstance(value, PLAIN) else",
        "test_values.py::test_parts_are_written_whole_and_the_rest_in_short_if_wanted",
    ),
    Mutation(
        "values: a sweep's distributions stay in km/h",
        "scenario/section_sweep.py",
        "return distributions.in_si(found, item.scale)",
        "return found",
        "test_values.py::test_a_sweep_is_read_once_into_si_by_path_of_the_loop",
    ),
    Mutation(
        "values: a correlation by the scenario's paths",
        "scenario/section_sweep.py",
        "paths=tuple(known[path] for path in paths)",
        "paths=tuple(paths)",
        "test_values.py::test_a_sweep_is_read_once_into_si_by_path_of_the_loop",
    ),
    Mutation(
        "values: reading a scenario needs SciPy",
        "sweep/distributions.py",
        "from numpy.typing import ArrayLike\n",
        "from numpy.typing import ArrayLike\nfrom scipy.special import ndtr as _\n",
        "test_cli_design.py::test_other_commands_do_without_the_extra",
    ),
    Mutation(
        "files: half a file takes the place of the old one",
        "core/files.py",
        "        yield temporary\n        if temporary.exists():\n            temporary.replace(target)",
        "        try:\n            yield temporary\n        finally:\n            temporary.replace(target)",
        "test_values.py::test_a_file_is_the_old_one_or_the_whole_new_one",
    ),
    Mutation(
        "files: half a folder takes the place of the old one",
        "core/files.py",
        "        new.mkdir()\n        yield new\n",
        "        new.mkdir()\n        with contextlib.suppress(KeyError):\n            yield new\n",
        "test_values.py::test_a_folder_is_the_old_one_or_the_whole_new_one",
    ),
    Mutation(
        "command line: dotted and nested kept apart",
        "scenario/parameter_paths.py",
        '            pending[:0] = [(f"{path}.{key}", item) for key, item in value.items()]\n            continue',
        "            found[path] = value\n            continue",
        "test_scenario.py::test_ranges_are_the_same_however_they_are_written",
    ),
    Mutation(
        "command line: km/h unscaled",
        "scenario/parameter_paths.py",
        "return tuple(in_si(end, self.scale) for end in ends)",
        "return tuple(ends)",
        "test_scenario.py::test_slip_lmi_is_the_papers_example",
    ),
    Mutation(
        "command line: inverted allowed",
        "scenario/parameter_paths.py",
        "        if not (np.all(low < high) or (not or_else and np.all(low <= high))):",
        "        if False:",
        "test_scenario_errors.py",
    ),
    Mutation(
        "command line: range of parameter not looked at",
        "scenario/parameter_paths.py",
        "        if not (allowed.holds(low) and allowed.holds(high)):",
        "        if False:",
        "test_scenario_errors.py",
    ),
    Mutation(
        "command line: dump forgets design",
        "scenario/scenario.py",
        'for name in ("design", "tune", "sweep")}',
        'for name in ("tune", "sweep")}',
        "test_scenario.py::test_packaged_scenario_survives_dump_and_load",
    ),
    Mutation(
        "command line: not fastest",
        "cli/certificates.py",
        "fastest=True",
        "fastest=False",
        "test_cli_design.py::test_fastest_decay_and_least_cost_of_a_gain",
    ),
    Mutation(
        "command line: exit 0 when not proved",
        "cli/design.py",
        "        if reason:\n            console.fail",
        "        if False:\n            console.fail",
        "test_cli_design.py::test_specification_that_is_not_proved",
    ),
    Mutation(
        "command line: undecided passes",
        "cli/certificates.py",
        '[] if stable else [f"quad',
        '[] if stable is not False else [f"quad',
        "test_cli_design.py::test_undecided_is_not_proved",
    ),
    Mutation(
        "command line: damping not asked for",
        "cli/certificates.py",
        '"damping": (spec.damping > 0,',
        '"damping": (False,',
        "test_cli_design.py::test_specification_that_is_not_proved",
    ),
    Mutation(
        "command line: no JSON when infeasible",
        "cli/design.py",
        "                    show.as_json(certificates.document(task, reason=str(error)))\n",
        "                    pass\n",
        "test_cli_design.py::test_no_gain_could_not_be_done",
    ),
    Mutation(
        "command line: number of gains",
        "cli/certificates.py",
        "    if len(values) != len(states):",
        "    if False:",
        "test_cli_design.py::test_bad_input_is_one_line_and_leaves_nothing",
    ),
    Mutation(
        "command line: missing extra is a traceback",
        "cli/certificates.py",
        '    except ModuleNotFoundError as error:\n        console.fail(" ".join(str(error).split()))\n',
        "",
        "test_cli_design.py::test_without_the_extra",
    ),
    Mutation(
        "command line: dump forgets what is tuned",
        "scenario/scenario.py",
        'for name in ("design", "tune", "sweep")}',
        'for name in ("design", "sweep")}',
        "test_scenario.py::test_packaged_scenario_survives_dump_and_load",
    ),
    Mutation(
        "command line: free ranges in km/h unscaled",
        "scenario/parameter_paths.py",
        "return tuple(in_si(end, self.scale) for end in ends)",
        "return tuple(ends)",
        "test_scenario.py::test_what_is_tuned_is_the_same_however_it_is_written",
    ),
    Mutation(
        "command line: the scenario is written as it was",
        "cli/tune.py",
        'after = chosen.with_loop(found.loop, "tuned")',
        "after = chosen",
        "test_cli_tune.py::test_what_is_written_loads_and_simulates_to_what_was_reported",
    ),
    Mutation(
        "command line: unmet limits pass",
        "cli/tune.py",
        '"met": beyond <= 0',
        '"met": True',
        "test_cli_tune.py::test_a_constraint_that_is_not_met_could_not_be_done",
    ),
    Mutation(
        "verify: a cost's weights may be negative",
        "design/verify.py",
        '"Q": ("a weight: no diagonal entry below 0", lambda x: min(row[i] for i, row in enumerate(x)) >= 0)',
        '"Q": ("", lambda x: True)',
        "test_verify.py::test_nothing_false_and_no_nonsense_is_proved",
    ),
    Mutation(
        "verify: V need not fall without the cost",
        "design/verify.py",
        'yield f"vertex {i}: what V falls by", positive(falls)',
        "pass",
        "test_verify.py::test_nothing_false_and_no_nonsense_is_proved",
    ),
    Mutation(
        "verify: a rate may be negative",
        "design/verify.py",
        '("[0, inf)", lambda x: x >= 0),\n    "factor"',
        '("[0, inf)", lambda x: True),\n    "factor"',
        "test_verify.py::test_nothing_false_and_no_nonsense_is_proved",
    ),
    Mutation(
        "certify: stable frozen loops are not counted",
        "design/frozen.py",
        "int((rates > 0).sum())",
        "len(grid)",
        "test_cli_design.py::test_frozen_loops_are_counted_at_their_poles",
    ),
    Mutation(
        "papers: every published number counts as reproduced",
        "papers/digest.py",
        'return row["matches"] if "matches" in row else',
        'return True if "matches" in row else',
        "test_digest.py::test_published_numbers_are_counted_from_the_record",
    ),
    Mutation(
        "papers: a claim is refuted whatever the number",
        "papers/digest.py",
        "if claim.false(*values)",
        "if True",
        "test_digest.py::test_a_claim_is_refuted_by_the_number_or_holds",
    ),
    Mutation(
        "command line: limits are met within a tolerance",
        "cli/tune.py",
        '"met": beyond <= 0',
        '"met": beyond <= 1e-3 * abs(bound)',
        "test_cli_tune.py::test_met_is_met_without_a_tolerance",
    ),
    Mutation(
        "tuning: aims at the bound itself",
        "tune/augmented_lagrangian.py",
        "np.full(count, self.method.margin)",
        "np.zeros(count)",
        "test_tune.py::TestConstraints::test_what_is_met_is_met_without_a_tolerance",
    ),
    Mutation(
        "tuning: a step that meets the constraints is forgotten",
        "tune/descent.py",
        "        if worst <= 0:",
        "        if False:",
        "test_tune.py::TestConstraints::test_a_step_that_meets_them_is_returned_where_the_end_does_not",
    ),
    Mutation(
        "command line: no start is bad input",
        "cli/tune.py",
        "    except StartError as error:",
        "    except KeyError as error:",
        "test_cli_tune.py::test_no_start_that_can_be_used_could_not_be_done",
    ),
    Mutation(
        "command line: a proportional gain proved as a fixed one",
        "cli/certificates.py",
        "    if not isinstance(controller, ProportionalFeedback) or not isinstance(reduced.model, SlipModel):",
        "    if True:",
        "test_cli_design.py::test_a_gain_that_follows_the_speed_is_proved_as_one",
    ),
    Mutation(
        "command line: noise taken from the data, not the residuals",
        "cli/identify.py",
        "max(_rms(residuals[name]), LEAST * spread[name])",
        "spread[name]",
        "test_cli_identify.py::test_noise_that_is_not_known_is_taken_from_the_residuals",
    ),
    Mutation(
        "command line: times in any order",
        "scenario/measurements.py",
        "np.flatnonzero(np.diff(t) <= 0)",
        "np.flatnonzero(np.diff(t) < -1e9)",
        "test_cli_identify.py::test_a_bad_file_is_one_line",
    ),
    Mutation(
        "figures: a front with points that another beats",
        "plot/tuning.py",
        "        if y[i] < least:",
        "        if True:",
        "test_plot_tuning.py::test_a_front_has_the_points_that_no_other_beats",
    ),
    Mutation(
        "linearize: curvature of the coordinates dropped",
        "linear/linearization.py",
        "jax.jvp(chart, (x,), (flow(x, u),))[1]",
        "by_x @ flow(x, u)",
        "test_linearize.py",
    ),
    Mutation(
        "a covariance of z instead of the parameters",
        "identify/fit.py",
        "over = np.divide(1.0, slope, out=np.zeros_like(slope), where=slope != 0)",
        "over = np.ones_like(slope)",
        "test_identify.py::TestFit::test_a_curve_and_its_covariance_are_those_of_scipy",
    ),
    Mutation(
        "an estimated variance that is not used",
        "identify/uncertainty.py",
        "degrees, known = len(data) - len(names), data * size / scale",
        "degrees, known = len(data) - len(names), data * size",
        "test_identify.py::TestFit::test_a_line_has_the_closed_form_and_its_covariance[False]",
    ),
    Mutation(
        "a prior that fits but does not inform",
        "identify/uncertainty.py",
        "np.concatenate([known, prior * size])",
        "np.concatenate([known, 0 * prior * size])",
        "test_identify.py::TestFit::test_a_gaussian_prior_has_the_closed_form",
    ),
    Mutation(
        "a point that is not finite is a point",
        "identify/residuals.py",
        "return seen if seen.finite() else None",
        "return seen",
        "test_identify.py::TestFit::test_the_best_start_wins_and_the_others_are_kept",
    ),
    Mutation(
        "data are compared with the instant before",
        "identify/traces.py",
        "part = clamp(ratio(t - times[i], times[i + 1] - times[i]), 0.0, 1.0)",
        "part = 0.0 * t",
        "test_identify.py::TestTraces::test_the_loop_is_compared_between_its_instants_and_stays_where_it_ended",
    ),
    Mutation(
        "tune: decades searched linearly",
        "core/bijectors.py",
        "if far / near >= DECADE:",
        "if False:",
        "test_tune.py::TestSpace::test_a_range_of_decades_is_searched_in_its_logarithm",
    ),
    Mutation(
        "tune: the best tail",
        "tune/risk.py",
        "weights * -jnp.sort(-values)",
        "weights * jnp.sort(values)",
        "test_tune.py::TestAggregates::test_cvar_is_rockafellar_and_uryasevs_minimum",
    ),
    Mutation(
        "tune: no curvature condition",
        "tune/descent.py",
        "elif float(found.gradient @ lane.update) < WOLFE * slope and not longest:",
        "elif False:",
        "test_tune.py::TestDescent::test_a_step_that_is_much_too_short_is_not_content_with_little",
    ),
    Mutation(
        "tune: jumps climbed for ever",
        "tune/descent.py",
        "if lane.jumps >= JUMPS:",
        "if False:",
        "test_tune.py::TestDescent::test_where_the_loss_jumps_it_ends_soon",
    ),
    Mutation(
        "tune: unstable steps entered",
        "tune/descent.py",
        "return found, fine & self.steady(z)",
        "return found, fine",
        "test_tune.py::TestDescent::test_what_is_not_stable_is_not_entered",
    ),
    Mutation(
        "tune: multipliers stay at zero",
        "tune/augmented_lagrangian.py",
        "            m = _raised(m, lanes)\n",
        "",
        "test_tune.py::TestConstraints::test_the_multipliers_find_the_constrained_minimum",
    ),
    Mutation(
        "batch: lanes of groups out of order",
        "simulate/batch.py",
        "jnp.concatenate(x)[order]",
        "jnp.concatenate(x)",
        "test_batch.py::TestLanes::test_in_order_when_those_of_similar_length_run_together",
    ),
    Mutation(
        "batch: lanes that run together although they are not accepted",
        "simulate/batch.py",
        "    if accepted is True:\n        return run",
        "    return run",
        "test_batch.py::TestLanes::test_that_are_not_accepted[together]",
    ),
    Mutation(
        "batch: a trace of no argument is not seen",
        "core/compiling.py",
        "isinstance(jax.device_put(0), Tracer) or any(",
        "any(",
        "test_batch.py::TestLanes::test_are_those_of_single_runs_together",
    ),
    Mutation(
        "batch: seeds all alike",
        "simulate/batch.py",
        "return jax.vmap(jax.random.key)(jnp.asarray(self.keys))",
        "return jax.vmap(jax.random.key)(0 * jnp.asarray(self.keys))",
        "test_batch.py::TestLanes::test_may_differ_in_their_noise_alone[refilled]",
    ),
    Mutation(
        "batch: values have no derivatives",
        "simulate/batch.py",
        "columns = {path: jnp.asarray(column, float) for",
        "columns = {path: jax.lax.stop_gradient(jnp.asarray(column, float)) for",
        "test_batch.py::test_derivatives_are_those_of_single_runs[jacfwd]",
    ),
    Mutation(
        "batch: loops of any structure taken for the first",
        "simulate/batch.py",
        "(jax.tree.structure(loop), *map",
        "(0, *map",
        "test_batch.py::TestStacked::test_of_one_structure",
    ),
    Mutation(
        "tune: discrete poles taken for continuous ones",
        "tune/constraints.py",
        "if self.system.period is not None:",
        "if False:",
        "test_tuning.py::TestPoles::test_discrete_poles_are_those_of_continuous_time",
    ),
    Mutation(
        "tune: a worst case at a corner that gradients are said to have found",
        "tune/worst.py",
        "if self.value <= self.corner * (1 + SAME):",
        "if False:",
        "test_tuning.py::test_a_worst_case_says_what_found_it",
    ),
    Mutation(
        "tune: the worst case is only screened",
        "tune/worst.py",
        "if lane.reason is not Reason.START and -float(lane.seen.objective) > value:",
        "if False:",
        "test_tuning.py::TestWorstCase::test_it_is_at_least_as_bad_as_thousands_of_samples",
    ),
    Mutation(
        "tune: weights without their off-diagonal",
        "tune/weights.py",
        "root = root + jnp.diag(diagonal)",
        "root = jnp.diag(diagonal)",
        "test_tuning.py::TestWeights::test_the_gain_is_that_of_the_riccati_equation",
    ),
    Mutation(
        "scaled: the speed does not fall",
        "design/speed_scaled.py",
        "jnp.where(torque, 1 + scaled.fall, 1.0) / s",
        "jnp.where(torque, 1.0, 1.0) / s",
        "test_tuning.py::TestSpeedScaled::test_a_falling_speed_is_followed_step_by_step",
    ),
    Mutation(
        "stability: every mode judged as a real one",
        "simulate/stable_step.py",
        "angles = np.abs(np.angle(direction))",
        "angles = np.full(np.shape(direction), np.pi)",
        "test_tuning.py::TestStability::test_the_limit_of_a_real_and_of_an_imaginary_mode",
    ),
    Mutation(
        "scheduled feedback: intervals below the speed left out",
        "controllers/gain_schedule.py",
        "jnp.where(v >= nodes[1:], 1.0,",
        "jnp.where(v >= nodes[1:], 0.0,",
        "test_blocks.py::test_scheduled_feedback_interpolates_between_many_nodes",
    ),
    Mutation(
        "proportional feedback: the same gain at every speed",
        "controllers/gain_schedule.py",
        "(signal.measured.speed / self.reference_speed)",
        "1.0",
        "test_blocks.py::test_proportional_feedback_is_state_feedback_with_a_gain_that_goes_with_the_speed",
    ),
    Mutation(
        "torque rate: of a sample, not of time",
        "objectives/braking.py",
        "rates = (jnp.abs(rate.control) for rate in segment.sample_rates())",
        "rates = (segment.step * jnp.abs(rate.control) for rate in segment.sample_rates())",
        "test_rollout.py::test_the_torque_rate_of_a_lag_is_that_of_its_exponential",
    ),
    Mutation(
        "balance: gravity pulls the arm up",
        "plants/arm_balance.py",
        "r2 = torque - c2 * sin2 * v1**2 + arm",
        "r2 = torque - c2 * sin2 * v1**2 - arm",
        "test_arm.py::test_the_closed_form_is_lagranges_equation[upright]",
    ),
    Mutation(
        "balance: Coriolis without its 2",
        "plants/arm_balance.py",
        "c2 * sin2 * v2 * (2 * v1 + v2)",
        "c2 * sin2 * v2 * (v1 + v2)",
        "test_arm.py::test_what_the_motor_puts_in_and_the_damper_takes_out_is_the_energys_change[hanging]",
    ),
    Mutation(
        "balance: a current without limit",
        "plants/arm_balance.py",
        "current = clamp(current, -self.current_max, self.current_max)",
        "current = clamp(current, -np.inf, np.inf)",
        "test_arm.py::test_torque_ends_at_the_current_limit",
    ),
    Mutation(
        "balance: printed equations corrected",
        "plants/printed_arm.py",
        "m.gravity * b2 * (theta - psi), m.gravity * b3 * (theta - phi)",
        "m.gravity * b2 * (theta + psi), m.gravity * b3 * (theta + phi)",
        "test_arm.py::test_printed_gravity_is_no_machines",
    ),
    Mutation(
        "balance: an observer that does not know the limit",
        "controllers/balance.py",
        "voltage = clamp(estimate.voltage, -self.voltage_max, self.voltage_max)",
        "voltage = estimate.voltage",
        "test_arm_control.py::test_an_observer_knows_the_limit_of_its_voltage",
    ),
    Mutation(
        "balance: an observer that predicts before its first sample",
        "controllers/balance.py",
        "jnp.where(number > 0, predicted, estimate.state)",
        "predicted",
        "test_arm_control.py::test_an_observer_starts_at_what_is_measured",
    ),
    Mutation(
        "balance: Kalman without what disturbs",
        "linear/gaussian.py",
        "dare(A.T, C.T, W, V)",
        "dare(A.T, C.T, 0.5 * W, V)",
        "test_arm_control.py::test_kalman_is_scipys",
    ),
    Mutation(
        "balance: correction of the prediction after next",
        "linear/gaussian.py",
        "jnp.linalg.solve(spread, C @ found.P).T",
        "jnp.linalg.solve(spread, C @ found.P @ A.T).T",
        "test_arm_control.py::test_regulator_and_filter_are_those_of_the_weights",
    ),
    Mutation(
        "balance: half of the bound",
        "linear/recoverable.py",
        "return 2 * limit / jnp.sqrt",
        "return limit / jnp.sqrt",
        "test_arm_control.py::test_the_bound_is_that_of_the_unstable_mode",
    ),
    Mutation(
        "balance: a grid without its upper ends",
        "design/parameter_grid.py",
        "np.linspace(low[path], high[path], points)",
        "np.linspace(low[path], high[path], points, endpoint=False)",
        "test_arm_basin.py::test_the_vertices_are_the_systems_on_the_grid",
    ),
    Mutation(
        "balance: a fall of the arm",
        "stops/stops.py",
        "return self.angle**2 - output.theta**2",
        "return self.angle**2 - output.psi**2",
        "test_arm_basin.py::test_the_slope_of_the_time_of_a_fall_is_a_difference",
    ),
    Mutation(
        "balance: upright lanes that missed their stop",
        "sweep/engines.py",
        "return np.asarray(stopped) != success",
        "return ~np.asarray(stopped)",
        "test_arm_cli.py::test_a_stop_that_is_a_fall_is_not_missed",
    ),
    Mutation(
        "balance: whatever is upright counts as recovered",
        "design/attraction.py",
        "inside.of(lanes).contain(x) & ~run.stopped & ~run.diverged",
        "~run.stopped & ~run.diverged",
        "test_arm_basin.py::test_what_is_not_known_in_time_is_undecided_and_nothing_else",
    ),
    Mutation(
        "balance: starts at the ends of an axis",
        "design/attraction.py",
        "(np.arange(self.number) + 0.5) / self.number",
        "np.arange(self.number) / (self.number - 1)",
        "test_arm_basin.py::test_a_share_is_one_by_area",
    ),
    Mutation(
        "balance: an ellipsoid as if the equations were linear",
        "design/capture.py",
        "_growth(systems, p, inverse, level) < decay",
        "np.ones(len(p), bool)",
        "test_arm_basin.py::test_in_the_ellipsoid_its_function_falls",
    ),
    Mutation(
        "balance: an ellipsoid beyond the motor's limit",
        "design/capture.py",
        "1 / reach.max(axis=1)",
        "np.full(len(p), 1e9)",
        "test_arm_basin.py::test_no_ellipsoid_where_the_loop_does_not_return",
    ),
    Mutation(
        "balance: the rider's weight left out of what is not linear",
        "plants/arm_balance.py",
        "rider = self.gravity * b3 * extent(unit[0] + unit[2]) ** 3 / 6",
        "rider = 0.0 * extent(unit[0] + unit[2])",
        "test_arm_basin.py::test_what_is_left_of_the_equations_is_within_its_bound",
    ),
    Mutation(
        "batch: who has seen enough rides on",
        "simulate/refill.py",
        "free = ~belt.carry.running | _seen_enough(enough, built, belt)",
        "free = ~belt.carry.running",
        "test_batch.py::test_a_lane_of_which_enough_is_seen_is_taken_off",
    ),
    *(Mutation(*each) for each in SWEEP),
    *(Mutation(*each) for each in KERNEL),
    Mutation(
        "lanes that one run would refuse are run",
        "simulate/refill.py",
        "jnp.where(run & (number < count), carry.condition",
        "jnp.where(number < count, carry.condition",
        "test_batch.py::TestLanes::test_that_are_not_accepted[refilled]",
    ),
    Mutation(
        "refused lanes are not told",
        "simulate/refill.py",
        "carry.condition, Condition.DIVERGED)",
        "carry.condition, Condition.TIMED_OUT)",
        "test_refusals.py::TestWhoeverRuns::test_a_batch_does_not_run_them",
    ),
    Mutation(
        "the rules of the grid are not asked of lanes",
        "simulate/refusals.py",
        "    yield _begun(loop)\n    yield from grid_rules(loop, step)",
        "    yield _begun(loop)",
        "test_refusals.py::TestBeforeARun::test_a_lane_is_refused_where_its_loop_alone_would_be[ring]",
    ),
    Mutation(
        "the rules between numbers are not asked",
        "core/pytree.py",
        '    yield from _below(part, prefix, units_of(getattr(part, "plant", None)), "rules")',
        "    yield from ()",
        "test_refusals.py::TestBeforeARun::test_a_lane_is_refused_where_its_loop_alone_would_be[limits]",
    ),
    Mutation(
        "a bound on the modes that is none",
        "simulate/stable_step.py",
        "bound = jnp.max(jnp.exp(log)",
        "bound = 0.5 * jnp.max(jnp.exp(log)",
        "test_refusals.py::TestBeforeARun::test_the_step_is_judged_as_by_the_eigenvalues",
    ),
    Mutation(
        "a start beyond the stop is a run",
        "simulate/stepper.py",
        "zero + Condition.RUNNING, zero + Condition.DIVERGED",
        "zero + Condition.RUNNING, zero + Condition.STOPPED",
        "test_refusals.py::TestAfterARun::test_a_start_beyond_the_stop_is_no_run",
    ),
    Mutation(
        "no audit of a brake",
        "simulate/outcome.py",
        'audit = getattr(loop.plant, "audit", None)',
        "audit = None",
        "test_refusals.py::TestAfterARun::test_an_unstable_step_is_seen_although_every_number_is_finite",
    ),
    Mutation(
        "metrics of whatever size",
        "simulate/outcome.py",
        "(value >= low - ROUNDING)",
        "(value >= -jnp.inf)",
        "test_refusals.py::TestAfterARun::test_a_metric_outside_its_range_is_a_run_that_diverged",
    ),
    Mutation(
        "a torque that drives is an alarm",
        "plants/audit.py",
        "_driving(-before.control, -sample.control)",
        "0.0",
        "test_refusals.py::test_what_no_braked_car_does",
    ),
    Mutation(
        "refused lanes are failures",
        "sweep/statistics/summary.py",
        "asked = view.rows & view.accepted",
        "asked = view.rows",
        "test_refusals.py::TestWhoeverRuns::test_a_refused_lane_is_a_row_with_a_reason_and_in_no_number",
    ),
    Mutation(
        "a probability over points that were not run",
        "reliability/failure.py",
        "    if len(bad):",
        "    if False:",
        "test_refusals.py::TestWhoeverRuns::test_a_probability_is_of_the_whole_space_or_none",
    ),
]


def outcome(tests: list[str], folder: pathlib.Path, limit: float | None = None) -> str:
    """What the tests do against the package in `folder`: "pass", "fail", of which the first ends it, or "take too
    long", more than the limit [s]."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(folder),
        "DIFFABS_JAX_CACHE": str(ROOT / ".jax_cache"),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    command = [sys.executable, "-m", "pytest", "-qx", "-p", "no:cacheprovider", *(f"tests/{test}" for test in tests)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, cwd=folder, env=environment, start_new_session=True, **pipes) as running:
        try:
            said, _ = running.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            return "take too long"
        finally:
            _end(running)
    if running.returncode > 1:  # neither passed nor failed: the test does not exist, or nothing could be imported
        raise SystemExit(said)
    return "fail" if running.returncode else "pass"


def _end(running: subprocess.Popen[str]) -> None:
    """End the processes that a test has started, with the test."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(running.pid, signal.SIGKILL)


def copied(folder: pathlib.Path) -> None:
    """The package, its tests, experiments, examples and pages, and a proof that it is this copy that Python finds."""
    for name in ("diffabs", "tests", "experiments", "docs", "examples"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    command = [sys.executable, "-c", "import diffabs; print(diffabs.__file__)"]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    found = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True).stdout
    if not pathlib.Path(found.strip()).is_relative_to(folder):
        raise SystemExit(f"the tests would import {found.strip()}, not the copy in {folder}")


def judged(mutation: Mutation, folder: pathlib.Path, limit: float = LIMIT_S) -> str:
    """What becomes of a mutation of the package in `folder`, which is left as it was."""
    path = folder / "diffabs" / mutation.file
    source = path.read_text()
    if source.count(mutation.old) == 0:
        return "IS OUT OF DATE: its text is not in the file"
    path.write_text(source.replace(mutation.old, mutation.new))
    try:
        found = outcome([mutation.test], folder, limit)
    finally:
        path.write_text(source)
    return {"pass": "SURVIVES", "fail": "dies", "take too long": f"dies: no end after {limit:g} s"}[found]


def main(wanted: list[str]) -> int:
    """Run the mutations whose names contain one of the words."""
    chosen = [m for m in MUTATIONS if not wanted or any(word in m.name for word in wanted)]
    bad = []
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name).resolve()
        copied(folder)
        if outcome(sorted({m.test for m in chosen}), folder) != "pass":
            raise SystemExit("a named test fails without any mutation")
        for mutation in chosen:
            verdict = judged(mutation, folder)
            bad += [] if verdict.startswith("dies") else [mutation.name]
            print(f"{mutation.name}: {verdict}", flush=True)
    print(f"{len(chosen) - len(bad)} of {len(chosen)} mutations die")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
