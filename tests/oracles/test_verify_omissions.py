"""`verify` against a run from which something was taken out, to which something was added, or which
was called by another name; all seals are in order."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from mcap.writer import Writer
from verify_lies import edited, failing, sealed_anew

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.withdrawn_parts import TOLERANCE
from ssm_study.cli.main import main
from ssm_study.data.mcap import METADATA_NAME, read_mcap
from ssm_study.data.mcap_contents import list_unread_contents
from ssm_study.durable import add_digest, write_json_atomically
from ssm_study.engine.records import read_record, write_record
from ssm_study.engine.runs import write_run_manifest
from ssm_study.engine.settings import plain_settings, run_name
from ssm_study.report.outcome import coverage_rows, prediction_rows
from ssm_study.study.claims import split_confirmable_settings
from ssm_study.study.design_claims import NOT_SEARCHED_AGAIN, check_internal_model
from ssm_study.study.findings import UnconfirmableSettings
from ssm_study.study.name_claims import expected_name_part
from ssm_study.study.run_files import RunFiles
from ssm_study.study.verify import verify
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.measured_discs_run import UNPROVED

pytestmark = pytest.mark.usefixtures("made_once")

TAKEN_OUT = ("coverage", "coverage_reason", "predicted_faster", "sine_margin", "swings_at_rest")


def sealed_without(run: Path, version: int, *names: str, **columns: Any) -> dict[str, Any]:
    """Seal a record of another version from which columns were taken out."""
    record = (read_record(run) or {}) | columns
    body = {name: value for name, value in record.items() if name not in names}
    body |= {"record_version": version}
    write_json_atomically(run / "record.json", add_digest(body))
    return body


def test_columns_that_were_taken_out_are_named_and_of_an_older_record_listed(
    copied_run: Path,
) -> None:
    record = read_record(copied_run) or {}
    stated = {name for name in TAKEN_OUT if record.get(name) is not None}
    assert stated >= {"predicted_faster", "sine_margin", "swings_at_rest"}
    sealed_without(copied_run, 3, *TAKEN_OUT)
    assert failing(copied_run) >= stated
    columns = ("coverage", "coverage_reason", "predicted_faster", "sine_margin")
    sealed_without(copied_run, 2, *columns)
    verification = verify(copied_run)
    reason = "a record of version 2 need not have it"
    listed = {name for name, why in verification.unchecked.items() if why == reason}
    assert listed >= {"predicted_faster", "sine_margin"}
    assert reason in verification.summary()


def test_a_failed_coverage_is_not_retold_as_no_proof(copied_run: Path) -> None:
    """The reason is derived: the words of another reason are compared, too."""
    record = read_record(copied_run) or {}
    stated = record.get("coverage_reason")
    assert (record.get("coverage") is None) != (stated is None)
    claims = {"coverage": None, "coverage_reference": None, "coverage_needed": None}
    other = UNPROVED if stated != UNPROVED else "nobody looked"
    sealed_anew(copied_run, **claims, coverage_reason=other)
    assert "coverage_reason" in failing(copied_run)


def test_a_proof_that_was_taken_out_is_listed_as_not_checked(copied_run: Path) -> None:
    """It claims less than it could: no lie, but said."""
    assert f"certificate.{TOLERANCE}" not in verify(copied_run).unchecked
    edited(copied_run / "certificate.json", lambda parts: parts.pop(TOLERANCE))
    sealed_anew(copied_run, certified_tolerance=None)
    verification = verify(copied_run)
    assert verification.holds
    assert verification.unchecked[f"certificate.{TOLERANCE}"] == NOT_SEARCHED_AGAIN


def test_the_outcome_of_an_older_record_says_what_it_does_not_state() -> None:
    record = {"record_version": 2, "status": "ok", "evidence": "sound", "loop_on": "plant"}
    rows = [*coverage_rows(record), *prediction_rows(record)]
    unstated = {label for _, label, text in rows if text.startswith("not stated")}
    assert unstated == {"Model error covered", "Single sines"}
    rows = [*coverage_rows(record | {"record_version": 3})]
    assert not [text for _, _, text in rows if text.startswith("not stated")]


def renamed_copy(run: Path, old: str, new: str) -> Path:
    name = run.name.replace(old, new)
    copy = shutil.copytree(run, run.with_name(name))
    path = copy / ".hydra" / "config.yaml"
    text = path.read_text()
    path.write_text(text.replace(run.name, name))
    write_run_manifest(copy)
    write_record(copy, (read_record(copy) or {}) | {"run": name})
    return copy


def test_a_run_that_is_called_by_another_seed_is_named(
    copied_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = renamed_copy(copied_run, "seed0", "seed7")
    assert failing(copy) == {"run"}
    assert main(["gather", str(copy.parent)]) == 0
    assert "same settings stand under several names" in capsys.readouterr().out
    assert main(["show", str(copy.parent)]) == 0
    assert "same settings stand under several" in " ".join(capsys.readouterr().out.split())


def test_a_name_shows_the_settings_that_it_names() -> None:
    settings = {"seed": 3, "loop_seed": 7, "model": {"order": 4, "hidden_width": 8}}
    assert expected_name_part("seed3", settings) == "seed3"
    assert expected_name_part("seed7", settings) == "seed3"
    assert expected_name_part("width9", settings) == "width8"
    settings["plant"] = {"width": 0.01}
    assert expected_name_part("width8", settings) == "width8", "the plant's width is another"
    for words in ("mine", "trial2", "v1.2"):
        assert expected_name_part(words, settings) == words
    assert run_name(plain_settings(settings), "seed:seed").startswith("seed3-")  # type: ignore[arg-type]


def test_runs_of_a_sweep_that_are_missing_are_counted(
    copied_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = copied_run.parent
    words = ["experiment=smoke", "model.order=2,4,6", "plant=dc_motor,two_mass"]
    text = json.dumps({"hydra": {"overrides": {"task": words}}})  # JSON is YAML
    (study / "multirun.yaml").write_text(text)
    assert main(["show", str(study)]) == 0
    assert "2 of 3 runs of the sweep are missing" in " ".join(capsys.readouterr().out.split())
    (study / "multirun.yaml").write_text(text.replace("2,4,6", "4"))
    assert main(["show", str(study)]) == 0
    assert "missing" not in capsys.readouterr().out


def with_contents(path: Path) -> None:
    """Append an attachment, a metadata record, and a topic of texts to a copy of a recording."""
    groups, about = read_mcap(path)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata(METADATA_NAME, about)
        writer.add_metadata("proof", {"seen": "on hardware"})
        writer.add_attachment(0, 0, "protocol.txt", "text/plain", b"all starts settled")
        schema = writer.register_schema("json", "jsonschema", b"{}")
        texts = writer.register_channel("/protocol", "json", schema)
        writer.add_message(texts, 0, json.dumps({"text": "settled"}).encode(), 0)
        topics: dict[str, Any] = {}
        for group in groups:
            topics[group.topic] = writer.register_channel(group.topic, "json", schema)
            for time_s, row in zip(group.time_s, group.values, strict=True):
                names = [channel.name for channel in group.channels]
                message = json.dumps(dict(zip(names, row.tolist(), strict=True))).encode()
                writer.add_message(topics[group.topic], round(time_s * 1e9), message, 0)
        extra = writer.register_channel("/case_0/plant_measured", "json", schema)
        writer.add_message(extra, 0, b'{"speed": 1.0}', 0)
        writer.finish()


def test_what_no_run_writes_into_a_recording_is_named(copied_run: Path) -> None:
    path = copied_run / "closed_loop_model.mcap"
    assert list_unread_contents(path) == []
    with_contents(path)
    expected = ["attachment protocol.txt", "metadata proof", "topic /protocol"]
    assert list_unread_contents(path) == expected
    sealed_anew(copied_run)
    (finding,) = [one for one in verify(copied_run) if one.claim == f"{path.name} contents"]
    assert not finding.holds
    for words in (*expected, "topic /case_0/plant_measured"):
        assert words in finding.found


def test_a_page_or_a_text_beside_the_run_is_named_and_its_logs_are_not(copied_run: Path) -> None:
    """Logs and checkpoints may stand beside a run, and an export in a folder of its own."""
    beside = ("run.log", "traceback.txt", "figure.png", ".hidden", "last.ckpt", "csv/metrics.csv")
    exported = ("controller/controller.h", "controller/controller.json", "controller/usage.py")
    for name in (*beside, *exported):
        (copied_run / name).parent.mkdir(exist_ok=True)
        (copied_run / name).write_text("0")
    assert failing(copied_run) == set()
    for name in ("proof.txt", "report.html", "notes/proof.md"):
        (copied_run / name).parent.mkdir(exist_ok=True)
        (copied_run / name).write_text("all starts settled on hardware")
    assert failing(copied_run) == {"proof.txt", "report.html", "notes/proof.md"}


def test_settings_that_no_result_supports_do_not_count_as_held(smoke_run: Path) -> None:
    columns = {"training__max_epochs": 9, "synthesis__margin": 1.2, "seed": 0}
    apart = {}
    for item in split_confirmable_settings(columns):
        if isinstance(item, UnconfirmableSettings):
            apart |= item.columns
    assert set(apart) == {"training__max_epochs", "synthesis__margin"}
    verification = verify(smoke_run)
    assert "rates_chosen" in verification.unchecked
    assert not [finding for finding in verification if finding.claim == "rates_chosen"]
    assert any("training" in name for name in verification.unchecked)


def test_an_edited_table_is_not_what_the_page_is_made_of(copied_run: Path) -> None:
    from ssm_study.report.study_folder import StudyFolder
    from ssm_study.table.gather import gather

    study = copied_run.parent
    true = gather(study)
    true.assign(fit_test_percent=99.9).to_parquet(study / "runs.parquet", index=False)
    table = StudyFolder(folder=study).table
    assert table["fit_test_percent"].item() == true["fit_test_percent"].item() != 99.9


def test_a_folder_that_cannot_be_written_to_is_shown(
    copied_run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A full disk can be looked at; only what has to write there is refused."""

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ssm_study.table.gather._write_table", refuse)
    assert main(["show", str(copied_run.parent)]) == 0
    assert "1 run: 1 ok" in capsys.readouterr().out
    assert main(["gather", str(copied_run.parent)]) == 2


