"""Tables of the old names of earlier versions, each with the current name.

One table for each kind of name: modules, classes and functions, methods, settings, columns. To
rename something that strangers rely on, add a line to the table of its kind; `renamed` reads them.
"""

from collections.abc import Mapping

# Modules, below `ssm_study`. An entry of a package counts for the modules in it as well, except for
# those that have an entry of their own.
MODULES: Mapping[str, str] = {
    "certificates.exact": "exact",
    "cli.endings": "cli.summary",
    "cli.explained": "cli.hydra_errors",
    "data.readers.csv": "data.readers.text",
    "data.excitations.own_plant": "data.excitations.user_excitation",
    "data.excitations.own_signal": "data.excitations.file_signal",
    "engine.code": "engine.fingerprint",
    "engine.durable": "durable",
    "evidence.own_motion": "evidence.autonomous_motion",
    "report.style": "style",
    "study.labels": "study.recording_labels",
    "study.warm": "study.preload",
    "synthesis.among_starts": "synthesis.model_selection",
    "synthesis.area": "synthesis.integrated_error",
    "synthesis.certificate": "certificates.certificate",
    "synthesis.exact": "exact",
    "synthesis.frontier": "certificates.frontier",
    "synthesis.mismatch": "robustness.mismatch",
    "synthesis.prediction": "robustness.prediction",
    "synthesis.problem": "certificates.problem",
    "synthesis.rest": "robustness.return_to_rest",
    "synthesis.sensitivity": "robustness.sensitivity",
    "synthesis.theorem": "certificates.theorem",
    "synthesis.theorems": "certificates.theorems",
    "synthesis.theorems.guaranteed_cost": "synthesis.guaranteed_cost",
    "synthesis.theorems.minimum_energy": "synthesis.minimum_energy",
}

