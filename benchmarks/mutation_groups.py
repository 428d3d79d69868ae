"""Groups of modules in which `benchmarks/mutation.py` plants faults, with the tests that speak of
them; every module is in one."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Group:
    """Modules (paths under `ssm_study`), the tests that speak of them, cheapest first, and how many
    faults to plant."""

    modules: tuple[str, ...]
    tests: str
    planted: int


def modules_of(room: str, *names: str) -> tuple[str, ...]:
    """Paths of a room's modules by their names."""
    return tuple((Path(room) / f"{name}.py").as_posix() for name in names)


def theorems(*names: str) -> tuple[str, ...]:
    """Paths of theorems by their names."""
    return modules_of("certificates/theorems", *names)


def folders(*paths: str) -> tuple[str, ...]:
    """Folders, whose every module counts, or files."""
    return paths


def tests_of(kind: str, *names: str) -> str:
    """Paths of test files by their names, for a command line."""
    return "".join(f" tests/{kind}/test_{name}.py" for name in names)


TAMPERED = "tests/refusals/test_synthesis_tampered.py"
REFUSES = f"tests/refusals/test_synthesis_refuses.py {TAMPERED}"
EXACT = "tests/oracles/test_synthesis_exact.py"
BOUNDS = "tests/oracles/test_bounds_by_hand.py tests/oracles/test_bounds_slopes.py"
BOUNDS += " tests/oracles/test_bounds_reduction.py"
LIMITS = "tests/oracles/test_synthesis_frontier.py tests/oracles/test_synthesis_costs.py"
ATTEMPTS = "tests/oracles/test_synthesis_lmi.py tests/laws/test_synthesis_attempts.py"
CONTRACTS = "tests/laws/test_synthesis_contraction.py"
CHOSEN = (
    "tests/oracles/test_loop_area.py tests/oracles/test_loop_mismatch.py "
    "tests/laws/test_auto_choice.py"
)
CHOSEN += " tests/oracles/test_loop_trials.py tests/oracles/test_controller_radius.py"
VIEWS = (
    "tests/oracles/test_loop_views.py::test_no_phase_is_read_from_noise_below_the_largest_amplitude"
)
VIEWS += " tests/oracles/test_evidence_rest.py::"
VIEWS += "test_an_output_that_stays_off_after_the_last_motion_is_a_doubt"
INVERSES = "tests/oracles/test_export_device.py::test_the_inverse_undoes_the_map"
BATCH = "tests/laws/test_loop_batch.py::test_a_batch_is_its_rows"
INSIDE = (
    "tests/oracles/test_loop_within_limits.py::test_inside_no_limit_acts_and_far_outside_one_does"
)
NEURONS = "tests/laws/test_models_structured.py tests/laws/test_synthesis_among_starts.py"
NEURONS += " tests/laws/test_training_structured.py tests/laws/test_training_structured_fit.py"
INTEGRAL = "tests/oracles/test_loop_integral.py tests/oracles/test_loop_internal.py"
LOOPS = (
    "tests/oracles/test_loop_trajectory.py tests/oracles/test_loop_settling.py "
    "tests/oracles/test_loop_trials.py"
)
LOOPS += " tests/refusals/test_loop_refused.py tests/oracles/test_loop_internal.py"
LINE = "tests/oracles/test_results_verify.py tests/oracles/test_verify_lies.py"
LINE += " tests/refusals/test_verify_damage.py tests/oracles/test_study_line.py"
LINE += " tests/oracles/test_study_answers.py"
SPOKEN_OF = "(verify or claim or tamper or truncated or refuses)"
QUICK = "tests/oracles/test_verify_judgement.py tests/oracles/test_verify_sections.py"
CLAIMS = f"{QUICK} {LINE} -k '{SPOKEN_OF} and not at_once and not without_controller'"
GROUPS = {
    "verdict": Group(
        modules=modules_of("synthesis", "design")
        + modules_of(".", "exact")
        + modules_of("certificates", "theorem", "certificate", "problem")
        + theorems("state_feedback", "observer"),
        tests=f"{REFUSES} tests/refusals/test_synthesis_verdict.py {EXACT} {BATCH} "
        "tests/oracles/test_theorem_conditions.py",
        planted=30,
    ),
    "methods": Group(
        modules=modules_of("certificates", "frontier", "riccati")
        + modules_of("synthesis", "minimum_energy", "modes", "guaranteed_cost", "lmi"),
        tests=f"{ATTEMPTS} {REFUSES} {EXACT} {LIMITS}",
        planted=70,
    ),
    "bounds": Group(modules=("bounds",), tests=f"{BOUNDS} {INVERSES} {CONTRACTS}", planted=30),
    "choice": Group(
        modules=modules_of("synthesis", "auto", "candidate_grid", "integrated_error")
        + modules_of("robustness", "mismatch", "sensitivity")
        + theorems("integral_action"),
        tests=f"{CHOSEN} {VIEWS} {INTEGRAL}",
        planted=20,
    ),
    "claims": Group(
        modules=modules_of("study", "verify", "claims", "design_claims", "findings"),
        tests=CLAIMS,
        planted=15,
    ),
    "neurons": Group(
        modules=modules_of("synthesis", "structured_lmi", "structured_riccati", "model_selection")
        + theorems("structured_state_feedback", "structured_observer", "measured_discs_structured")
        + modules_of("models", "contracting", "structured", "structured_spec")
        + modules_of("training", "levenberg", "structured_fit", "structured_start", "pruning")
        + modules_of("training", "structured_problem", "choice"),
        tests=f"{NEURONS} tests/oracles/test_synthesis_structured.py "
        "tests/oracles/test_tolerated_gain.py tests/oracles/test_theorem_conditions.py",
        planted=30,
    ),
    "loop": Group(
        modules=modules_of("loop", "controller", "trajectory", "regulation", "metrics", "rollout"),
        tests=LOOPS,
        planted=15,
    ),
    "export": Group(
        modules=modules_of("export", "device", "equilibrium_curve", "portable", "c", "targets"),
        tests="tests/oracles/test_export_parts.py "
        "tests/oracles/test_export_device.py tests/oracles/test_export_targets.py",
        planted=20,
    ),
    "engine": Group(
        modules=modules_of("engine", "store", "stages", "plan", "fingerprint", "records"),
        tests="tests/laws/test_engine_store.py tests/laws/test_engine_task.py "
        "tests/laws/test_engine_code.py",
        planted=20,
    ),
    "table": Group(
        modules=("table",),
        tests="tests/laws/test_table_words.py tests/laws/test_table_order.py "
        "tests/laws/test_table_text.py tests/laws/test_table_lines.py "
        "tests/laws/test_over_seeds.py tests/laws/test_mlflow_calls.py "
        "tests/laws/test_results_table.py tests/oracles/test_export_recording.py",
        planted=15,
    ),
    "cli": Group(
        modules=modules_of("cli", "main", "commands", "parser", "request", "hydra_errors"),
        tests="tests/laws/test_cli_options.py tests/laws/test_cli_prints.py "
        "tests/refusals/test_cli_suggestions.py "
        "tests/refusals/test_cli_sentences.py tests/laws/test_cli_terminal.py "
        "tests/refusals/test_cli_guard.py tests/refusals/test_study_requests.py "
        "tests/refusals/test_study_words.py",
        planted=10,
    ),
    "evidence": Group(
        modules=("evidence",),
        tests="tests/oracles/test_evidence_limits.py tests/oracles/test_evidence_response.py "
        "tests/oracles/test_evidence_rest.py tests/oracles/test_evidence_false_reasons.py "
        "tests/oracles/test_evidence_own_motion.py tests/oracles/test_evidence_feedback.py "
        "tests/oracles/test_evidence_integration.py "
        "tests/laws/test_evidence_controls.py -k 'not control or white or saturated or 60 or good'",
        planted=15,
    ),
    "deployed": Group(
        modules=modules_of("robustness", "return_to_rest", "prediction", "mismatch")
        + modules_of("synthesis", "deployed")
        + theorems("deployed_rate", "measured_discs", "limited_input"),
        tests="tests/oracles/test_rest_rules.py tests/oracles/test_evidence_rest.py "
        "tests/oracles/test_theorem_conditions.py tests/oracles/test_loop_mismatch.py "
        "tests/oracles/test_measured_discs.py "
        "tests/laws/test_synthesis_theorems.py tests/oracles/test_loop_prediction.py "
        "tests/oracles/test_loop_stiction.py "
        "tests/oracles/test_synthesis_deployed.py "
        f"tests/oracles/test_certificate_stored.py {INSIDE} "
        "tests/oracles/test_loop_views.py tests/oracles/test_loop_trials.py",
        planted=20,
    ),
    "coverage": Group(
        modules=modules_of("robustness", "coverage", "coverage_items", "coverage_spectra")
        + modules_of("synthesis", "measured_discs_program", "measured_discs_search")
        + modules_of("synthesis", "measured_discs_weights", "measured_discs_run")
        + theorems("measured_discs", "measured_discs_structured"),
        tests="tests/oracles/test_coverage_items.py "
        "tests/oracles/test_measured_discs.py tests/oracles/test_coverage.py "
        "tests/oracles/test_theorem_conditions.py",
        planted=20,
    ),
    "data": Group(
        modules=modules_of("data", "splits", "recorded", "experiments", "closed_loop")
        + modules_of("data", "simulated", "assembly"),
        tests="tests/oracles/test_data_cuts.py tests/oracles/test_simulated_trials.py "
        "tests/oracles/test_assembled_data.py "
        "tests/oracles/test_data_splits.py tests/oracles/test_data_choice.py "
        "tests/refusals/test_data_files.py tests/refusals/test_data_two_files.py "
        "tests/refusals/test_data_values.py "
        "tests/oracles/test_data_closed_loop.py tests/laws/test_data_sets.py "
        "tests/oracles/test_data_benchmarks.py",
        planted=20,
    ),
    "scaffolds": Group(
        modules=("models/scaffolds",),
        tests="tests/laws/test_models_scaffold_numpy.py tests/laws/test_models_scaffold_torch.py",
        planted=10,
    ),
    "plants": Group(
        modules=("plants",),
        tests="tests/oracles/test_plants_others.py tests/oracles/test_plants_wrappers.py "
        "tests/oracles/test_plants_motor_exact.py tests/refusals/test_plants_values.py",
        planted=10,
    ),
    "report": Group(
        modules=modules_of("report", "outcome", "answers"),
        tests="tests/laws/test_report_rows.py tests/laws/test_report_answer_cases.py "
        "tests/laws/test_report_answers.py tests/laws/test_report_outcome.py "
        "tests/laws/test_report_first_screen.py",
        planted=10,
    ),
    # The rest of each room, in groups of their own: a draw of the groups above stays what it was.
    "interface": Group(
        modules=modules_of("api", "arguments", "certifying", "comparing", "controlling", "design")
        + modules_of("api", "design_files", "estimator", "fitting", "known_maps", "linearisation")
        + modules_of("api", "loading", "looking", "loop_of_both", "loops", "missing_rate", "model")
        + modules_of("api", "model_files", "parts", "scope_of_proof", "scoring", "scratch")
        + modules_of("api", "simulation", "steps", "summaries", "systems"),
        tests=tests_of("laws", "own_matrices", "known_maps", "scope_of_proof", "saved_designs")
        + tests_of("laws", "gain_certificates", "estimator")
        + tests_of("oracles", "api_parts", "members")
        + tests_of("laws", "api"),
        planted=20,
    ),
    "pictures": Group(
        modules=folders("api/pictures", "report/figures", "style.py")
        + modules_of("report", "run_pictures", "figure_of_a_log", "overlay"),
        tests=tests_of("laws", "report_pictures", "report_margin")
        + tests_of("oracles", "run_pictures", "overlay")
        + tests_of("laws", "report_certificate_figures", "report_figures"),
        planted=15,
    ),
    "page": Group(
        modules=folders("report/page")
        + modules_of("report", "words", "study_folder", "run_facts", "run_record", "speed_up")
        + modules_of("report", "earlier_version"),
        tests=tests_of("laws", "report_first_screen", "report_proof_card", "report_runner_up")
        + tests_of("laws", "report_verdict", "report_rows", "report_answers", "report_live")
        + tests_of("laws", "report_pictures", "cli_prints"),
        planted=15,
    ),
    "readers": Group(
        modules=folders("data/readers")
        + modules_of("data", "arrays", "channel_names", "column_facts", "command_words", "mcap")
        + modules_of("data", "mcap_contents", "mcap_records", "missing_codes", "mixed_decimals")
        + modules_of("data", "plain_names", "recording", "text_cells", "text_encoding")
        + modules_of("data", "text_header", "text_layout", "whole_files", "written_numbers"),
        tests=tests_of("refusals", "mixed_decimals", "data_arrays", "data_values", "data_files")
        + tests_of("oracles", "data_mat", "data_mat_hdf5", "data_mcap", "data_foxglove")
        + tests_of("refusals", "data_spreadsheets", "data_every_format")
        + tests_of("oracles", "data_log_kinds", "data_variants", "data_strange_files")
        + tests_of("oracles", "data_small_logs", "data_benchmarks"),
        planted=20,
    ),
    "clocks": Group(
        modules=modules_of("data", "clock", "clock_column", "clock_restarts", "clock_wraps")
        + modules_of("data", "dates", "calendar_numbers", "rounded_times", "scattered_times"),
        tests=tests_of("oracles", "data_rounded_times", "data_clock_restarts", "data_look_times")
        + tests_of("refusals", "data_values", "data_files")
        + tests_of("oracles", "data_log_kinds", "data_variants", "data_small_logs"),
        planted=15,
    ),
    "look": Group(
        modules=modules_of("data", "look", "log_checks", "log_dynamics", "log_refusals")
        + modules_of("data", "signal_guess", "other_columns"),
        tests=tests_of("oracles", "data_look", "data_look_columns", "data_look_units")
        + tests_of("oracles", "data_look_times", "data_strange_files", "data_small_logs")
        + tests_of("oracles", "data_real_logs", "data_log_kinds"),
        planted=15,
    ),
    "excitations": Group(
        modules=folders("data/excitations", "data/metrics.py"),
        tests=tests_of("laws", "data_excitation")
        + tests_of("oracles", "simulated_trials", "data_benchmarks", "study_excitation"),
        planted=10,
    ),
    "bilinear": Group(
        modules=modules_of("certificates", "bilinear_certificates", "semidefinite")
        + theorems("bilinear_contraction", "bilinear_everywhere", "bilinear_loop")
        + modules_of("models", "bilinear", "bilinear_kernel", "bilinear_problem", "bilinear_spec")
        + modules_of("synthesis", "bilinear_design", "bilinear_gains")
        + modules_of("loop", "bilinear_feedback")
        + modules_of("api", "rest_design")
        + modules_of("export", "bilinear_c"),
        tests=tests_of("oracles", "models_bilinear", "bilinear_loop", "bilinear_python")
        + tests_of("oracles", "theorem_conditions")
        + tests_of("laws", "choice_of_products"),
        planted=20,
    ),
    "models": Group(
        modules=folders("models/baselines")
        + modules_of("models", "baseline_comparison", "best_baseline", "identified")
        + modules_of("models", "initial_system", "lazy_torch")
        + modules_of("models", "matrix_shapes", "members", "metrics", "spec", "stored")
        + modules_of("models", "structured_kernel", "torch_recurrence", "torch_scaffold")
        + modules_of("models", "torch_ssm", "warm_start"),
        tests=tests_of("laws", "models_free_run", "models_scaffold_torch", "models_structured")
        + tests_of("oracles", "models_narx", "models_n4sid", "warm_start", "members")
        + tests_of("refusals", "models_json_refused")
        + tests_of("laws", "models_recurrence", "training_windows", "models_yaml")
        + tests_of("oracles", "evidence_limits"),
        planted=20,
    ),
    "fits": Group(
        modules=modules_of("training", "candidates", "choice_of_paths", "choice_of_products")
        + modules_of("training", "choice_of_leader")
        + modules_of("training", "choice_of_regression", "choice_of_size", "fit", "folds")
        + modules_of("training", "gain_sign", "loggers", "metrics", "optimisers", "record_batch")
        + modules_of("training", "saving", "search", "short_starts", "training", "windows"),
        tests=tests_of("laws", "training_gain_sign", "choice_of_products", "choice_of_size")
        + tests_of("laws", "training_windows", "training_structured", "training_loggers")
        + tests_of("refusals", "training_refused")
        + tests_of("laws", "training_saving", "training_identify")
        + tests_of("laws", "training_choice_of_regression", "training_short_starts")
        + tests_of("laws", "training_choice", "training_choice_of_leader"),
        planted=20,
    ),
    "stages": Group(
        modules=folders("study/stages")
        + modules_of("study", "allow_list", "file_claims", "form", "line", "loop_recordings")
        + modules_of("study", "name_claims", "preload", "read_once", "recording_labels")
        + modules_of("study", "recordings", "refine", "reproduce", "rest_claims", "run_files")
        + modules_of("study", "specification", "trials", "unreached_numbers", "verify_study"),
        tests=tests_of("oracles", "verify_unreached", "verify_sections", "verify_judgement")
        + tests_of("laws", "read_once", "stage_keys")
        + tests_of("refusals", "study_words", "study_requests", "engine_strangers")
        + tests_of("oracles", "results_verify", "verify_form", "verify_omissions")
        + tests_of("oracles", "study_answers", "verify_study", "study_line"),
        planted=20,
    ),
    "jobs": Group(
        modules=modules_of("engine", "compose", "jobs", "launcher", "metrics", "program")
        + modules_of("engine", "progress", "provenance", "runs", "server", "settings", "slurm")
        + modules_of("engine", "sweep", "task"),
        tests=tests_of("laws", "engine_progress", "engine_task", "engine_runs", "engine_places")
        + tests_of("refusals", "engine_bombs", "engine_links")
        + tests_of("laws", "engine_faults", "engine_never_lost", "engine_launcher"),
        planted=15,
    ),
    "gains": Group(
        modules=modules_of("synthesis", "candidates", "coverage_slopes", "covered_gains")
        + modules_of("synthesis", "decay_response", "interior_point", "radius_optimum")
        + modules_of("synthesis", "slope_search")
        + modules_of("synthesis", "expected_response", "game_kernel", "loop_poles", "metrics")
        + modules_of("synthesis", "measured_discs_choice", "measured_discs_metric", "objectives")
        + modules_of("synthesis", "sine_judgement", "withheld_coverage")
        + modules_of("robustness", "bands", "coverage_columns", "coverage_table")
        + modules_of("robustness", "margin_by_frequency", "record_errors", "sine_trials")
        + modules_of("robustness", "single_sines")
        + modules_of("certificates", "decay_time", "stored_fields", "withdrawn_parts")
        + theorems("unlimited_start"),
        tests=tests_of("laws", "synthesis_expected_response", "gain_certificates")
        + tests_of("oracles", "theorem_conditions", "coverage_items", "rest_rules")
        + tests_of("oracles", "loop_prediction", "coverage", "measured_discs")
        + tests_of("laws", "sine_trials", "covered_gains", "synthesis_ill", "coverage_choice")
        + tests_of("oracles", "synthesis_digits", "loop_within_limits_of_two_outputs")
        + tests_of("oracles", "run_pictures", "interior_point", "coverage_slopes"),
        planted=20,
    ),
    "peers": Group(
        modules=folders("loop/peers")
        + modules_of("loop", "certified_bound", "comparison", "design_grid", "motion", "reference")
        + modules_of("loop", "rollout_log", "textbook_pi"),
        tests=tests_of("oracles", "loop_settling", "loop_bound", "textbook_pi", "loop_trajectory")
        + tests_of("refusals", "loop_refused")
        + tests_of("oracles", "loop_peers", "loop_integral", "loop_within_limits"),
        planted=15,
    ),
    "code": Group(
        modules=modules_of("export", "c_maps", "c_monitor", "c_neurons", "c_tables", "onnx")
        + modules_of("export", "set_point_maps", "set_points"),
        tests=tests_of("oracles", "export_parts", "export_monitor", "export_rates")
        + tests_of("refusals", "export_refuses")
        + tests_of("oracles", "export_device", "export_targets", "export_integrating"),
        planted=10,
    ),
    "commands": Group(
        modules=modules_of("cli", "browser", "exit_status", "from_python", "new_study", "overlay")
        + modules_of("cli", "paper_figures", "run", "summary"),
        tests=tests_of("laws", "cli_options", "cli_prints")
        + tests_of("refusals", "cli_suggestions", "cli_sentences", "study_words")
        + tests_of("laws", "cli_terminal", "extensions", "data_sets")
        + tests_of("oracles", "overlay"),
        planted=10,
    ),
    "shared": Group(
        modules=modules_of(".", "columns", "compilation", "construction", "durable", "extensions")
        + modules_of(".", "family", "old_names", "refusal", "renamed", "signals", "stored_yaml")
        + modules_of(".", "systems", "withdrawn"),
        tests=tests_of("laws", "families", "renamed", "own_matrices", "engine_store")
        + tests_of("refusals", "engine_bombs", "models_json_refused")
        + tests_of("oracles", "loop_internal", "certificate_stored", "verify_form")
        + tests_of("laws", "synthesis_theorems", "training_identify", "engine_faults")
        + tests_of("laws", "extensions"),
        planted=15,
    ),
}
