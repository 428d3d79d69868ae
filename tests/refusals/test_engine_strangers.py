"""A configuration or a file from a stranger runs no program: everything not named in the allow-list
is refused."""

import ast
import json
import pickle
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from ssm_study.cli.main import main
from ssm_study.cli.request import compose_request, translate_arguments
from ssm_study.engine.records import parse_record
from ssm_study.refusal import BadRequest
from ssm_study.study.allow_list import PLUGINS, is_allowed_target, refuse_foreign_targets

ROOT = Path(__file__).resolve().parents[2]
LOADERS = ("torch.load", "np.load", "numpy.load", "pd.read_pickle", "eval", "exec")
EVIL_TARGETS = [
    "os.system",
    "subprocess.run",
    "torch.load",
    "joblib.load",
    "pandas.read_pickle",
    "sympy.sympify",
    "builtins.eval",
    "pathlib.Path.write_text",
    "hydra.utils.call",
    "ssm_study.plants.dc_motor.np.save",
    "ssm_study.plants.dc_motor.dataclass",
    "ssm_study.plants.dc_motor",
    "ssm_study.engine.store.Store",
    "ssm_study.cli.main.main",
    "ssm_study.data.mcap.write_mcap",
    "ssm_study.data.recorded.Path",
    "torch.optim.Adam",
    "lightning.pytorch.loggers.TensorBoardLogger",
    "torch.optim.os.system",
    "torch.optim.adam.torch.load",
    "lightning.pytorch.callbacks.LambdaCallback",
    "lightning.pytorch.Trainer",
    "numpy.load",
    "",
    "os",
    "${x}",
    "torch.optim.Adam; os.system",
    None,
    1,
]


@pytest.mark.parametrize("target", EVIL_TARGETS)
def test_foreign_targets_are_refused_wherever_they_stand(target: object) -> None:
    assert not is_allowed_target(target)
    scaffold = {"_target_": target}
    model = {"scaffold": scaffold}
    b = [{"_target_": target}]
    a = [{"b": b}]
    evil = {"_target_": target}
    callbacks = {"c": evil}
    hydra = {"callbacks": callbacks}
    launcher = {"_target_": target}
    section = {"launcher": launcher}
    trees = ({"_target_": target}, {"model": model}, {"a": a}, {"hydra": hydra}, {"hydra": section})
    for tree in trees:
        config = OmegaConf.create({"x": "os.system", **tree})
        with pytest.raises(BadRequest, match="_target_"):
            refuse_foreign_targets(config)


OTHER_WAYS_IN = [
    "a: ${oc.env:HOME}",
    "a: '${oc.create:{_target_: os.system}}'",
    "a: '${oc.decode:\"{_target_: os.system}\"}'",
    "b: {_target_x: 1}\na: {c: '${oc.env:SECRET,none}'}",
    "{study: env, results_dir: 'L_${oc.${study}:SECRET}'}",
    "{study: oc, a: '${${study}.env:SECRET}'}",
    "{study: decode, a: '${oc.${study}:\"{_target_: os.system}\"}'}",
    "{study: create, a: ['${oc.${study}:{_target_: os.system}}']}",
    "a: '${ oc.env :SECRET}'",
    "a: '${oc.select:b,1}'",
    "hydra: {job: {name: '${oc.env:SECRET}'}}",
    "hydra: {launcher: {submitit_folder: '${oc.${study}:SECRET}'}}",
    "hydra: {job_logging: {handlers: {x: {'()': os.system}}}}",
    "hydra: {job_logging: {handlers: {x: {class: subprocess.Popen}}}}",
    "hydra: {job: {env_set: {LD_PRELOAD: evil.so}}}",
    "hydra: {sweeper: {_target_: hydra_plugins.evil}}",
]


@pytest.mark.parametrize("text", OTHER_WAYS_IN)
def test_other_ways_in_are_refused(text: str) -> None:
    with pytest.raises(BadRequest):
        refuse_foreign_targets(OmegaConf.create(text))


def test_a_plug_in_of_hydras_section_is_no_part_of_a_study() -> None:
    """Named there it is allowed; brought in by an interpolation it is a foreign class."""
    launcher = {"_target_": "hydra._internal.core_plugins.basic_launcher.BasicLauncher"}
    hydra = {"launcher": launcher}
    refuse_foreign_targets(OmegaConf.create({"hydra": hydra}))
    config = OmegaConf.create({"plant": "${hydra.launcher}", "hydra": hydra})
    with pytest.raises(BadRequest, match="_target_"):
        refuse_foreign_targets(config)


