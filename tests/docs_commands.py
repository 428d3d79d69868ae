"""The commands that README and docs show, and the one rule by which a test makes a long one
short."""

import os
import re
import shlex
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from textwrap import dedent

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

import ssm_study.engine.settings  # noqa: F401 - the resolver of names of runs
from ssm_study.extensions import configuration_folder

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
SHELL = re.compile(r"^```(?:console|bash|sh|shell)\n(.*?)^```", re.M | re.S)
FENCED = re.compile(r"^( *)```.*?^\1```", re.M | re.S)
WRITTEN = re.compile(r'^( *)```\w+ title="([^"]+)"\n(.*?)^\1```', re.M | re.S)
OURS = r"(?:ssm-study|python|make) [^`\n]+"
INLINE = re.compile(rf"`((?:[A-Z_]+=\S+ )*{OURS})`")
INDENTED = re.compile(rf"^    ({OURS})$", re.M)

# The rule. The same command with these settings appended (or in place of its own), where its
# configuration has them;
# of every swept list the first value, so that a sweep is one run and is done as one: what starts
# the processes of a sweep takes ten seconds each time, and is the same for all. Those of SWEEPS
# stay sweeps. `experiment=smoke` is small as it is and stays whole, but for long sweeps.
SWEEPS = ("experiment=smoke", "experiment=order_by_rate")
# The sweep of seeds starts processes, as the launcher does by default; these run in this process.
IN_THIS_PROCESS = ("study=first_sweep", "experiment=order_by_rate")
# Sizes that a log would decide by training on its folds. A log decides them in
# tests/laws/test_models_yaml.py (`log`) and test_training_choice.py; here they are set.
SIZED = ("study=heater", "study=mine")
SIZES = {
    "model.order": 2,
    "model.neurons": 1,
    "model.input_path": "none",
    "model.feedthrough": "false",
    "model.dead_time": 0,
    "model.integrating_output": "false",
    "model.knots": 4,
    "model.rate": 0.999,
}
SMALL = {
    "model.starts": "1",
    "model.draws": "1",
    "data.trajectories": 2,
    "data.samples": 200,
    "data.validation_samples": 200,
    "data.test_samples": 200,
    "data.fresh_sets": 0,
    "training.max_epochs": 2,
    "loop.initial_conditions": 2,
    "loop.horizon_s": 0.3,
    "loop.comparison.designs": 2,
    "loop.comparison.spread_plants": 1,
    "loop.comparison.situations": "[nominal,delay]",
    "hydra.launcher.n_jobs": 1,
    "progress": "false",
}
# Of parts of this kind: records for the mismatch alone, and most candidates, are left out.
FEW = {
    "input_weights": [0.01, 1.0],
    "output_noises": [0.01, 1.0],
    "stretch_shares": [0.3],
    "observer_rates": [0.2],
}
FEWER = (
    ("data", ".SimulatedData", {"trials": "false"}),
    ("synthesis", ".Auto", {name: str(values).replace(" ", "") for name, values in FEW.items()}),
)
# A benchmark runs as a copy, its tables go beside the copy, with these options or this source
# instead of its own.
SMALL_OPTIONS = {
    "loop_batch.py": "--cases 3 --samples 20 --one-by-one 1",
    "synthesis_agreement.py": "--count 2",
    "synthesis_certified.py": "--count 2 --gaps 0.1 -0.01",
    "synthesis_paper_lmi.py": "--minutes 0.01",
    "synthesis_times.py": "--orders 2",
    "training_optimisers.py": "1",
}
SMALL_SOURCE = {  # pattern: what stands in its place
    "closed_loop_log.py": {
        r"^SAMPLES = .*": "SAMPLES = 1200",
        r"^SEEDS = .*": "SEEDS = 1",
        r'^    "model=ssm",': '    "model=ssm",\n    "training.max_epochs=2",',
    },
    "loop_batch.py": {r'"study=benchmark"': '"study=benchmark", "experiment=smoke"'},
    "plants_error.py": {
        r"^CASES = .*": "CASES = 1",
        r"^SAMPLES = .*": "SAMPLES = 40",
        r"^STEPS_S = .*": "STEPS_S = (5e-4, 2.5e-4)",
    },
    "plants_mcap.py": {r"^SAMPLES = .*": "SAMPLES = 500", r"^ROUNDS = .*": "ROUNDS = 1"},
    "plants_simulation.py": {
        r"^CASES = .*": "CASES = 2",
        r"^SAMPLES = .*": "SAMPLES = 40",
        r"^PART = .*": "PART = 20",
        r"^ROUNDS = .*": "ROUNDS = 1",
    },
    "synthesis_bounds.py": {r"^COUNT = .*": "COUNT = 1", r"^STARTS = .*": "STARTS = 1"},
    "synthesis_maps.py": {
        r"^FLOORS = .*": "FLOORS = (0.1, 0.5)",
        r"^RATES = .*": "RATES = (0.05, 0.3)",
        r"for share in \(.*\)": "for share in (0.5,)",
    },
    "synthesis_paper_lmi.py": {
        r"^COUNT = .*": "COUNT = 3",
        r"^BLOCK = .*": "BLOCK = 3",
        r'"paper_lmi.csv"$': '"paper_lmi_again.csv"',  # the committed one has every model
    },
    "synthesis_times.py": {r"^REPETITIONS = .*": "REPETITIONS = {}"},
    "synthesis_trained.py": {r"^MOST = .*": "MOST = 1"},
    "training_optimisers.py": {r"^EPOCHS = .*": 'EPOCHS = {"lbfgs": 1, "adam": 1}'},
}
# Take seconds as they are; of a benchmark named nowhere here `--help` is asked.
AS_IT_IS = {"loop_margin.py", "plants_choice.py", "plants_scores.py", "synthesis_figures.py"}
ELSEWHERE = {  # what a test cannot have, or has already, by name
    "verify results/smoke/RUN": "every claim of this run: tests/oracles/test_results_verify.py",
    "results_gather.py --runs": "twenty thousand runs; its table is committed",
    "report STUDY": "`report results/paper` runs; the figures' names are looked up",
    "-m benchmarks.coverage_by_seed": "a minute a line; its tables are committed",
    "exchanger.csv": "a public record that is not part of the project: docs/data.md",
    "experiment=tclab": "runs where its package is installed: tests/laws/test_extensions.py",
    "ssm-study new": "made, run and judged in tests/laws/test_extensions.py",
    "ssm-study excite": "run in tests/laws/test_data_own_plant.py",
    "hydra/launcher=slurm": "needs a Slurm cluster",
    "hydra/launcher=ray": "needs a Ray cluster",
    "-m benchmarks.adversarial": "ten seconds a line; its table is committed",
    "benchmarks/structured_plants.py": "minutes; its tables are committed",
    "synthesis_structured.py": "a second a model; its table is committed",
    "-m benchmarks.feedback_shares": "half a minute; its table is committed",
    "-m benchmarks.own_motion": "minutes; its tables are committed",
    "-m benchmarks.excited_log": "ten seconds a line; its table is committed",
    "-m benchmarks.nonlinear_plants": "half a minute a line; its table is committed",
    "-m benchmarks.structured_loops": "half a minute a line; its table is committed",
    "benchmarks/public_logs.py": "public records that are not part of the project",
    "ssm-study overlay": "run in tests/oracles/test_overlay.py on runs of one record",
    "ssm-study watch": "serves until it is stopped; tests/laws/test_report_live.py asks it",
}


