"""Sections of `verify` on a run whose parts are in memory: status, files and what an older record
lacks."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from verify_runs import run_of

from ssm_study.certificates.certificate import Infeasible
from ssm_study.certificates.theorems.unlimited_start import UnlimitedStart
from ssm_study.engine.records import VERSION
from ssm_study.models.identified import SSM
from ssm_study.models.structured import StructuredSSM
from ssm_study.robustness.coverage import ModelErrorSpectra
from ssm_study.signals import DataSet
from ssm_study.study import claims
from ssm_study.study.claims import (
    check_loop_files,
    check_status,
    excitation_pairs,
    name_value_pairs,
    split_confirmable_settings,
)
from ssm_study.study.design_claims import (
    COVERAGE_COLUMNS,
    check_internal_model,
    check_stored_certificate,
    check_stored_initial_states,
    is_coverage_search_repeated,
    is_search_optional,
    lacks_coverage,
    missing_column_reasons,
    recompute_coverage_columns,
    stored_number_errors,
    unrepeated_search_reason,
)
from ssm_study.study.findings import DerivedColumns, UncheckedValues, UnconfirmableSettings
from ssm_study.study.run_files import RunFiles
from ssm_study.synthesis.measured_discs_run import UNPROVED, UNSOUGHT

PARTS = SimpleNamespace


def test_settings_that_no_result_confirms_are_repeated_alone() -> None:
    columns = {"order": 4, "training__max_epochs": 5, "synthesis__full": True}
    *repeated, derived = split_confirmable_settings(columns)
    names = [list(part.columns) for part in repeated]
    expected = [["training__max_epochs"], ["synthesis__full"]]
    assert names == expected
    assert derived.columns == {"order": 4}
    assert all(isinstance(part, UnconfirmableSettings) for part in repeated)
    count = len({part.reason for part in repeated if isinstance(part, UnconfirmableSettings)})
    assert count == 2


@pytest.mark.parametrize(
    ("gives_ssm", "feasible", "status"),
    [(True, True, "ok"), (True, False, "infeasible"), (False, False, "ok")],
)
def test_a_design_without_a_side_is_infeasible(
    gives_ssm: bool, feasible: bool, status: str
) -> None:
    specification = PARTS(model=PARTS(gives_ssm=gives_ssm))
    run = run_of(specification=specification, design=PARTS(feasible=feasible))
    (derived,) = check_status(run)
    assert isinstance(derived, DerivedColumns)
    assert derived.columns == {"status": status}


def test_pairs_are_numbered_from_zero() -> None:
    expected = {"u 0": ("a", "x"), "u 1": ("b", "y")}
    actual = name_value_pairs("ab", "xy", "u ")
    assert actual == expected
    expected = {"0": ("a", "x")}
    assert name_value_pairs("a", "x") == expected


def test_measured_disturbances_are_compared_where_both_sides_have_them() -> None:
    u = np.zeros((3, 1))
    records = object.__new__(DataSet)
    vars(records)["training"] = [PARTS(u=u, d=u), PARTS(u=u, d=None)]
    run = run_of(recorded_training_inputs=[u, u], training_disturbances=[u])
    pairs = excitation_pairs(run, records)
    expected = ["u 0", "u 1", "disturbances", "d 0"]
    assert list(pairs) == expected
    run = run_of(recorded_training_inputs=[u, u], training_disturbances=[u, u])
    pairs = excitation_pairs(run, records)
    expected = (2, 1)
    assert pairs["disturbances"] == expected
    assert "d 0" not in pairs


def loop_run(folder: Path, feasible: bool, comparison: Any = None, plant: Any = True) -> RunFiles:
    """Run with or without a controller, on a plant or on its model alone."""
    specification = PARTS(
        model=PARTS(gives_ssm=True), plant=plant, loop=PARTS(comparison=comparison)
    )
    return run_of(folder, specification=specification, design=PARTS(feasible=feasible))


def test_recordings_of_a_loop_are_there_exactly_if_one_was_closed(tmp_path: Path) -> None:
    closed = loop_run(tmp_path, True)
    absent = [finding.claim for finding in check_loop_files(closed)]
    assert absent == ["closed_loop.mcap", "closed_loop_model.mcap"]
    compared = loop_run(tmp_path, True, comparison=("pi",))
    absent = [finding.claim for finding in check_loop_files(compared)]
    assert absent == ["closed_loop.mcap", "closed_loop_model.mcap", "comparison.csv"]
    for name in absent:
        (tmp_path / name).touch()
    names = list(check_loop_files(compared))
    assert names == []
    open_loop = loop_run(tmp_path, False)
    findings = list(check_loop_files(open_loop))
    actual = [finding.claim for finding in findings]
    assert actual == absent
    assert not any(finding.holds for finding in findings)
    actual = {finding.found for finding in findings}
    assert actual == {"such a run closes no loop"}


def test_a_loop_is_closed_on_a_model_without_feedthrough_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for feedthrough in (True, False):
        monkeypatch.setattr(
            "ssm_study.study.run_files.has_direct_feedthrough", lambda _, it=feedthrough: it
        )
        run = loop_run(Path("run"), True, plant=None)
        vars(run)["model_run"] = PARTS(model=None)
        assert run.can_close_loop is not feedthrough


# Certificates of other versions.


def versioned(version: int, feasible: bool = True, sines: bool = True, **record: Any) -> RunFiles:
    """Run whose record is of this version."""
    design = PARTS(feasible=feasible, extra_certificates={})
    body = {"record_version": version, **record}
    return run_of(record=body, design=design, specification=PARTS(has_sine_trials=sines))


OLD = VERSION - 1


def test_an_older_record_is_told_what_it_need_not_have() -> None:
    run = versioned(OLD, coverage=1.0)
    columns = missing_column_reasons(run)
    expected = ["predicted_faster", "sine_margin", "sine_coverage"]
    assert list(columns) == expected
    names = set(columns.values())
    assert names == {f"a record of version {OLD} need not have it"}
    run = versioned(OLD)
    uncovered = missing_column_reasons(run)
    expected = ["predicted_faster", "sine_margin", *COVERAGE_COLUMNS]
    assert list(uncovered) == expected
    run = versioned(OLD, sines=False, coverage=1.0)
    without_sines = missing_column_reasons(run)
    assert list(without_sines) == ["predicted_faster"]
    run = versioned(OLD, feasible=False)
    actual = missing_column_reasons(run)
    assert actual == {}
    run = versioned(VERSION)
    actual = missing_column_reasons(run)
    assert actual == {}
    run = versioned(OLD, coverage=1.0, sine_margin=2.0)
    stated = missing_column_reasons(run)
    expected = ["predicted_faster", "sine_coverage"]
    assert list(stated) == expected


def test_only_an_older_record_without_its_claim_lacks_coverage() -> None:
    run = versioned(OLD)
    assert lacks_coverage(run)
    run = versioned(VERSION)
    assert not lacks_coverage(run)
    run = versioned(OLD, coverage=1.0)
    assert not lacks_coverage(run)
    run = versioned(OLD, coverage_reason="no")
    assert not lacks_coverage(run)
    run = versioned(OLD, coverage_needed=1.0)
    assert lacks_coverage(run)


def test_a_failed_search_that_takes_long_is_not_repeated() -> None:
    run = versioned(VERSION, coverage_reason=UNPROVED)
    vars(run)["model_run"] = PARTS(model=None)  # no linear part with a static map on each side
    assert not is_coverage_search_repeated(run)
    expected = ["search for a proof of coverage"]
    names = list(unrepeated_search_reason(run))
    assert names == expected
    proved = versioned(VERSION, coverage_reason=None)
    assert unrepeated_search_reason(proved) == {}


def test_a_proof_not_looked_for_is_believed_with_neurons_where_no_input_repeats() -> None:
    run = versioned(VERSION)
    vars(run)["design"] = PARTS(extra_certificates={})
    with_neurons = object.__new__(StructuredSSM)
    vars(run)["model_run"] = PARTS(model=with_neurons)
    once = object.__new__(ModelErrorSpectra)
    vars(once)["repeating"] = ()
    assert is_search_optional(run, once)
    repeating = object.__new__(ModelErrorSpectra)
    vars(repeating)["repeating"] = (once,)
    assert not is_search_optional(run, repeating)
    one_layer = object.__new__(SSM)
    vars(run)["model_run"] = PARTS(model=one_layer)
    assert not is_search_optional(run, once)


def infeasible_side() -> Infeasible:
    """Side for which no certificate was found."""
    return Infeasible(
        theorem="state_feedback",
        alpha=0.1,
        beta=1.0,
        rate=0.1,
        rate_limit=0.05,
        proved=False,
        reason="too fast",
        method="lmi",
        solver_status="infeasible",
        seconds=0.0,
    )


def test_a_stored_side_is_of_the_requested_method() -> None:
    part = infeasible_side()
    run = run_of(record={"synthesis_method": "lmi"})
    verdict = check_stored_certificate(run, "state_feedback", part, ["observer: wrong"])
    assert verdict.holds
    assert verdict.claim == "certificate.state_feedback at rate 0.1"
    assert verdict.found == "exact arithmetic finds it without certificate: too fast"
    wrong = ["state_feedbacks: no", "state_feedback: margin", "state_feedback is off"]
    verdict = check_stored_certificate(run, "state_feedback", part, wrong)
    assert not verdict.holds
    assert verdict.found == "state_feedback: margin; state_feedback is off"
    other = run_of(record={"synthesis_method": "riccati"})
    verdict = check_stored_certificate(other, "state_feedback", part, [])
    assert verdict.found == "method lmi: another one was requested"
    assert check_stored_certificate(other, "extra", part, []).holds
    assert stored_number_errors(part) == []


def test_without_a_request_or_a_feedback_no_internal_model_is_checked() -> None:
    part = infeasible_side()
    design = PARTS(state_feedback=part)
    for synthesis in (PARTS(), PARTS(modes=()), PARTS(modes=("step",))):
        run = run_of(specification=PARTS(synthesis=synthesis), design=design)
        findings = list(check_internal_model(run))
        assert findings == []


def test_a_log_that_is_gone_names_what_follows_from_it() -> None:
    specification = PARTS(model=PARTS(gives_ssm=True))
    record = {"score_test_1": 1.0, "rmse_test": 2.0}
    run = run_of(record=record, specification=specification, missing_log_reason="gone")
    (listed,) = claims.check_records(run)
    assert isinstance(listed, UncheckedValues)
    names = set(listed.reasons.values())
    assert names == {"gone"}
    expected = {"score_test_1", "fit_train_percent", "evidence", "piece_start", "excitation.mcap"}
    assert expected <= set(listed.reasons)
    assert not {"seed", "rmse_test", "fold"} & set(listed.reasons)


@pytest.mark.parametrize("plant", [None, "plant"])
@pytest.mark.parametrize("feasible", [True, False])
def test_only_a_log_compares_its_test_record_with_its_coverage(
    plant: Any, feasible: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def records(name: str) -> SimpleNamespace:
        return PARTS(records=name, start_up_samples=3)

    run = run_of(
        record={"record_version": VERSION},
        design=PARTS(feasible=feasible, gain_pair="pair"),
        specification=PARTS(plant=plant, simulates_fresh_data=False),
        model_run=PARTS(model=None, validation=records("validation"), test=records("test")),
        mismatch_records=("sines",),
    )
    place = "ssm_study.study.design_claims"
    monkeypatch.setattr(f"{place}.measure_model_error", lambda *_: "mismatch")
    monkeypatch.setattr(f"{place}.measure_error_spectra", lambda *values: values)
    monkeypatch.setattr(f"{place}.recompute_fresh_data_column", lambda *_: {"fresh": 1})
    columns = {"coverage": 1.5}
    compared: list[Any] = []

    def note_spectra(*values: Any) -> dict[str, float]:
        compared.extend(values[2:])
        return dict(columns)

    monkeypatch.setattr(f"{place}.coverage_columns", note_spectra)
    monkeypatch.setattr(f"{place}.withhold_coverage", lambda *_: {"withheld": True})
    facts = recompute_coverage_columns(run)
    premise, fresh = compared
    assert premise == (None, "validation", "mismatch", 3, ("sines",))
    assert fresh == (None if plant else (None, "test", "mismatch", 3))
    assert facts == ({"withheld": True} if feasible else columns | {"fresh": 1})


def test_an_older_run_s_coverage_is_not_withheld_afterwards() -> None:
    lacking = versioned(OLD)
    assert recompute_coverage_columns(lacking) == {}


@pytest.mark.parametrize(("is_old", "feasible"), [(True, True), (False, False)])
def test_a_coverage_is_withheld_in_a_present_design_alone(
    is_old: bool, feasible: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = "ssm_study.study.design_claims"
    names = ("measure_model_error", "measure_error_spectra", "withhold_coverage")
    for name in names:
        monkeypatch.setattr(f"{place}.{name}", lambda *_: {"withheld": True})
    monkeypatch.setattr(f"{place}.coverage_columns", lambda *_: {"coverage": 1.5})
    monkeypatch.setattr(f"{place}.recompute_fresh_data_column", lambda *_: {})
    run = versioned(OLD if is_old else VERSION, feasible=feasible, coverage=1.5)
    records = PARTS(records="records", start_up_samples=0)
    vars(run)["model_run"] = PARTS(model=None, validation=records)
    vars(run)["mismatch_records"] = ()
    run.specification.plant = "plant"
    run.design.gain_pair = "pair"
    assert recompute_coverage_columns(run) == {"coverage": 1.5}


@pytest.mark.parametrize(
    ("recomputed", "expected"), [(UNPROVED, UNSOUGHT), ("another reason", "another reason")]
)
def test_a_proof_not_looked_for_hides_no_other_reason(
    recomputed: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = "ssm_study.study.design_claims"
    for name in ("measure_model_error", "measure_error_spectra"):
        monkeypatch.setattr(f"{place}.{name}", lambda *_: None)
    monkeypatch.setattr(f"{place}.coverage_columns", lambda *_: {"coverage_reason": recomputed})
    monkeypatch.setattr(f"{place}.recompute_fresh_data_column", lambda *_: {})
    monkeypatch.setattr(f"{place}.is_search_optional", lambda *_: True)
    run = versioned(VERSION, feasible=False, coverage_reason=UNSOUGHT)
    records = PARTS(records="records", start_up_samples=0)
    vars(run)["model_run"] = PARTS(model=None, validation=records)
    vars(run)["mismatch_records"] = ()
    run.specification.plant = "plant"
    facts = recompute_coverage_columns(run)
    assert facts["coverage_reason"] == expected


def wrong_numbers(margin: float, condition: float) -> list[str]:
    """Which numbers of a proof are named as wrong."""
    proof: Any = object.__new__(UnlimitedStart)
    vars(proof).update(margin=margin, condition=condition, p=np.eye(1))
    return [sentence.partition(":")[0] for sentence in stored_number_errors(proof)]


def test_the_numbers_beside_a_proof_are_computed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    place = "ssm_study.study.design_claims"
    matrices = {"metric": np.eye(1)}
    monkeypatch.setattr(UnlimitedStart, "float_conditions", lambda *_, **__: matrices)
    monkeypatch.setattr(UnlimitedStart, "variables", {})
    monkeypatch.setattr(f"{place}.smallest_eigenvalue", lambda _: 0.5)
    monkeypatch.setattr(f"{place}.scaled_condition_number", lambda _: 10.0)
    assert wrong_numbers(0.5, 10.0) == []
    assert wrong_numbers(0.5 + 4e-7, 10.0 + 9e-6) == []
    assert wrong_numbers(0.5 + 6e-7, 10.0) == ["margin"]
    assert wrong_numbers(0.5, 10.0 - 2e-5) == ["condition"]
    assert wrong_numbers(float("nan"), float("nan")) == ["margin", "condition"]


STARTS: list[tuple[Any, bool, bool]] = []
STARTS.append(([[1.0], [2.0]], True, True))
STARTS.append(([[1.0], [2.0]], False, False))
STARTS.append(([[1.0], [2.1]], True, False))
STARTS.append(([[1.0], [2.1]], False, False))
STARTS.append(([[1.0]], True, False))
STARTS.append((None, True, False))


@pytest.mark.parametrize(("starts", "within", "holds"), STARTS)
def test_stored_initial_states_are_those_of_the_model_and_within_the_level(
    starts: Any, within: bool, holds: bool
) -> None:
    part: Any = object.__new__(UnlimitedStart)
    vars(part)["starts"] = np.array([[1.0], [2.0]])
    array = None if starts is None else np.array(starts)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(UnlimitedStart, "holds", lambda *_, **__: within)
        patch.setattr(UnlimitedStart, "variables", {})
        verdict = check_stored_initial_states(part, array)
    assert verdict.holds is holds
    assert verdict.claim == "certificate starts"