# Classes, functions and constants, by the module in which an import looks for them today.
NAMES: Mapping[str, str] = {
    "certificates.frontier.frontier": "certificates.frontier.contraction_frontier",
    "report.words.column_words": "report.words.printed_column_name",
    "report.words.verdicts": "report.words.verdict_words",
    "robustness.prediction.predict": "robustness.prediction.predict_margins",
    "table.rank.best_first": "table.rank.sort_best_first",
    "cli.from_python.composed": "cli.from_python.compose_configuration",
    "report.figures.draw": "report.figures.draw_figures",
    "report.figures.names": "report.figures.figure_names",
    "report.study_folder.gathered": "report.study_folder.gather_table",
    "report.words.counts": "report.words.verdict_counts",
    "report.words.scatter": "report.words.draw_verdict_points",
    "report.words.words": "report.words.printed_column_name",
    "table.columns.column": "table.columns.numeric_column",
    "table.columns.flag": "table.columns.boolean_column",
    "table.columns.label": "table.columns.column_label",
    "table.columns.text": "table.columns.text_column",
    "table.filters.where": "table.filters.filter_rows",
    "table.gather.table_of": "table.gather.table_from_records",
    "table.show.show": "table.show.show_table",
    "certificates.theorems.deployed_rate.at_largest_rate": (
        "certificates.theorems.deployed_rate.certificate_at_largest_rate"
    ),
    "robustness.sensitivity.controller_radius": (
        "robustness.sensitivity.controller_spectral_radius"
    ),
    "certificates.certificate.OfProblem": "certificates.certificate.ProblemCertificate",
    "certificates.certificate.Side": "certificates.certificate.GainTheorem",
    "bounds.frequency.largest_gains": "bounds.frequency.largest_gains",
    "bounds.gramians.balance": "bounds.gramians.balanced_realization",
    "bounds.gramians.gramian": "bounds.gramians.controllability_gramian",
    "bounds.network.inverse_of": "bounds.network.invert_map",
    "certificates.problem.dual": "certificates.problem.dual_system",
    "certificates.problem.symmetric": "certificates.problem.symmetric_part",
    "certificates.theorem.condition": "certificates.theorem.scaled_condition_number",
    "certificates.theorem.diagonal": "certificates.theorem.multiplier_matrix",
    "certificates.theorem.full": "certificates.theorem.symmetric_from_upper",
    "certificates.theorem.stacked": "certificates.theorem.assemble_blocks",
    "certificates.theorem.theorem_named": "certificates.theorem.find_theorem",
    "certificates.theorem.unit_diagonal": "certificates.theorem.scale_to_unit_diagonal",
    "engine.runs.execute": "engine.runs.execute_run",
    "synthesis.design.contraction_rate": "synthesis.design.require_contraction_rate",
    "certificates.theorem.Known": "certificates.theorem.VerificationContext",
    "data.simulated.trials": "data.simulated.simulate_mismatch_records",
    "data.splits.repeats": "data.splits.periodic_segments",
    "data.splits.returns": "data.splits.rest_segments",
    "data.readers.text.CsvReader": "data.readers.text.TextReader",
    "data.readers.reader.check_named": "data.readers.reader.check_column_names",
    "data.readers.reader.place_of": "data.readers.reader.find_column",
    "engine.stages.Kept": "engine.stages.StageOutput",
    "loop.reference.Rest": "loop.reference.EquilibriumReference",
    "models.identified.Wired": "models.identified.ScaffoldedModel",
    "models.spec.Start": "models.initial_system.InitialLinearSystem",
    "plants.plant.check_signs": "plants.plant.refuse_wrong_signs",
    "plants.plant.stated": "plants.plant.field_property",
    "refusal.at_least": "refusal.require_at_least",
    "refusal.one_of": "refusal.require_one_of",
    "refusal.positive": "refusal.require_positive",
    "robustness.mismatch.mismatch": "robustness.mismatch.measure_model_error",
    "robustness.prediction.worst": "robustness.prediction.worst_case_loop_gain",
    "robustness.sensitivity.frequency_response": "bounds.frequency.frequency_response",
    "robustness.sensitivity.gains": "bounds.frequency.largest_gains",
    "robustness.sensitivity.hinf_norm": "bounds.frequency.hinf_norm",
    "robustness.sensitivity.sizes": "robustness.sensitivity.largest_singular_values",
    "signals.fit_of_error": "signals.fit_from_relative_error",
    "signals.lagged": "signals.lagged_inputs",
    "signals.repetition": "signals.find_repetition",
    "study.preload.warm": "study.preload.preload_modules",
    "study.recordings.read_experiment": "study.loop_recordings.read_loop_recordings",
    "study.recordings.read_rollouts": "study.loop_recordings.read_rollouts",
    "style.above": "style.place_legend_above",
    "style.canvas": "style.new_figure",
    "style.paper": "style.paper_style",
    "style.save": "style.save_figure",
    "study.stages.ModelRun": "study.stages.free_run.ModelRun",
    "study.stages.Simulated": "study.stages.free_run.ModelRun",
    "study.stages.Trained": "study.stages.model.Trained",
    "study.stages.read_design": "study.stages.synthesis.read_design",
    "study.stages.read_model": "study.stages.model.read_model",
    "synthesis.candidates.Found": "synthesis.candidates.GainCandidate",
    "synthesis.deployed.as_deployed": "synthesis.deployed.add_gain_certificates",
    "synthesis.design.Request": "synthesis.design.DesignAttempt",
    "synthesis.design.broken_claims": "synthesis.design.failed_checks",
    "synthesis.integrated_error.at_rest": "models.structured.linearise_at_equilibrium",
    "synthesis.lmi.aim": "synthesis.objectives.goal_and_constraints",
    "synthesis.lmi.solved": "certificates.semidefinite.solve_program",
    "synthesis.model_selection.FastestCertified": (
        "synthesis.model_selection.LargestCertifiableRate"
    ),
    "synthesis.modes.least_metric": "certificates.riccati.least_metric",
    "synthesis.modes.solve_riccati": "certificates.riccati.solve_riccati",
    "systems.Pair": "systems.Gains",
    "systems.held": "systems.stopped_integrator_matrix",
    "systems.feed": "systems.error_input_matrix",
    "training.fit.Starts": "training.fit.InitialStates",
    "training.levenberg.damped": "training.levenberg.levenberg_marquardt_step",
    "training.saving.Keeper": "training.saving.BestModelCheckpoint",
    "training.saving.Line": "training.saving.ProgressLine",
    "training.structured_problem.descended": (
        "training.structured_problem.minimise_simulation_error"
    ),
}

