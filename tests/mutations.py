"""Does every test that should fail, fail? Breaks a copy of the package in one place at a time and runs the tests named.

    python tests/mutations.py [part of a name ...]

Exit status 1 if a mutation survives, if its text is no longer in the file, or if a named test fails without it. Not
collected by pytest; run it weekly, and when a test is added: add a line to MUTATIONS (of
sweeps: in mutations_sweep.py).
"""

import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
from typing import NamedTuple

from mutations_sweep import SWEEP

ROOT = pathlib.Path(__file__).resolve().parent.parent


class Mutation(NamedTuple):
    """In diffabs/`file`, `old` becomes `new`; `test` (file::name, or file::name[case]) must then fail."""

    name: str
    file: str
    old: str
    new: str
    test: str


MUTATIONS = [
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
        "test_checkpoints.py::test_three_levels_reverse_forward_and_differences_agree",
    ),
    Mutation(
        "a scan that keeps every carry",
        "simulate/rk4.py",
        "SLOTS = 1800",
        "SLOTS = 10**9",
        "test_checkpoints.py::test_memory_of_reverse_mode_hardly_grows_with_the_number_of_steps",
    ),
    Mutation(
        "nested scans that make too few steps",
        "simulate/checkpoint.py",
        "[math.ceil(count / inner), inner]",
        "[count // inner, inner]",
        "test_checkpoints.py::test_nested_scans_make_enough_steps_and_keep_few_carries[1801]",
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
        "jnp.exp(exponent * jnp.log(jnp.where(positive, base, 1.0)))",
        "jnp.exp(exponent * jnp.log(base))",
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
        "return mu, quotient(self.weight_torque + torque, arm), torque",
        "return mu, self.weight_torque / arm, torque",
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
        "(excess > self.band)",
        "(excess > 0)",
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
        "a latch that is never late",
        "references/peak_slip.py",
        "jnp.where(higher, (1 - place) * clock.h, 0.0)",
        "0.0 * place",
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
        "(new.greatest > self.arming) & ",
        "",
        "test_blocks.py::test_robust_latch",
    ),
    Mutation(
        "a delay that forgets the running segment",
        "actuators/delay.py",
        "line(first, part, 1.0) + line(second, 0.0, part)",
        "line(first, 0.0, 1.0)",
        "test_blocks.py::test_delay_shifts_a_ramp",
    ),
    Mutation(
        "noise drawn off its period",
        "sensors/noise.py",
        "jnp.where(clock.k % n == 0, a, b), drawn",
        "jnp.where(clock.k % n == 1, a, b), drawn",
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
        "IAE without abs",
        "objectives/tracking.py",
        "jnp.abs(whole))",
        "whole)",
        "test_conformance.py::test_errors_count_on_either_side[iae]",
    ),
    Mutation(
        "a peak before the first sample",
        "objectives/tracking.py",
        "(last > earlier) & (last > slip)",
        "(last >= earlier) & (last > slip)",
        "test_rollout.py::test_the_peak_of_a_falling_slip_is_its_first_value",
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
        "a stop on the grid",
        "simulate/hybrid_step.py",
        "jnp.where(search, clamp(carry.length + late, 0.0, h), carry.length)",
        "jnp.where(search, h, carry.length)",
        "test_rollout.py::test_speed_reached_lands_between_samples",
    ),
    Mutation(
        "a landing without derivative",
        "simulate/hybrid_step.py",
        "flow, tally = axpy(moved, rates,",
        "flow, tally = axpy(jax.lax.stop_gradient(moved), rates,",
        "test_gradients.py::test_gradient_of_every_objective_in_every_parameter[feedback]",
    ),
    Mutation(
        "an event that moves nothing",
        "simulate/hybrid_step.py",
        "axpy(event.elapsed, axpy(-1.0, old, new), z)",
        "axpy(0.0 * event.elapsed, axpy(-1.0, old, new), z)",
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
        "simulate/hybrid_step.py",
        "running=(ahead & (k < steps)) | search",
        "running=ahead | search",
        "test_rollout.py::test_a_run_that_does_not_stop_is_charged_the_rest",
    ),
    Mutation(
        "a diverged lane with metrics",
        "simulate/hybrid_step.py",
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
        "stuck = smaller(asked, capacity)",
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
        "test_design.py::test_four_vertices_agree_with_the_programme_by_hand",
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
        "step = -centre.solved(hessian, by_problem)",
        "step = centre.solved(hessian, by_problem)",
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
        "command line: dotted and nested kept apart",
        "scenario/parameter_paths.py",
        '            pending[:0] = [(f"{path}.{key}", item) for key, item in value.items()]\n            continue',
        "            found[path] = value\n            continue",
        "test_scenario.py::test_ranges_are_the_same_however_they_are_written",
    ),
    Mutation(
        "command line: km/h unscaled",
        "scenario/section_design.py",
        "return low / entry.scale, high / entry.scale",
        "return low, high",
        "test_scenario.py::test_slip_lmi_is_the_papers_example",
    ),
    Mutation(
        "command line: inverted allowed",
        "scenario/section_design.py",
        "    if low > high:",
        "    if False:",
        "test_scenario_errors.py",
    ),
    Mutation(
        "command line: range of parameter not looked at",
        "scenario/section_design.py",
        "    if not spec.holds(np.array([low, high])):",
        "    if False:",
        "test_scenario_errors.py",
    ),
    Mutation(
        "command line: dump forgets design",
        "scenario/scenario.py",
        "scenario.design.table(), scenario.tune.table()",
        "{}, scenario.tune.table()",
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
        "                if as_json:\n                    show.as_json(proof.document(task, reason=str(error)))\n",
        "",
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
        "scenario.design.table(), scenario.tune.table()",
        "scenario.design.table(), {}",
        "test_scenario.py::test_packaged_scenario_survives_dump_and_load",
    ),
    Mutation(
        "command line: free ranges in km/h unscaled",
        "scenario/section_tune.py",
        "return _divided(low, entry.scale), _divided(high, entry.scale)",
        "return low, high",
        "test_scenario.py::test_what_is_tuned_is_the_same_however_it_is_written",
    ),
    Mutation(
        "command line: the scenario is written as it was",
        "cli/tune.py",
        "after = dataclasses.replace(chosen, loop=found.loop)",
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
        "    if not isinstance(controller, ProportionalFeedback):",
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
        "tune: lanes of groups out of order",
        "simulate/batch.py",
        "jnp.concatenate(x)[order]",
        "jnp.concatenate(x)",
        "test_tuning.py::test_lanes_in_groups_are_the_lanes_together",
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
        "jnp.abs(sample.control - last) / jnp.where(whole, h, 1.0)",
        "jnp.abs(sample.control - last)",
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
        "jnp.where(clock.k > 0, predicted, estimate.state)",
        "predicted",
        "test_arm_control.py::test_an_observer_starts_at_what_is_measured",
    ),
    Mutation(
        "balance: Kalman without what disturbs",
        "linear/gaussian.py",
        "jnp.asarray(C).T, W, V)",
        "jnp.asarray(C).T, 0.5 * W, V)",
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
        "balance: a fall that rises",
        "stops/stops.py",
        "return -2 * output.theta * output.theta_rate",
        "return 2 * output.theta * output.theta_rate",
        "test_arm_basin.py::test_the_slope_of_the_time_of_a_fall_is_a_difference",
    ),
    Mutation(
        "balance: upright lanes that missed their stop",
        "sweep/engines.py",
        'return np.zeros(np.shape(stopped), bool) if "fell" in names else ~np.asarray(stopped)',
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
        "conveyor: who has seen enough rides on",
        "simulate/refill.py",
        "free = ~carry.running | early(belt.number, belt.leaves, carry)",
        "free = ~carry.running",
        "test_conveyor.py::test_a_lane_of_which_enough_is_seen_is_taken_off",
    ),
    *(Mutation(*each) for each in SWEEP),
    Mutation(
        "lanes that one run would refuse are run",
        "simulate/refill.py",
        "running = carry.running & run & (number < count)",
        "running = carry.running & (number < count)",
        "test_refusals.py::TestWhoeverRuns::test_a_batch_does_not_run_them",
    ),
    Mutation(
        "refused lanes are not told",
        "simulate/refill.py",
        "carry.diverged | ~run",
        "carry.diverged",
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
        '    yield from _below(part, prefix, "rules")',
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
        "simulate/hybrid_step.py",
        "zero, running, no, ~running), h.dtype)",
        "zero, running, no, no), h.dtype)",
        "test_refusals.py::TestAfterARun::test_a_start_beyond_the_stop_is_no_run",
    ),
    Mutation(
        "no audit of a brake",
        "simulate/run.py",
        'audit = getattr(loop.plant, "audit", None)',
        "audit = None",
        "test_refusals.py::TestAfterARun::test_an_unstable_step_is_seen_although_every_number_is_finite",
    ),
    Mutation(
        "metrics of whatever size",
        "simulate/run.py",
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


def passes(tests: list[str], folder: pathlib.Path) -> bool:
    """Whether the tests pass against the package in `folder`. Stops at the first failure."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(folder),
        "DIFFABS_JAX_CACHE": str(ROOT / ".jax_cache"),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    command = [sys.executable, "-m", "pytest", "-qx", "-p", "no:cacheprovider", *(f"tests/{test}" for test in tests)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode > 1:  # neither passed nor failed: the test does not exist, or nothing could be imported
        raise SystemExit(done.stdout + done.stderr)
    return done.returncode == 0


def copied(folder: pathlib.Path) -> None:
    """The package, its tests, experiments and pages, and a proof that it is this copy that Python finds."""
    for name in ("diffabs", "tests", "experiments", "docs"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    command = [sys.executable, "-c", "import diffabs; print(diffabs.__file__)"]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    found = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True).stdout
    if not pathlib.Path(found.strip()).is_relative_to(folder):
        raise SystemExit(f"the tests would import {found.strip()}, not the copy in {folder}")


def main(wanted: list[str]) -> int:
    """Run the mutations whose names contain one of the words."""
    chosen = [m for m in MUTATIONS if not wanted or any(word in m.name for word in wanted)]
    bad = []
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name).resolve()
        copied(folder)
        if not passes(sorted({m.test for m in chosen}), folder):
            raise SystemExit("a named test fails without any mutation")
        for mutation in chosen:
            path = folder / "diffabs" / mutation.file
            source = path.read_text()
            if source.count(mutation.old) == 0:
                verdict = "IS OUT OF DATE: its text is not in the file"
            else:
                path.write_text(source.replace(mutation.old, mutation.new))
                verdict = "SURVIVES" if passes([mutation.test], folder) else "dies"
                path.write_text(source)
            bad += [mutation.name] if verdict != "dies" else []
            print(f"{mutation.name}: {verdict}", flush=True)
    print(f"{len(chosen) - len(bad)} of {len(chosen)} mutations die")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