def commands(page: Path) -> Iterator[str]:
    """Every command of the page: in a shell block, in an indented line of its own, in a code
    span."""
    text = page.read_text()
    for block in SHELL.findall(text):
        for line in block.replace("\\\n", " ").splitlines():
            command = re.sub(r"\s+#.*$", "", line.strip().removeprefix("$ "))
            if command and not command.startswith("#"):
                yield " ".join(command.split())
    text = FENCED.sub("", text)
    inline = INLINE.findall(text)
    indented = INDENTED.findall(text)
    yield from (" ".join(found.split()) for found in inline + indented)


# One figure of any study. `test_report_figures` draws every figure that there is: here its name is
# looked up.
ONE_FIGURE = re.compile(r"ssm-study report STUDY --only (\w+)")


@cache
def every_command() -> dict[str, str]:
    """Command: the first page that shows it."""
    return {
        command: page.name for page in reversed(PAGES) for command in reversed([*commands(page)])
    }


def files_to_write(page: Path) -> dict[str, str]:
    """Files that the reader is told to write: blocks with a path as their title."""
    written = WRITTEN.findall(page.read_text())
    return {path: dedent(text) for _, path, text in written}


def maker(study: str) -> str | None:
    """The documented command that makes this study, or what `make study` runs."""
    text = (ROOT / "Makefile").read_text()
    made = re.findall(r"^\t\$\(BIN\)/(ssm-study run .+)$", text, re.M)
    runs = [
        command for command in [*every_command(), *made] if command.startswith("ssm-study run ")
    ]
    runs = [
        command
        for command in runs
        if not any(word in command.replace("--with ", "") for word in [*ELSEWHERE, "--"])
    ]
    named = [command for command in runs if f"study={study}" in command.split()]
    return next(
        iter(
            named + [c for c in runs if f"experiment={study}" in c.split() and " study=" not in c]
        ),
        None,
    )


