"""The line as a user runs it: one run, its files, its verification, a sweep; computed once, kept
whole."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from docs_commands import FEW
from verify_lies import edited, failing

from ssm_study.cli.main import main
from ssm_study.cli.paper_figures import PAPER_FIGURES
from ssm_study.data.mcap import read_mcap
from ssm_study.models.identified import SSM
from ssm_study.models.torch_recurrence import ModalForm, simulate_by_convolution
from ssm_study.report.figures import draw_figures
from ssm_study.study.line import undeclared_number_columns
from ssm_study.study.loop_recordings import read_rollouts
from ssm_study.study.verify import verify

pytestmark = pytest.mark.usefixtures("made_once")


CONTRACT_FILES = (
    "record.json",
    "model.json",
    "certificate.json",
    "validation.mcap",
    "closed_loop.mcap",
    ".hydra",
)


@pytest.fixture
def copied_run(smoke_run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(smoke_run, tmp_path / smoke_run.name)


def test_the_run_folder_is_the_public_one(smoke_run: Path) -> None:
    for name in CONTRACT_FILES:
        assert (smoke_run / name).exists(), name
    paths = (smoke_run / ".hydra").iterdir()
    names = {path.name for path in paths}
    assert names >= {"config.yaml", "overrides.yaml"}


def test_models_of_the_same_data_share_its_trials(smoke_run: Path) -> None:
    """The largest file of a run belongs to the stage of the data: a further model of them adds no
    copy."""
    paths = smoke_run.parents[1].rglob("trials.mcap")
    stores = {
        path.relative_to(smoke_run.parents[1] / ".store").parts[0]
        for path in paths
        if ".store" in path.parts
    }
    assert stores == {"dataset"}
    text = (smoke_run / "manifest.json").read_text()
    content = json.loads(text)
    files = content["files"]
    assert "trials.mcap" in files


def test_smoke_is_certified_and_settles(smoke_run: Path) -> None:
    text = (smoke_run / "record.json").read_text()
    record = json.loads(text)
    assert record["status"] == "ok"
    assert record["controller_certified"]
    assert record["observer_certified"]
    assert record["stable_count"] == record["initial_conditions"] == 4
    assert record["certified_bound_violations"] == 0
    assert record["resolved_margin"] > 1
    assert record["predicted_stable"] is True


def test_convolution_equals_stepwise_replay(smoke_run: Path) -> None:
    """Training simulates by convolution (torch); `model.json` steps (NumPy). The stored fit is the
    latter's."""
    text = (smoke_run / "model.json").read_text()
    content = json.loads(text)
    model = SSM.from_json(content)
    mcap = read_mcap(smoke_run / "validation.mcap")
    groups = {group.topic.removeprefix("/record_0"): group.values for group in mcap[0]}
    linear_a = model.linear.a
    eigenvalues, vectors = np.linalg.eig(linear_a.astype(complex))
    decay = torch.from_numpy(np.log(eigenvalues))
    linear_b = model.linear.b
    solution = np.linalg.solve(vectors, linear_b.astype(complex))
    b = torch.from_numpy(solution)
    linear_c = model.linear.c
    c = torch.from_numpy(linear_c @ vectors)
    linear_d = model.linear.d
    d = torch.from_numpy(linear_d)
    modes = ModalForm(decay=decay, b=b, c=c, d=d)
    u = torch.from_numpy(model.map_input(groups["/input"]))[None]
    output = simulate_by_convolution(modes, u)
    ybar = output[0].numpy()
    output_equilibrium = model.scale.output_equilibrium
    output_scale = model.scale.output_scale
    y = output_equilibrium + output_scale * model.scaffold_out(ybar)
    difference = np.abs(y - groups["/simulated"])
    largest_difference = difference.max()
    largest = np.abs(y).max()
    upper_limit = 1e-9 * largest
    assert largest_difference < upper_limit


def test_every_stored_claim_holds(smoke_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(smoke_run)]) == 0
    out = capsys.readouterr().out
    assert "FAILS" not in out


TAMPERING = {
    "k": (
        "certificate.json",
        lambda c: c["state_feedback"]["k"][0].__setitem__(0, 1.5 * c["state_feedback"]["k"][0][0]),
    ),
    "p": (
        "certificate.json",
        lambda c: c["state_feedback"]["p"][0].__setitem__(0, -c["state_feedback"]["p"][0][0]),
    ),
    "rate": ("certificate.json", lambda c: c["state_feedback"].update(rate=0.9)),
    "ball": (
        "certificate.json",
        lambda c: c["state_feedback"].update(beta=c["state_feedback"]["beta"] / 2),
    ),
    "l": (
        "certificate.json",
        lambda c: c["observer"]["l"][0].__setitem__(0, 3 + c["observer"]["l"][0][0]),
    ),
    "a": ("model.json", lambda m: m["a"][0].__setitem__(0, m["a"][0][0] * (1 + 1e-12))),
    "step": ("model.json", lambda m: m["b"][0].__setitem__(0, 2 * m["b"][0][0])),
}


