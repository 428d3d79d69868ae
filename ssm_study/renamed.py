"""Names of earlier versions, and what each is called today.

Old names are understood where files and arguments are read: in stored configurations, in the words
of a command, in `import` lines of other people's code, in the methods that their classes override.
Nowhere else: the package itself uses today's names alone. An old name is read for one version, and
a warning says so once.

To rename something that strangers rely on, add a line to the table of its kind. To withdraw a
setting or a choice, add it to `WITHDRAWN_...` with the version and the remedy (withdrawn columns
and
theorems: `columns` and `certificates`); a test demands that every entry
leads somewhere, and that no withdrawn name is still there. This module imports nothing of the
science: `import ssm_study` installs it before anything else is imported.
"""

import importlib
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from ssm_study.refusal import BadRequest

OURS = "ssm_study"
CHANGELOG = "CHANGELOG.md, version 0.2.0"


class OldName(FutureWarning):
    """Warning about a name of an earlier version, which still works for one version."""


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
    "synthesis.commanded": "synthesis.input_inversion",
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
    "models.spec.Start": "models.spec.Initialisation",
    "plants.plant.check_signs": "plants.plant.refuse_wrong_signs",
    "plants.plant.stated": "plants.plant.field_property",
    "refusal.at_least": "refusal.require_at_least",
    "refusal.one_of": "refusal.require_one_of",
    "refusal.positive": "refusal.require_positive",
    "robustness.mismatch.mismatch": "robustness.mismatch.measure_mismatch",
    "robustness.prediction.worst": "robustness.prediction.robustness_measure",
    "robustness.sensitivity.frequency_response": "bounds.frequency.frequency_response",
    "robustness.sensitivity.gains": "bounds.frequency.largest_gains",
    "robustness.sensitivity.hinf_norm": "bounds.frequency.hinf_norm",
    "robustness.sensitivity.sizes": "robustness.sensitivity.largest_singular_values",
    "signals.fit_of_error": "signals.fit_from_relative_error",
    "signals.lagged": "signals.lagged_inputs",
    "signals.repetition": "signals.find_repetition",
    "study.preload.warm": "study.preload.preload_modules",
    "study.recordings.read_experiment": "study.loop_recordings.read_experiment",
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
    "systems.held": "systems.frozen_modes",
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
    "certificates.certificate.Side": {
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
    "engine.task.Task": {
        "asked": "command_line_columns",
        "inputs": "input_files",
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
    },
    "loop.peers.peer.Identified": {"shown": "mismatch"},
    "api.design.Design": {"within": "within_limits"},
    "report.study_folder.StudyFolder": {"best": "best_run", "of_best": "read_from_best"},
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


@dataclass(frozen=True, kw_only=True)
class Withdrawn:
    """Description of a removed setting or class: the version that removed it, and what to use
    instead. `neutral` is a value of a setting that changed nothing; a stored configuration with it
    is read without it."""

    since: str
    remedy: str
    neutral: Any = None

    @property
    def sentence(self) -> str:
        """Text that names the version in which the setting or class was removed."""
        return f"withdrawn in {self.since}"


# Settings by their dotted path, in which `*` stands for any part.
WITHDRAWN_SETTINGS: Mapping[str, Withdrawn] = {
    "training.hankel_weight": Withdrawn(
        since="0.2", remedy="leave it out; reduction=balanced removes redundant states", neutral=0.0
    ),
    "training.windows.washout": Withdrawn(
        since="0.2", remedy="leave it out; windows are multiple shooting", neutral=0
    ),
    "training.windows.stride": Withdrawn(
        since="0.2", remedy="leave it out; windows follow each other", neutral=None
    ),
}

# Choices as a command writes them, `model=dynonet`; of a list every member counts.
WITHDRAWN_CHOICES: Mapping[str, Withdrawn] = {
    "model=dynonet": Withdrawn(since="0.2", remedy="use model=gru, lstm, narx or structured"),
    "model=deep_ssm": Withdrawn(since="0.2", remedy="use model=structured"),
}

_OF_THE_SENSOR = Withdrawn(
    since="0.2",
    remedy="the sensor's noise is loop.measurement_noise_variance and loop.noise_factor now; "
    "a converter is a wrapper of your own (docs/howto_plant.md)",
)
# Classes of `_target_`, below `ssm_study`, that there are no more.
WITHDRAWN_TARGETS: Mapping[str, Withdrawn] = {
    "plants.sensor.QuantisedOutput": _OF_THE_SENSOR,
    "plants.sensor.NoisyOutput": _OF_THE_SENSOR,
    "plants.wrapper.QuantisedOutput": _OF_THE_SENSOR,
    "plants.wrapper.Disturbed": Withdrawn(
        since="0.2", remedy="disturbances are loop.disturbance now"
    ),
}

# Parts of `certificate.json` by the name of their theorem: read past, and not checked.
WITHDRAWN_THEOREMS: Mapping[str, Withdrawn] = {
    "noise_gain": Withdrawn(
        since="0.2", remedy="read the column noise_gain_model, which is no claim"
    ),
    "tolerance": Withdrawn(since="0.2", remedy="run again: measured_discs proves the same gain"),
    "structured_tolerance": Withdrawn(
        since="0.2", remedy="run again: measured_discs_structured proves the same gain"
    ),
}

# Columns that records of an earlier version hold: not checked.
WITHDRAWN_COLUMNS: Mapping[str, Withdrawn] = {
    "noise_gain": Withdrawn(since="0.2", remedy="read noise_gain_model, which is no claim"),
    "certified_tolerance_resolved": Withdrawn(since="0.2", remedy="read certified_tolerance"),
}


# Names


@cache
def current_module(module: str) -> str:
    """Current dotted name of a module that may be imported under an old name."""
    inner = module.removeprefix(f"{OURS}.")
    if inner == module:
        return module
    words = inner.split(".")
    for count in range(len(words), 0, -1):
        old = ".".join(words[:count])
        if old in MODULES:
            return ".".join([OURS, MODULES[old], *words[count:]])
    return module


def current_symbol(module: str, name: str) -> tuple[str, str]:
    """Current module and name of a symbol that may be imported under an old name."""
    as_module = current_module(f"{module}.{name}")
    dotted = as_module.removeprefix(f"{OURS}.")
    dotted = NAMES.get(dotted, dotted)
    present = f"{OURS}.{dotted}" if module.split(".")[0] == OURS else f"{module}.{name}"
    holder, _, last = present.rpartition(".")
    return holder, last


def current_target(target: Any) -> Any:
    """Current dotted name of the class that a `_target_` names; a value that is no text is returned
    unchanged."""
    if not isinstance(target, str) or not target.startswith(f"{OURS}."):
        return target
    module, _, name = target.rpartition(".")
    return ".".join(current_symbol(module, name))


def withdrawn_target(target: Any) -> Withdrawn | None:
    """Notice for a `_target_` class that was removed; None for any other class."""
    return WITHDRAWN_TARGETS.get(str(target).removeprefix(f"{OURS}."))


def warn_of_old_name(old: str, new: str) -> None:
    """Warn once that a name is out of date, and give the current one."""
    if old not in _WARNED:
        _WARNED.add(old)
        message = f"{old} is now {new}; the old name is read in version 0.2 alone."
        warnings.warn(message, OldName, stacklevel=3)


_WARNED: set[str] = set()


# Settings


def current_settings(tree: Any, path: str = "") -> Any:
    """Settings of an earlier version, with every old name replaced by the current one.

    Raises `BadRequest` for a withdrawn setting whose value is not the neutral one.
    """
    if isinstance(tree, list):
        return [current_settings(value, f"{path}[]") for value in tree]
    if not isinstance(tree, dict):
        return tree
    present: dict[Any, Any] = {}
    for key, value in tree.items():
        place = f"{path}.{key}".lstrip(".")
        withdrawn = withdrawn_setting(place)
        if withdrawn is not None:
            refuse_withdrawn(place, value, withdrawn)
            continue
        name = SETTINGS.get(place, place).rpartition(".")[2]
        is_target = key == "_target_"
        present[name] = current_target(value) if is_target else current_settings(value, place)
    return type(tree)(present)


def rename_old_settings(config: Any) -> None:
    """Replace the old names in a composed or stored configuration by the current ones, in place.

    Raises `BadRequest` as `current_settings` does.
    """
    from omegaconf import OmegaConf, open_dict

    tree = OmegaConf.to_container(config, resolve=False)
    assert isinstance(tree, dict)
    hydra = tree.pop("hydra", None)
    del hydra  # its own section, whose targets are its own
    present = current_settings(tree)
    with open_dict(config):
        for key in tree:
            if key not in present:
                del config[key]
        for key, value in present.items():
            if key not in tree or value != tree[key]:
                config[key] = value


def withdrawn_setting(path: str) -> Withdrawn | None:
    """Notice for a removed setting, given by its dotted path; None for any other setting."""
    words = path.split(".")
    for pattern, withdrawn in WITHDRAWN_SETTINGS.items():
        parts = pattern.split(".")
        alike = [part in ("*", word) for part, word in zip(parts, words, strict=False)]
        if len(parts) == len(words) and all(alike):
            return withdrawn
    return None


def refuse_withdrawn(path: str, value: Any, withdrawn: Withdrawn) -> None:
    """Raise `BadRequest` for a removed setting, unless its value had no effect."""
    if value != withdrawn.neutral:
        problem = f"was {withdrawn.sentence} ({CHANGELOG})"
        raise BadRequest(path, value, problem, withdrawn.remedy)


def current_override(word: str) -> str:
    """Command-line override such as `model.integrated=true`, with its old name replaced by the
    current one.

    Raises `BadRequest` with the line of the changelog for what was withdrawn.
    """
    key, equals, value = word.partition("=")
    path = key.lstrip("+~")
    marks = key.removesuffix(path)
    withdrawn = withdrawn_setting(path)
    if withdrawn is not None and equals:
        refuse_withdrawn(path, value, withdrawn)
        return ""
    for choice in value.strip("[]").split(",") if equals else ():
        gone = WITHDRAWN_CHOICES.get(f"{path}={choice.strip()}")
        if gone is not None:
            problem = f"was {gone.sentence} ({CHANGELOG})"
            raise BadRequest(path, choice.strip(), problem, gone.remedy)
    if path in SETTINGS:
        warn_of_old_name(path, SETTINGS[path])
        return f"{marks}{SETTINGS[path]}{equals}{value}"
    return f"{key}={current_target(value)}" if path.endswith("_target_") else word


def current_overrides(words: Sequence[str]) -> list[str]:
    """Command-line overrides with old names replaced by current ones, and without overrides that
    have no effect any more."""
    present = [current_override(word) for word in words]
    return [word for word in present if word]


# Columns


def add_renamed_columns(record: Mapping[str, Any]) -> dict[str, Any]:
    """Copy of a record in which every renamed column appears under both its old and its new
    name."""
    both = dict(record)
    for old, new in COLUMNS.items():
        if new in record:
            both.setdefault(old, record[new])
        elif old in record:
            both[new] = record[old]
    return both


# Imports


class OldModules(MetaPathFinder):
    """Import hook that redirects imports of renamed modules and makes renamed functions available
    under their old names."""

    def find_spec(
        self, fullname: str, path: Any = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Module specification for an import under an old name, or of a module with renamed
        contents; None for any other."""
        del target
        if not fullname.startswith(f"{OURS}."):
            return None
        present = current_module(fullname)
        if present != fullname:
            return ModuleSpec(fullname, Alias(present), is_package=True)
        inner = fullname.removeprefix(f"{OURS}.")
        if inner not in _modules_with_renames():
            return None
        spec = _find_with_other_finders(fullname, path)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def exec_module(module: ModuleType) -> None:
                """Run the module's code, then add the old names to it."""
                execute(module)
                _restore_old_names(module, inner)

            spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def _find_with_other_finders(fullname: str, path: Any) -> ModuleSpec | None:
    """Module specification that the other import hooks find for a module name."""
    for finder in sys.meta_path:
        if not isinstance(finder, OldModules):
            spec = finder.find_spec(fullname, path)
            if spec is not None:
                return spec
    return None


class Alias(Loader):
    """Module loader that gives the module of the new name when an old name is imported."""

    def __init__(self, present: str) -> None:
        self.present = present

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Module of the new name, which takes the place of the old one."""
        del spec
        return None

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing, as the module of the new name is already loaded."""
        warn_of_old_name(module.__name__, self.present)
        # The import takes what stands in sys.modules afterwards.
        sys.modules[module.__name__] = importlib.import_module(self.present)


@cache
def _modules_with_renames() -> frozenset[str]:
    """Names of all modules that contain a renamed class, function or method."""
    return frozenset(name.rpartition(".")[0] for name in (*NAMES, *METHODS))


def _restore_old_names(module: ModuleType, inner: str) -> None:
    """Make the functions, classes and methods of a newly imported module available under their old
    names."""
    holder = f"{inner}."
    old_names = {
        old.removeprefix(holder): new
        for old, new in NAMES.items()
        if old.rpartition(".")[0] == inner
    }

    def find_renamed_object(name: str) -> Any:
        """Object of the module that an old name stands for; a warning is issued."""
        if name not in old_names:
            raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")
        warn_of_old_name(f"{module.__name__}.{name}", f"{OURS}.{old_names[name]}")
        place, _, present = old_names[name].rpartition(".")
        return getattr(importlib.import_module(f"{OURS}.{place}"), present)

    if old_names:
        vars(module).setdefault("__getattr__", find_renamed_object)
    for dotted, methods in METHODS.items():
        place, _, name = dotted.rpartition(".")
        if place == inner:
            support_old_methods(getattr(module, name), methods)


def support_old_methods(base: type, methods: Mapping[str, str]) -> None:
    """Make renamed methods of a class and of its subclasses usable under their old names, for calls
    and for overriding."""
    add_method_aliases(base, methods)
    for kind in _subclasses(base):
        add_method_aliases(kind, methods)
    defined = vars(base).get("__init_subclass__")

    def redirect_renamed_overrides(cls: type, **options: Any) -> None:
        """Let a method of a new subclass override the renamed method if it has the old name."""
        add_method_aliases(cls, methods)
        if defined is None:
            super(base, cls).__init_subclass__(**options)  # type: ignore[arg-type]
        else:
            function: Callable[..., None] = defined.__func__
            function(cls, **options)

    base.__init_subclass__ = classmethod(redirect_renamed_overrides)  # type: ignore[assignment]


def add_method_aliases(kind: type, methods: Mapping[str, str]) -> None:
    """Give each renamed method that a class defines its other name, too."""
    for old, new in methods.items():
        defined = vars(kind)
        if old in defined and new not in defined:
            warn_of_old_name(f"{kind.__name__}.{old}", f"{kind.__name__}.{new}")
            setattr(kind, new, defined[old])
        elif new in defined and old not in defined:
            setattr(kind, old, defined[new])


def _subclasses(base: type) -> Iterator[type]:
    """All direct and indirect subclasses of a class."""
    subclasses: list[type] = base.__subclasses__()
    for kind in subclasses:
        yield kind
        yield from _subclasses(kind)


def install_import_hook() -> None:
    """Install the import hook that makes old module names importable."""
    if not any(isinstance(finder, OldModules) for finder in sys.meta_path):
        sys.meta_path.insert(0, OldModules())
    for (
        inner
    ) in _modules_with_renames():  # imported before this, by whatever imports the package in parts
        with suppress(KeyError):
            _restore_old_names(sys.modules[f"{OURS}.{inner}"], inner)
