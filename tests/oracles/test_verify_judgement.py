"""`verify` judges a column, gathers findings and words them; the run is made of parts in memory."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from verify_runs import run_of

from ssm_study.columns import ADDED
from ssm_study.refusal import BadRequest
from ssm_study.study import verify
from ssm_study.study.findings import (
    CheckedClaim,
    DerivedColumns,
    UncheckedValues,
    UnconfirmableSettings,
    check_agreement,
)
from ssm_study.study.run_files import RunFiles, error_text, find_unknown_entries
from ssm_study.study.verify import (
    UNGIVEN,
    UNREACHED,
    Verification,
    claim_of_section,
    compare_column,
    finding_lines,
    judge_column,
    verify_files,
)

PARTS = SimpleNamespace


def judge(name: str, stored: Any, **more: Any) -> Any:
    """Verdict on one column of a record of the present version."""
    return judge_column(name, {name: stored}, more.get("derived", {}), more.get("unchecked", {}))


# One column.


def test_a_derived_column_is_compared_unless_it_is_listed_as_unchecked() -> None:
    same = judge("order", 4, derived={"order": 4})
    expected = CheckedClaim(claim="order", holds=True, found="4")
    assert same == expected
    other = judge("order", 4, derived={"order": 5})
    expected = CheckedClaim(claim="order", holds=False, found="derived 5, stored 4")
    assert other == expected
    listed = judge("order", 4, derived={"order": 5}, unchecked={"order": "the log is gone"})
    assert listed == "the log is gone"


def test_a_column_that_nothing_gives_is_no_claim_that_holds() -> None:
    ungiven = judge("order", 4)
    expected = CheckedClaim(claim="order", holds=False, found=f"stored 4, yet {UNGIVEN}")
    assert ungiven == expected
    undeclared = judge("nothing_such", 4)
    assert undeclared.found == "stored 4, yet no such column is declared"
    assert not undeclared.holds
    invented = judge("nothing_such", None)
    assert not invented.holds
    verdict = judge("order", None)
    assert verdict == ""
    verdict = judge("seconds", 1.0)
    assert verdict == "depends on when it ran"
    verdict = judge("noise_gain", 1.0)
    assert verdict == "withdrawn in 0.2"
    verdict = judge("noise_gain", None)
    assert verdict == ""


def test_only_the_first_records_may_lack_what_was_added() -> None:
    derived = {"coverage": 1.5}
    absent = judge_column("coverage", {"record_version": 1}, derived, {})
    assert absent == ADDED
    for record in ({"record_version": 2}, {}, {"record_version": 1, "coverage": None}):
        verdict = judge_column("coverage", record, derived, {})
        assert isinstance(verdict, CheckedClaim)
        assert not verdict.holds


INFINITY = float("inf")
PAIRS: list[tuple[str, Any, Any, bool]] = []


def add_pair(name: str, stored: Any, value: Any, holds: bool) -> None:
    """Add a stored and a recomputed value, and whether they agree."""
    PAIRS.append((name, stored, value, holds))


add_pair("rmse_test", 1.0, 1.0 + 0.9e-9, True)
add_pair("rmse_test", 1.0, 1.0 + 1.1e-9, False)
add_pair("rmse_test", -1.0, -1.0 - 0.9e-9, True)
add_pair("rmse_test", 1, 1.0, True)
add_pair("rmse_test", True, 1.0, False)
add_pair("rmse_test", "1.0", 1.0, False)
add_pair("rmse_test", 10**400, 1.0, False)
add_pair("rmse_test", None, 1.0, False)
add_pair("rmse_test", "inf", INFINITY, True)
add_pair("rmse_test", None, float("nan"), True)
add_pair("controller_margin", 0.5e-12, 0.0, True)
add_pair("controller_margin", 1.5e-12, 0.0, False)
add_pair("undeclared", 1.0, 1.0 + 0.9e-9, True)
add_pair("order", 4, 4, True)
add_pair("order", 4.0, 4, False)
add_pair("order", True, 1, False)
add_pair("controller_certified", 1, True, False)
add_pair("controller_certified", True, True, True)
add_pair("status", "ok", "ok", True)
add_pair("status", "ok", "infeasible", False)


@pytest.mark.parametrize(("name", "stored", "value", "holds"), PAIRS)
def test_values_agree_up_to_the_rounding_of_their_column(
    name: str, stored: Any, value: Any, holds: bool
) -> None:
    verdict = compare_column(name, stored, value)
    assert verdict.holds == holds
    assert verdict.claim == name
    assert verdict.found.startswith("derived ") != holds


# All findings of a run.


def judge_sections(
    monkeypatch: pytest.MonkeyPatch, record: dict[str, Any], *results: Any
) -> Verification:
    """Verification of a record by one section that gives these results."""

    def section(_: RunFiles) -> Any:
        for result in results:
            if isinstance(result, Exception):
                raise result
            yield result

    section.__name__ = "check_loops"
    monkeypatch.setattr(verify, "check_form", lambda _: iter(()))
    monkeypatch.setattr(verify, "SECTIONS", (section,))
    return verify_files(run_of(record=record, specification=PARTS(model=PARTS(gives_ssm=True))))


def test_findings_are_gathered_by_their_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    record = {"order": 4, "seed": 1, "fold": 2, "seconds": 3.0, "rmse_test": 1.0}
    verification = judge_sections(
        monkeypatch,
        record,
        CheckedClaim(claim="file", holds=True, found="read"),
        DerivedColumns({"order": 4, "hidden_width": 8}),
        UnconfirmableSettings({"seed": 1, "fold": 3}, "affects nothing"),
        UncheckedValues({"rmse_test": "no log"}),
    )
    verdicts = {finding.claim: finding.holds for finding in verification}
    expected = {"file": True, "order": True, "hidden_width": False, "fold": False}
    assert verdicts == expected
    reasons = {"rmse_test": "no log", "seed": "affects nothing"}
    expected = {**reasons, "seconds": "depends on when it ran"}
    assert verification.unchecked == expected
    assert len(verification) == 4
    assert not verification.holds


def test_after_an_error_what_it_would_have_given_is_not_a_lie(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    error = ValueError("too\nshort")
    record = {"order": 4, "nothing_such": 1}
    verification = judge_sections(monkeypatch, record, DerivedColumns({}), error)
    found = {finding.claim: finding.found for finding in verification}
    expected = {
        "loop": "cannot be derived: too short",
        "nothing_such": "stored 1, yet no such column is declared",
    }
    assert found == expected
    assert verification.unchecked == {"order": UNREACHED}
    without_error = judge_sections(monkeypatch, {"order": 4})
    assert not without_error.holds
    assert without_error.unchecked == {}


CLAIMS = {"check_settings": "requested", "check_fits": "fits", "check_loops": "loop"}


def test_a_section_is_called_by_what_it_is_about() -> None:
    subjects = {function: claim_of_section(function) for function in CLAIMS}
    assert subjects == CLAIMS


def test_a_baseline_has_fewer_sections(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verify, "check_form", lambda _: iter(()))
    monkeypatch.setattr(verify, "SECTIONS", ())
    baseline = [lambda _: iter([CheckedClaim(claim="fits", holds=True, found="yes")])]
    monkeypatch.setattr(verify, "OF_A_BASELINE", baseline)
    run = run_of(specification=PARTS(model=PARTS(gives_ssm=False)))
    actual = [finding.claim for finding in verify_files(run)]
    assert actual == ["fits"]


HOLDS = CheckedClaim(claim="a", holds=True, found="seen")
FAILS = CheckedClaim(claim="b", holds=False, found="gone")


def test_a_verification_is_worded_in_full_or_by_its_failures() -> None:
    unchecked = {"x": "late", "y": "late", "z": "never"}
    verification = Verification(findings=(HOLDS, FAILS), unchecked=unchecked)
    summary = "1 of 2 claims hold; 3 not checked: late (2), never (1)"
    assert verification.summary() == summary
    expected = ["FAILS  b: gone", summary]
    actual = verification.lines(every_claim=False)
    assert actual == expected
    expected = [
        "holds  a: seen",
        "FAILS  b: gone",
        "not checked  x, y: late",
        "not checked  z: never",
        summary,
    ]
    assert verification.lines() == expected
    content = json.loads(verification.to_json())
    assert content["holds"] is False
    assert content["not_checked"] == unchecked
    expected = {"claim": "a", "holds": True, "found": "seen"}
    actual = content["claims"][0]
    assert actual == expected
    with pytest.raises(BadRequest, match="1 of 2 claims do not hold: FAILS b: gone; run"):
        verification.require_valid("run", "r")
    good = Verification(findings=(HOLDS,), unchecked={})
    assert good.holds
    assert good.summary() == "1 of 1 claims hold; 0 not checked"
    good.require_valid("run", "r")


def test_many_failures_are_named_in_three_hundred_letters() -> None:
    many = [CheckedClaim(claim="c" * 40, holds=False, found=f"no {number}") for number in range(30)]
    verification = Verification(findings=tuple(many), unchecked={})
    with pytest.raises(BadRequest) as caught:
        verification.require_valid("run", "r")
    causes = caught.value.problem.partition("do not hold: ")[2]
    assert len(causes) == 300


def test_columns_that_nothing_gives_stand_in_one_line() -> None:
    order = judge("order", 4)
    seed = judge("seed", 5)
    fold = judge("fold", 6)
    findings = [order, seed, HOLDS, fold]
    expected = [f"FAILS  order, seed, fold: {UNGIVEN}", "holds  a: seen"]
    assert finding_lines(findings) == expected
    actual = finding_lines(findings[:1])
    assert actual == [f"FAILS  order: stored 4, yet {UNGIVEN}"]


# Agreement.


def test_the_farthest_pair_is_stated_and_every_wrong_one_named() -> None:
    near = {"a": (1.0, 1.0 + 1e-9), "b": (2.0, 2.0)}
    verdict = check_agreement("file", near, 1e-6, "the model gives it")
    assert str(verdict) == "holds  file: the model gives it to 1.0e-09"
    far = {**near, "c": (1.0, 2.0), "d": (3.0, 4.0)}
    verdict = check_agreement("file", far, 1e-6, "the model gives it")
    assert str(verdict) == "FAILS  file: c, d differ by up to 5.0e-01"
    assert check_agreement("file", {"a": (1.0, 2.0)}, 0.5, "it").holds, "within the tolerance"
    assert not check_agreement("file", {"a": (np.nan, 1.0)}, 1.0, "it").holds
    assert not check_agreement("file", {"a": (np.ones(2), np.ones(3))}, 1.0, "it").holds


def test_entries_that_the_program_ignores_have_their_path() -> None:
    stored = {"a": {"b": 1, "x": 2}, "rows": [{"c": 1}, {"c": 2, "y": 3}], "z": {"deep": 1}}
    written = {"a": {"b": 5}, "rows": [{"c": 1}, {"c": 2}]}
    expected = ["a.x", "rows.y", "z"]
    assert find_unknown_entries(stored, written) == expected
    assert find_unknown_entries(written, stored) == []
    actual = find_unknown_entries({"a": {"b": 1}}, {"a": 1})
    assert actual == ["a.b"]


def test_an_error_is_one_line_of_three_hundred_letters() -> None:
    assert error_text(ValueError("two\n lines")) == "two lines"
    assert error_text(KeyError()) == "KeyError"
    count = len(error_text(ValueError("x" * 400)))
    assert count == 300