def test_record_versions(smoke_run: Path) -> None:
    """An older record may lack a column that it does not have; one that has it is held to it."""
    old = RunFiles(path=smoke_run, record={"record_version": 2, "sine_margin": 1.0})
    assert old.may_lack_columns("predicted_faster")
    assert not old.may_lack_columns("sine_margin")
    assert not RunFiles(path=smoke_run, record={"record_version": 3}).may_lack_columns(
        "sine_margin"
    )


def test_the_internal_model_is_the_one_that_was_requested(smoke_run: Path) -> None:
    run = RunFiles(path=smoke_run, record=read_record(smoke_run) or {})
    balls = certified_balls(run.model)
    requested = ("step",)
    rates = {"rate_controller": 0.01, "rate_observer": 0.1}
    without = RiccatiSynthesis(**rates, integral_weight=0.01)
    synthesis = replace(without, internal_model=list(requested))
    design = synthesis.design(run.model, balls)
    vars(run)["specification"] = SimpleNamespace(
        synthesis=SimpleNamespace(internal_model_signals=requested)
    )
    vars(run)["design"] = design
    (finding,) = check_internal_model(run)
    assert finding.holds
    slower = design.state_feedback.a.copy()
    slower[-1, -1] = 0.99
    feedback = replace(design.state_feedback, a=slower)
    vars(run)["design"] = replace(design, state_feedback=feedback)
    (finding,) = check_internal_model(run)
    assert not finding.holds