@pytest.mark.parametrize("what", TAMPERING)
def test_tampering_is_found_and_named(
    what: str, copied_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, change = TAMPERING[what]
    edited(copied_run / file, change)
    assert main(["verify", str(copied_run)]) == 1
    out = capsys.readouterr().out
    lines = out.splitlines()
    failures = [line for line in lines if line.startswith("FAILS")]
    assert len(failures) > 1  # not the seal alone: the claim itself is found not to hold
    assert failures[0].startswith("FAILS  files: changed since")


def test_a_truncated_recording_is_a_failed_claim(copied_run: Path) -> None:
    path = copied_run / "closed_loop.mcap"
    path.write_bytes(path.read_bytes()[:-500])
    assert {"files", "loop"} <= failing(copied_run)


def test_verify_refuses_what_is_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(tmp_path)]) == 2
    assert "record.json" in capsys.readouterr().err


def test_the_table_has_one_typed_row(smoke_study: Path) -> None:
    table = pd.read_parquet(smoke_study / "runs.parquet")
    assert len(table) == 1
    assert table["stable_count"].dtype == "Int64"
    assert len(pd.read_csv(smoke_study / "runs.csv")) == 1


def test_the_figures_of_a_run_are_drawn(smoke_study: Path, tmp_path: Path) -> None:
    """The runs of these tests draw none: here are those of one, as vectors."""
    study = shutil.copytree(smoke_study, tmp_path / "smoke")
    shutil.rmtree(study / "figures", ignore_errors=True)
    pictures = draw_figures(PAPER_FIGURES, study)
    vectors = [path for path in pictures if path.suffix == ".pdf"]
    assert len(vectors) == len(PAPER_FIGURES)
    for path in vectors:
        assert path.read_bytes().startswith(b"%PDF")


STAGES = ("model", "synthesis")


RICCATI = ["experiment=smoke", "study=sweep", "progress=false", "synthesis=riccati"]
TINY = [*RICCATI, "training.max_epochs=2"]


def test_inputs_cut_at_limits_are_replayed(tmp_path: Path, smoke_store: Path) -> None:
    (tmp_path / ".store").symlink_to(smoke_store)
    limits = ["loop.input_lower=-0.2", "loop.input_upper=0.3"]
    assert (
        main(
            ["run", *RICCATI, *limits, "synthesis.rate_controller=0.05", f"results_dir={tmp_path}"]
        )
        == 0
    )
    paths = tmp_path.glob("sweep/*/record.json")
    (run,) = (path.parent for path in paths)
    rollouts = read_rollouts(run / "closed_loop.mcap")
    u = rollouts[0].u
    assert u.min() == -0.2
    assert u.max() == 0.3
    text = (run / "record.json").read_text()
    content = json.loads(text)
    assert content["loop__input_upper"] == 0.3
    assert [finding for finding in verify(run) if not finding.holds] == []
    config_path = run / ".hydra" / "config.yaml"
    edit_text(config_path, "input_upper: 0.3", "input_upper: 0.29")
    assert {"run", "closed_loop.mcap input", "loop__input_upper"} <= failing(run)


def test_a_setting_that_no_column_repeats_has_one_under_its_key() -> None:
    model = {"order": 4}
    plant = {"step_s": 0.01}
    synthesis = {"internal_model": ["step", "ramp"]}
    optimiser = {"_target_": "ssm_study.training.optimisers.Adam", "lr": 0.01}
    training = {"optimiser": optimiser}
    settings = {"model": model, "plant": plant, "synthesis": synthesis, "training": training}
    keys = [
        "study",
        "model.order",
        "+plant.step_s",
        "synthesis.internal_model",
        "training/optimiser",
        "a@loop.peer",
    ]
    facts = undeclared_number_columns(settings, keys)
    expected = {
        "loop__peer": None,
        "plant__step_s": 0.01,
        "synthesis__internal_model": "['step', 'ramp']",
        "training__optimiser": "adam",
    }
    assert facts == expected


def edit_text(path: Path, old: str, new: str) -> None:
    content = path.read_text()
    assert content.count(old) == 1
    path.write_text(content.replace(old, new))


