"""`verify` against consistent lies: all is sealed anew, what depends on the lie agrees with it."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from docs_commands import FEW
from verify_lies import (
    altered,
    failing,
    in_thousands,
    invented,
    lie_about_band,
    lie_about_configuration,
    lie_about_evidence,
    lie_about_excitation,
    lie_about_labels,
    lie_about_limits,
    lie_about_loop,
    lie_about_model,
    lie_about_observer,
    lie_about_record,
    lie_about_reference,
    lie_about_start,
    lie_about_starts,
    lie_about_trial,
    lie_beside,
    lie_twice,
    sealed_anew,
    sooner,
    without,
)

from ssm_study.cli.main import main
from ssm_study.data.mcap import read_mcap
from ssm_study.data.recorded import RecordedData
from ssm_study.durable import (
    add_digest,
    read_json_with_digest,
    sha256_of_file,
    write_json_atomically,
)
from ssm_study.engine.records import read_record
from ssm_study.plants.wrapper import PlantWrapper
from ssm_study.refusal import BadRequest
from ssm_study.study.claims import check_loops as section_loop
from ssm_study.study.claims import check_records as section_data
from ssm_study.study.findings import CheckedClaim, UncheckedValues
from ssm_study.study.run_files import RunFiles
from ssm_study.study.verify import compare_column, judge_column, verify
from ssm_study.table.gather import MARKS, gather

ONE_FORMULA = 1e-9  # written out again, as in test_results_verify
ITERATED = 1e-6

pytestmark = pytest.mark.usefixtures("made_once")

MODEL_LOOP = "closed_loop_model.mcap"
Lie = Callable[[Path], object]


def about(tell: Callable[..., object], *words: Any, **columns: Any) -> Lie:
    """The lie that is told with these words and columns."""
    return lambda run: tell(run, *words, **columns)


def about_settings(old: str, new: str, **columns: Any) -> Lie:
    """A lie about a line of the configuration."""
    return about(lie_about_configuration, old, new, **columns)


# Each: a consistent lie about one thing, sealed anew, and a claim that has to name it.
LIES: dict[str, tuple[Lie, str]] = {}
LOOP = "closed_loop.mcap"
LIES["infeasible, with 4 of 4 settled"] = (about(sealed_anew, status="infeasible"), "status")
LIES["sampling time of the model"] = (about(lie_about_model, step_s=0.02), "model.json step_s")
LIES["true output at rest sooner"] = (about(lie_about_loop, "/output"), LOOP)
LIES["slower without control"] = (about(lie_about_loop, "/case_0/uncontrolled"), LOOP)
LIES["smaller inputs"] = (about(lie_about_loop, "/input"), "closed_loop.mcap input")
LIES["estimate"] = (about(lie_about_loop, "/estimate"), LOOP)
LIES["states"] = (about(lie_about_loop, "/case_1/states"), LOOP)
LIES["a reference of the second case"] = (lie_about_reference, "loop")
LIES["the loop on the model"] = (about(lie_about_loop, "/states", MODEL_LOOP), MODEL_LOOP)
LIES["wider settling band"] = (lie_about_band, LOOP)

LABELS = {name: f"{name} labels" for name in (MODEL_LOOP, "test.mcap", LOOP, "excitation.mcap")}
LIES["twice as fast"] = (about(lie_about_labels, MODEL_LOOP, sooner), LABELS[MODEL_LOOP])
LIES["another unit"] = (about(lie_about_labels, "test.mcap", in_thousands), LABELS["test.mcap"])
LIES["another plant"] = (about(lie_about_labels, LOOP, plant="Rig"), LABELS[LOOP])
NOTE = about(lie_about_labels, "excitation.mcap", on="the machine")
LIES["a note"] = (NOTE, LABELS["excitation.mcap"])

LIES["a rate said twice"] = (lie_twice, "certificate")
LIES["a key of the model said twice"] = (about(lie_twice, "model.json", '"step_s":'), "model")
LIES["a word in the model"] = (about(lie_about_model, quality="high"), "model.json entries")
LIES["a rate beside the certificate"] = (lie_beside, "certificate.json entries")
LIES["an empty column"] = (about(sealed_anew, quality=None), "quality")
VALIDATION = about(lie_about_record, "validation.mcap")
LIES["validation record"] = (VALIDATION, "validation.mcap records")
LIES["test record"] = (about(lie_about_record, "test.mcap"), "test.mcap records")
LIES["excitation"] = (lie_about_excitation, "excitation.mcap")

OBSERVER = "certificate.observer"
MARGIN = about(lie_about_observer, {"observer_margin": 0.5}, margin=0.5)
LIES["margin"] = (MARGIN, OBSERVER)
LIES["condition"] = (about(lie_about_observer, {}, condition=1.0), OBSERVER)
LIES["method"] = (about(lie_about_observer, {}, method="lmi"), OBSERVER)
LIES["limits of another loop"] = (lie_about_limits, "certificate limits")
LIES["starts that do not rest"] = (lie_about_starts, "certificate starts")
LIES["no certificate, claims kept"] = (about(without, "certificate.json"), "certificate.json")
LIES["no closed loop, claims kept"] = (about(without, LOOP), LOOP)
LIES["a trial"] = (lie_about_trial, "trials.mcap records")
LIES["evidence"] = (lie_about_evidence, "evidence.json")
LIES["a comparison that nobody made"] = (about(invented, seal=True), "comparison.csv")
LIES["no configuration"] = (about(without, ".hydra/config.yaml"), ".hydra/config.yaml")
LIES["seed"] = (about_settings("seed: 0\nloop", "seed: 1\nloop", seed=1), "run")
LIES["order"] = (about_settings("order: 4", "order: 6", order=6), "run")
LIES["noise"] = (about_settings("noise_factor: 1.0", "noise_factor: 0.1"), LOOP)


@pytest.mark.parametrize("lie", LIES)
def test_a_consistent_lie_is_named(lie: str, copied_run: Path) -> None:
    tell, claim = LIES[lie]
    tell(copied_run)
    missed = failing(copied_run)
    assert "files" not in missed  # the seals are in order
    assert any(name.startswith(claim) for name in missed)


def test_a_copy_of_a_run_in_its_study_is_named_and_one_saved_elsewhere_is_not(
    copied_run: Path,
) -> None:
    """It would be one more row of the table."""
    copy = shutil.copytree(copied_run, copied_run.with_name("copy"))
    assert failing(copied_run) == set()
    assert failing(copy) == {"folder"}
    shutil.rmtree(copied_run)
    assert failing(copy) == set()
    gather(copy.parent)
    assert failing(copy) == {"folder"}


@pytest.mark.parametrize("command", ["gather", "show"])
def test_the_command_gathers_anew_whatever_table_lies_there(
    copied_run: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """A table with another number, sealed as a true one is."""
    study = copied_run.parent
    true = gather(study)
    true.assign(fit_test_percent=99.9).to_parquet(study / "runs.parquet", index=False)
    content = (study / MARKS).read_bytes()
    index = read_json_with_digest(content) or {}
    sums = {"runs.parquet": sha256_of_file(study / "runs.parquet")}
    body = {k: v for k, v in index.items() if k != "sha256"} | sums
    write_json_atomically(study / MARKS, add_digest(body))
    fit_test_percent = gather(study)["fit_test_percent"]
    item = fit_test_percent.item()
    assert item == 99.9
    assert main([command, str(study)]) == 0
    out = capsys.readouterr().out
    assert "99.9" not in out
    pd.testing.assert_frame_equal(gather(study), true)


def test_a_run_of_somebodys_parts_is_refused_with_the_option_that_trusts_them(
    copied_run: Path,
) -> None:
    """Without them nothing can be derived, which is no lie of the run."""
    lie_about_configuration(
        copied_run, "ssm_study.plants.dc_motor.DCMotor", "somebodys.plants.DCMotor"
    )
    with pytest.raises(BadRequest, match=r"somebodys.*--with FOLDER"):
        verify(copied_run)


def test_without_its_log_a_run_claims_no_prediction() -> None:
    """The level of evidence that it rests on cannot be derived: `sound` might be anybody's word."""

    class Elsewhere:
        specification = SimpleNamespace(plant=None)
        record = dict[str, Any]()  # noqa: RUF012
        missing_log_reason = cached_property(RunFiles.missing_log_reason.func)

        @property
        def data(self) -> Any:
            raise BadRequest("data.path", "log.csv", "no such file", "check the spelling")

    (found,) = section_data(Elsewhere())  # type: ignore[arg-type]
    assert isinstance(found, UncheckedValues)
    told = {"predicted_stable": True}
    assert "cannot be read" in judge_column("predicted_stable", told, told, found.reasons)  # type: ignore[operator]
    checked = compare_column("predicted_stable", True, True)
    assert checked.holds