def small(arguments: list[str], written: Path | None = None) -> list[str]:
    """The arguments of `ssm-study run` by the rule above; `written` holds configuration of the
    reader's own."""
    if {"--help", "--cfg"} & set(arguments):
        return arguments
    if set(IN_THIS_PROCESS) & set(arguments) and "--dry-run" not in arguments:
        arguments = [*arguments, "hydra/launcher=basic"]
    words = [word if word.startswith("-") else first_value(word) for word in arguments]
    if not set(SWEEPS) & set(arguments):
        words = [word for word in words if word != "-m"]
    if "experiment=smoke" in arguments:
        is_long = sum(word.count(",") for word in arguments) > 2
        return words if is_long else arguments
    if not any(word.startswith(("study=", "experiment=")) for word in words):
        words.append("study=unnamed")  # not into the paper's, of which other pages speak
    config = composed(
        [*words, *([] if written is None else [f"hydra.searchpath=[file://{written}]"])]
    )
    given = {word.split("=")[0] for word in words}
    sweeper = config.hydra.sweeper
    omega_conf = OmegaConf.to_container(sweeper)
    swept = omega_conf.get("params") or {}  # type: ignore[union-attr]
    words += [first_value(f"{key}={values}") for key, values in swept.items() if key not in given]
    config = composed(words) if swept else config
    replaced = {key: value for key, value in SMALL.items() if has(config, key)}
    if isinstance(OmegaConf.select(config, "model.neurons"), int):
        replaced["model.neurons"] = 1
    if any(word.startswith(SIZED) for word in words):
        replaced |= SIZES
    if has(
        config, "data.benchmark"
    ):  # the launcher's processes may be older than this test's environment
        replaced["data.folder"] = f"{os.environ['SSM_STUDY_DATA']}/{config.data.benchmark}"
    for part, kind, fewer in FEWER:
        if str(config[part]._target_).endswith(kind):
            replaced |= {f"+{part}.{name}": value for name, value in fewer.items()}
    return [word for word in words if word.split("=")[0] not in replaced] + [
        f"{k}={v}" for k, v in replaced.items()
    ]


def has(config: DictConfig, key: str) -> bool:
    parent, _, name = key.rpartition(".")
    node = OmegaConf.select(config, parent) if parent else config
    return isinstance(node, DictConfig) and name in node


def composed(words: list[str]) -> DictConfig:
    """The configuration of the first job, nothing run: unknown groups, options and values do not
    compose."""
    words = [first_value(word) for word in words if not word.startswith("-")]
    with initialize_config_dir(str(configuration_folder()), version_base="1.3"):
        config = compose("study", words, return_hydra_config=True)
    assert isinstance(config, DictConfig)
    return config


def first_value(word: str) -> str:
    overrides_parser = OverridesParser.create()
    override = overrides_parser.parse_override(word)
    if not override.is_sweep_override():
        return word
    key = override.input_line.split("=")[0]
    if override.is_interval_sweep():
        return f"{key}={override.value().start}"
    return f"{key}={next(iter(override.sweep_string_iterator()))}"


def small_copy(script: Path, to: Path) -> None:
    """The benchmark, shortened; a pattern that it no longer has is an error of the table above."""
    text = script.read_text()
    small_source = SMALL_SOURCE.get(script.name, {})
    for pattern, instead in small_source.items():
        text, found = re.subn(pattern, instead, text, flags=re.M)
        assert found == 1, f"{script.name}: {pattern} stands {found} times in it"
    to.write_text(text)


def small_benchmark(words: list[str]) -> list[str]:
    """`benchmarks/x.py [act] ...` with the options that shorten it in place of its own; `--help`
    where nothing does."""
    name = Path(words[0]).name
    if name not in AS_IT_IS | {key.split()[0] for key in [*SMALL_OPTIONS, *SMALL_SOURCE]}:
        return [words[0], "--help"]
    small_options = SMALL_OPTIONS.get(name, "")
    options = SMALL_OPTIONS.get(f"{name} {words[1]}" if words[1:] else name, small_options)
    flags = {word for word in options.split() if word.startswith("--")}
    return [*without(words, flags), *shlex.split(options)]


def without(words: list[str], flags: set[str]) -> list[str]:
    kept = []
    dropping = False
    for word in words:
        dropping = word in flags or (dropping and not word.startswith("--"))
        kept += [] if dropping else [word]
    return kept


def place(folder: Path) -> None:
    """A clone as far as the commands need one: benchmarks, the committed tables, the configuration,
    a log."""
    folder.mkdir(parents=True)
    (folder / "benchmarks").mkdir()
    for script in (ROOT / "benchmarks").glob("*.py"):
        small_copy(script, folder / "benchmarks" / script.name)
    reference_path = ROOT / "results" / "reference"
    shutil.copytree(reference_path, folder / "results" / "reference")
    for name in ("conf", "tests", "experiments", "Makefile", "benchmarks/rehearsal"):
        (folder / name).symlink_to(ROOT / name)