def test_a_sweep_over_rates_trains_once_and_infeasible_is_a_result(tmp_path: Path) -> None:
    """Basic launcher: two rates, one of them beyond the frontier. One training, of which the sweep
    makes two designs; exit status 0."""
    rates = "synthesis.rate_controller=0.05,0.999"
    asked = ["run", "-m", *TINY, f"results_dir={tmp_path}", rates, "hydra/launcher=basic"]
    assert main(asked) == 0
    runs_path = tmp_path / "sweep" / "runs.parquet"
    table = pd.read_parquet(runs_path).sort_values("rate_controller")
    status = list(table["status"])
    assert status == ["ok", "infeasible"]
    assert table["infeasible_reason"].iloc[1].count("the slopes allow only rates below") == 1
    (refused,) = tmp_path.glob(f"sweep/{table['run'].iloc[1]}")
    assert (
        failing(refused) == set()
    )  # an observer without a controller closes no loop and claims none
    computed = {
        name: [path for path in (tmp_path / ".store" / name).iterdir() if path.is_dir()]
        for name in STAGES
    }
    expected = {"model": 1, "synthesis": 2}
    assert {name: len(found) for name, found in computed.items()} == expected
    paths = tmp_path.glob("sweep/*/record.json")
    before = {path: path.stat().st_mtime_ns for path in paths}
    assert main(asked) == 0  # nothing to do, nothing touched
    paths = tmp_path.glob("sweep/*/record.json")
    st_mtime_ns_by_path = {path: path.stat().st_mtime_ns for path in paths}
    assert st_mtime_ns_by_path == before


def test_one_failing_run_does_not_take_the_sweep_with_it(tmp_path: Path, smoke_store: Path) -> None:
    """A run whose data diverge at run time fails; the others are kept and gathered; exit status
    1."""
    (tmp_path / ".store").symlink_to(smoke_store)
    bad = "plant.solver_step_s=5e-4,1e-300"
    assert (
        main(["run", "-m", *RICCATI, f"results_dir={tmp_path}", bad, "hydra/launcher=basic"]) == 1
    )
    runs_path = tmp_path / "sweep" / "runs.parquet"
    table = pd.read_parquet(runs_path)
    status = sorted(table["status"])
    assert status == ["failed", "ok"]
    assert table["error_message"].notna().sum() == 1


def write_log(path: Path) -> np.ndarray:
    """Time, voltage and speed of a first-order motor; returns the voltage."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-2, 2, 120), 5)
    y = np.zeros(600)
    for k in range(599):
        y[k + 1] = 0.9 * y[k] + 0.1 * np.tanh(u[k])
    white_noise = rng.standard_normal(600)
    columns = np.column_stack([np.arange(600) * 0.05, u, y + 0.001 * white_noise])
    np.savetxt(path, columns, delimiter=",", header="t,volt,speed", comments="")
    return u


@pytest.mark.usefixtures("without_baselines")
def test_a_record_of_the_user_runs_the_same_line(tmp_path: Path) -> None:
    """CSV in, certified pair out; there is no plant, the loop runs on the model, and the record
    says so."""
    u = write_log(tmp_path / "log.csv")
    place = [f"results_dir={tmp_path / 'results'}", "study=mine", "progress=false"]
    columns = ["data.input=volt", "data.output=speed", "data.step_s=0.05"]
    data = ["data=recorded", f"data.path={tmp_path / 'log.csv'}", *columns]
    model = ["model=ssm", "model.order=2", "model.hidden_width=8", "training.max_epochs=8"]
    brief = [f"+synthesis.{name}={values}".replace(" ", "") for name, values in FEW.items()]
    loop = ["loop.initial_conditions=4"]
    assert main(["run", *place, *data, *model, *brief, *loop]) == 0
    mine_path = tmp_path / "results" / "mine"
    (path,) = mine_path.glob("*/record.json")
    text = path.read_text()
    record = json.loads(text)
    assert record["loop_on"] == "identified model"
    assert record["plant"] is None
    assert record["fit_test_percent"] > 90
    assert record["stable_count"] == 4
    rollouts = read_rollouts(path.parent / "closed_loop.mcap")
    log = rollouts[0].u  # within what the training part of the log visited
    smallest = u[:360].min()
    largest = u[:360].max()
    expected = (smallest, largest)
    assert (record["limit_lower"], record["limit_upper"]) == pytest.approx(expected, rel=1e-9)
    smallest = log.min()
    assert (
        record["limit_lower"] * (1 + 1e-12)
        <= smallest
        < log.max()
        <= record["limit_upper"] * (1 + 1e-12)
    )
    assert record["unlimited_from"] < 0 < record["unlimited_to"]
    assert failing(path.parent) == set()