@pytest.mark.parametrize("place", ["where the run was made", "where the command is given"])
def test_a_log_is_found_from_another_folder(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`data.path=log.csv` was meant where the run was made; a run that was moved has its log where
    one works."""
    made = tmp_path / "made"
    elsewhere = tmp_path / "elsewhere"
    run = made / "results" / "mine" / "order2"
    (run / ".hydra").mkdir(parents=True)
    config_path = run / ".hydra" / "config.yaml"
    config_path.write_text("results_dir: results\nstudy: mine\nrun: order2\n")
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    rng = np.random.default_rng(0)
    u = rng.standard_normal(200)
    log = (made if "was made" in place else elsewhere) / "log.csv"
    y = np.cumsum(u)
    table = pd.DataFrame({"u": u, "y": y})
    table.to_csv(log, index=False)
    source = RecordedData(path="log.csv", input="u", output="y", step_s=0.1)
    files = RunFiles(path=run, record={})
    vars(files)["specification"] = SimpleNamespace(plant=None, seed=0, refine=None, data=source)
    training = files.data.training
    validation = files.data.validation
    test = files.data.test
    assert sum(map(len, (*training, *validation, *test))) == 200
    assert Path.cwd() == elsewhere


class Rig(PlantWrapper):
    """A device, for `verify` alone."""

    is_physical = True  # type: ignore[assignment]


def test_of_a_device_the_loop_on_the_model_is_made_again(copied_run: Path) -> None:
    """Its violations of the certified bound are a claim on the model, whatever the loop was closed
    on."""

    def found() -> tuple[set[str], dict[str, str]]:
        record = read_record(copied_run) or {}
        run = RunFiles(path=copied_run, record=record)
        rig_plant = run.specification.plant
        plant = Rig(plant=rig_plant)
        vars(run)["specification"] = replace(run.specification, plant=plant)
        told = list(section_loop(run))
        wrong = {one.claim for one in told if isinstance(one, CheckedClaim) and not one.holds}
        return wrong, {
            name: why
            for one in told
            if isinstance(one, UncheckedValues)
            for name, why in one.reasons.items()
        }

    recorded_on = "closed_loop.mcap loop_on"  # here the plant that was simulated
    expected = (
        {recorded_on},
        {"closed_loop.mcap output, states": "recorded on a device, which is not run again"},
    )
    assert found() == expected
    lie_about_loop(copied_run, "/states", MODEL_LOOP)
    expected = {recorded_on, MODEL_LOOP}
    assert found()[0] == expected


def logged(folder: Path) -> list[str]:
    """The words for a log of a system that answers its input at once."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-3, 3, 60).repeat(5)
    x = np.zeros(len(u) + 1)
    for k in range(len(u)):
        x[k + 1] = 0.9 * x[k] + 0.2 * np.tanh(u[k])
    y = x[:-1] + 0.1 * u
    table = pd.DataFrame({"u": u, "y": y})
    table.to_csv(folder / "log.csv", index=False)
    return [
        "data=recorded",
        f"data.path={folder}/log.csv",
        "data.input=u",
        "data.output=y",
        "data.step_s=0.1",
    ]


def test_a_run_without_controller_has_no_certificate_and_no_loop(
    copied_run: Path, tmp_path: Path, smoke_store: Path
) -> None:
    """Invented beside an infeasible run or a baseline, they would be drawn as its own."""
    (tmp_path / ".store").symlink_to(smoke_store)
    beyond = ["experiment=smoke", "synthesis=riccati", "synthesis.rate_controller=0.999"]
    baseline = [*logged(tmp_path), "model=gru", "training.max_epochs=1"]
    for study, asked in {"none": beyond, "baseline": baseline}.items():
        assert (
            main(["run", *asked, "progress=false", f"results_dir={tmp_path}", f"study={study}"])
            == 0
        )
        paths = (tmp_path / study).glob("*/record.json")
        (run,) = (path.parent for path in paths)
        assert failing(run) == set()
        model = (read_record(run) or {})["model"]
        expected = {"none": "ssm", "baseline": "gru"}[study]
        assert model == expected
        for name in ("certificate.json", "closed_loop.mcap")[study == "none" :]:
            shutil.copy(copied_run / name, run / name)
        sealed_anew(run)
        expected = {"certificate.json", "closed_loop.mcap"} - {
            "certificate.json" * (study == "none")
        }
        assert failing(run) == expected


@pytest.mark.usefixtures("without_baselines")
def test_a_model_that_answers_at_once_is_certified_without_a_loop(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`verify` missed its loops, the outcome spoke of starts, and where every neuron was idle the
    run had failed."""
    log = [*logged(tmp_path), "progress=false", f"results_dir={tmp_path}"]
    shape = [
        "model.feedthrough=true",
        "model.order=2",
        "model.starts=1",
        "model.draws=2",
        "training.max_epochs=3",
    ]
    few = FEW.items()
    shape += [f"+synthesis.{name}={values}".replace(" ", "") for name, values in few]
    neurons = ["model.input_path=free", "model.output_path=free"]
    for study, path in {"idle": [], "neurons": neurons}.items():
        assert (
            main(["run", *log, *shape, *path, f"study={study}", f"model.neurons={len(path)}"]) == 0
        )
        out = capsys.readouterr().out
        text = " ".join(out.split())
        assert "certified, not tried: both certificates hold" in text
        paths = (tmp_path / study).glob("*/record.json")
        (run,) = (path.parent for path in paths)
        text = (run / "model.json").read_text()
        content = json.loads(text)
        assert ("neurons" in content) == (study == "neurons")
        assert failing(run) == set()
    lie_about_start(run)
    missed = failing(run)
    print(missed)
    assert missed >= {"test.mcap start", "validation.mcap start"}


def test_sealing_anew_alone_is_no_lie(copied_run: Path) -> None:
    sealed_anew(copied_run)
    assert failing(copied_run) == set()


@pytest.mark.parametrize(
    ("file", "topic", "claim", "tolerance"),
    [
        ("validation.mcap", "/simulated", "validation.mcap /simulated", ONE_FORMULA),
        ("test.mcap", "/simulated", "test.mcap /simulated", ONE_FORMULA),
        ("closed_loop.mcap", "/case_0/input", "closed_loop.mcap input", ITERATED),
    ],
)
def test_one_sample_of_a_recording_is_named_beyond_its_tolerance_and_not_within(
    file: str, topic: str, claim: str, tolerance: float, smoke_run: Path, tmp_path: Path
) -> None:
    groups, _ = read_mcap(smoke_run / file)
    name = topic.rpartition("/")[2]
    largest = max(
        float(np.abs(group.values).max()) for group in groups if group.topic.endswith(f"/{name}")
    )
    for share in (0.9, 1.1):
        run = shutil.copytree(smoke_run, tmp_path / f"run{share}")

        def change(values: np.ndarray, by: float = share * tolerance * largest) -> None:
            values[-1, 0] += by

        altered(run, file, topic, change)
        missed = failing(run)
        assert "files" in missed
        assert (claim in missed) is (share > 1)