def test_everything_we_ship_is_allowed() -> None:
    targets = []
    paths = (ROOT / "conf").rglob("*.yaml")
    for path in paths:
        text = path.read_text()
        for line in text.splitlines():
            word = line.strip().removeprefix("- ")
            if word.startswith("_target_:"):
                name, *_ = word.removeprefix("_target_:").split("#")
                targets.append((path.parent, name.strip()))
    assert len(targets) > 5
    # Hydra's own section may name our plugins, nothing else may.
    plugins = ROOT / "conf" / "hydra" / "launcher"
    refused = []
    for folder, name in targets:
        is_plugin = folder == plugins and PLUGINS.fullmatch(name)
        if not (is_allowed_target(name) or is_plugin):
            refused.append(name)
    assert refused == []


EVIL_STUDY = """
defaults: [_self_]
study: x
results_dir: results
part: {_target_: pathlib.Path.touch, _args_: [{_target_: pathlib.Path, _args_: [%s]}]}
run: y
hydra:
  output_subdir: null
  run: {dir: "${results_dir}/${study}/${run}"}
  sweep: {dir: "${results_dir}/${study}", subdir: "${run}"}
  callbacks:
    evil: {_target_: pathlib.Path.touch, _args_: [{_target_: pathlib.Path, _args_: [%s]}]}
"""


def test_an_evil_configuration_is_refused_before_hydra_touches_it(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    markers = (marker, marker)
    evil_study = EVIL_STUDY % markers
    (tmp_path / "study.yaml").write_text(evil_study)
    with pytest.raises(BadRequest, match="_target_"):
        compose_request([], tmp_path, "study")
    with pytest.raises(BadRequest, match=r"hydra\.callbacks"):
        compose_request(["~part"], tmp_path, "study")
    assert not marker.exists()


def test_an_evil_experiment_given_to_the_command_does_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    marker = tmp_path / "marker"
    (tmp_path / "experiment").mkdir()
    touch = (
        f"{{_target_: pathlib.Path.touch, self: {{_target_: pathlib.Path, _args_: ['{marker}']}}}}"
    )
    evil = f"# @package _global_\nstudy: evil\nhydra:\n  callbacks:\n    evil: {touch}\n"
    evil_path = tmp_path / "experiment" / "evil.yaml"
    evil_path.write_text(evil)
    results_word = f"results_dir={tmp_path / 'results'}"
    words = ["--config-dir", str(tmp_path), "experiment=evil", results_word]
    arguments = ["run", *words]
    status = main(arguments)
    assert status == 2
    assert "may not create this class" in capsys.readouterr().err
    assert not marker.exists()


class Evil:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[object, ...]:
        arguments = (self.marker,)
        return (Path.touch, arguments)


def test_an_evil_record_is_only_corrupt(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    text = pickle.dumps(Evil(marker))
    pickle.loads(text)
    assert marker.exists(), "the trap does not work"
    marker.unlink()
    text = pickle.dumps(Evil(marker))
    record = {"sha256": 1}
    record_text = json.dumps(record)
    contents = (
        text,
        b'{"status": "ok"}',
        b"[]",
        b"",
        b"null",
        record_text.encode(),
        b"[" * 100_000,
    )
    for content in contents:
        expected = {"status": "corrupt"}
        assert parse_record(content) == expected
    assert not marker.exists()


def test_no_pickle_anywhere_and_torch_load_only_for_weights() -> None:
    """Static: no module of the package imports pickle or calls a loader that runs code."""
    offences = []
    paths = (ROOT / "ssm_study").rglob("*.py")
    for path in paths:
        text = path.read_text()
        tree = ast.parse(text)
        nodes = ast.walk(tree)
        for node in nodes:
            imports = (ast.Import, ast.ImportFrom)
            names = [alias.name for alias in node.names] if isinstance(node, imports) else []
            forbidden = {"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"}
            if forbidden & {name.split(".")[0] for name in names}:
                offences.append(f"{path.name}:{node.lineno} imports {names}")
            called = ast.unparse(node.func) if isinstance(node, ast.Call) else None
            if called in LOADERS:
                safe = "weights_only=True" in ast.unparse(
                    node
                ) or "allow_pickle=False" in ast.unparse(node)
                offences += [] if safe else [f"{path.name}:{node.lineno} {ast.unparse(node)[:60]}"]
    assert offences == []


def test_our_options_become_hydras() -> None:
    arguments = ["seed=1,2", "-m", "--retry-failed"]
    expected = ["--multirun", "seed=1,2", "retry_failed=true"]
    assert translate_arguments(arguments) == expected
    launcher = ["hydra/launcher=ray", "hydra.launcher.ray.init.address=HEAD:6399"]
    launcher += ["++hydra.launcher.ray.init.object_store_memory=null", "~hydra.launcher.partition"]
    arguments = ["-m", "seed=1,2", *launcher, "--dry-run"]
    planned = translate_arguments(arguments)
    expected = ["--multirun", "seed=1,2", "hydra/launcher=processes", "dry_run=true"]
    assert planned == expected