# Methods by their class: a subclass that defines the old name answers to the new one, and whoever
# calls the old name reaches the new method.
METHODS: Mapping[str, Mapping[str, str]] = {
    "certificates.certificate.ProblemCertificate": {
        "numbers_of": "certificate_numbers",
        "posed": "as_problem",
        "rate_limit_of": "largest_provable_rate",
    },
    "certificates.certificate.GainTheorem": {
        "at_largest_rate": "certificate_at_largest_rate",
        "ball": "required_ball",
        "numbers_of": "certificate_numbers",
    },
    "certificates.theorem.Theorem": {
        "ball": "required_ball",
        "broken": "failed_checks",
        "given": "model_data",
        "exactly": "exact_conditions",
        "in_floats": "as_floats",
        "numbers": "variables",
        "proved": "from_numbers",
        "rate_limit_of": "largest_provable_rate",
    },
    "models.identified.ScaffoldedModel": {"lift": "map_input", "read": "output_at"},
    "models.scaffolds.scaffold.Scaffold": {
        "after": "compose_with_output_matrix",
        "before": "compose_with_input_matrix",
        "centre": "jacobian_centre",
        "portable": "as_portable",
    },
    "models.scaffolds.trainable.Trainable": {
        "explicit": "explicit_parameters",
        "frozen": "freeze",
        "start": "initial_values",
    },
    "engine.stages.Stages": {
        "aside": "unrecorded_store",
        "keyed": "stage_result",
        "measured": "stage_columns",
        "take": "run_stage",
    },
    "data.readers.reader.Reader": {"contents": "read_all_columns"},
    "data.recorded.RecordedSource": {"files": "data_files"},
    "robustness.mismatch.Mismatch": {
        "band": "scaled_settling_band",
        "seen": "largest_recorded_gain",
    },
    "synthesis.design.Synthesis": {"attempts": "solution_attempts"},
    "engine.task.Task": {
        "asked": "command_line_columns",
        "check": "build_request",
        "inputs": "input_files",
        "job": "run_job",
        "refuse": "refuse_configuration",
        "warm": "preload_modules",
    },
    "models.identified.SSM": {"with_linear": "with_linear_part"},
    "plants.plant.Plant": {"pushed_by": "disturbance_effect", "states_at": "equilibrium_states"},
    "plants.wrapper.Wrapper": {
        "applied": "applied_input",
        "fresh_memory": "initial_memory",
        "renewed": "next_memory",
    },
    "loop.controller.Controller": {
        "among": "select_cases",
        "demanded": "required_inputs",
        "start": "initial_memory",
        "targets": "reference_targets",
    },
    "loop.peers.peer.Identified": {"shown": "mismatch"},
    "api.design.Design": {"within": "within_limits"},
    "report.study_folder.RunFolder": {"comparison": "controller_comparison"},
    "report.study_folder.StudyFolder": {
        "best": "best_run",
        "comparison": "controller_comparison",
        "of_best": "read_from_best",
    },
    "robustness.prediction.Prediction": {"keeps_the_plant": "predicts_stability"},
    "engine.runs.Run": {"note": "add_columns"},
    "exact.Exact": {"of": "from_floats", "rounded": "to_floats"},
    "signals.DataSet": {"undelayed": "shift_out_dead_time"},
    "signals.Scale": {"unit": "identity"},
    "signals.Trajectory": {"joined": "concatenate"},
}

# Settings of a configuration and of a command, by their dotted path.
SETTINGS: Mapping[str, str] = {"model.integrated": "model.integrating_output"}

# Columns of the table: records and tables have both for one version.
COLUMNS: Mapping[str, str] = {}
