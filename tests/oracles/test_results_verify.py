"""`verify` against a liar: each claim altered alone is named alone, and only beyond its tolerance.

Everything is sealed anew after an alteration, and what depends on it made consistent: the lie has
to be found, not the seal.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from verify_lies import failing, invented

from ssm_study.bounds.slopes import certified_balls
from ssm_study.cli.main import main
from ssm_study.engine.records import read_record, write_record
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.signals import Trajectory
from ssm_study.study.claims import SECTIONS
from ssm_study.study.file_claims import check_files
from ssm_study.study.findings import CheckedClaim, DerivedColumns, UnconfirmableSettings
from ssm_study.study.recordings import read_free_runs, record_signal_pairs
from ssm_study.study.run_files import RunFiles
from ssm_study.study.verify import Verification, _short_text, compare_column, judge_column, verify
from ssm_study.synthesis.metrics import design_columns
from ssm_study.table.columns import find_declaration

# Relative tolerance of each number, written out again: what another machine's rounding may do.
ONE_FORMULA = 1e-9
DECOMPOSED = 1e-6
ITERATED = 1e-6
NUMBERS: dict[str, float] = {}


def allow(tolerance: float, *names: str) -> None:
    """Allow these numbers to differ by this share."""
    NUMBERS.update(dict.fromkeys(names, tolerance))


SIDES = ("controller", "observer")
allow(DECOMPOSED, "hankel_largest", "hankel_smallest", "spectral_radius")
for end in ("lower", "upper"):
    allow(DECOMPOSED, f"controllability_gramian_{end}", f"observability_gramian_{end}")
    allow(ONE_FORMULA, f"input_slope_{end}", f"output_slope_{end}")
    allow(ONE_FORMULA, f"input_slope_{end}_spectral")
for side in SIDES:
    allow(ITERATED, f"rate_{side}", f"{side}_certified_rate", f"{side}_margin")
    allow(ITERATED, f"{side}_rate_limit", f"{side}_gain_norm")
allow(ITERATED, "certified_tolerance", "coverage", "coverage_needed")
allow(ITERATED, "mismatch_margin", "resolved_margin")
allow(ITERATED, "mismatch_gain", "mismatch_seen", "mismatch_spread")
allow(ITERATED, "controller_radius", "noise_peak", "sine_coverage", "sine_margin")
for part in ("train", "validation", "test"):
    allow(ONE_FORMULA, f"fit_{part}_percent")
allow(ONE_FORMULA, "rmse_test", "input_coverage", "stable_fraction", "overshoot_worst")
allow(ONE_FORMULA, "input_peak_v", "control_energy")
for which in ("mean", "worst", "open_loop", "pi"):
    allow(ONE_FORMULA, f"settling_time_{which}_s")
allow(ONE_FORMULA, "integral_squared_error", "final_error_worst", "empirical_rate")
allow(ONE_FORMULA, "estimate_decay_rate", "certified_bound_excess_plant")
allow(ONE_FORMULA, "noise_gain_measured", "swings_at_rest")
allow(ITERATED, "limit_lower", "limit_upper", "unlimited_from", "unlimited_to", "noise_gain_model")
# Absolute, of matrices with unit diagonal.
EIGENVALUES = {"controller_margin": 1e-12, "observer_margin": 1e-12}
COUNTS = (
    "excitation_order",
    "states",
    "initial_conditions",
    "stable_count",
    "stable_count_pi",
    "left_bound_count",
    "certified_bound_violations",
)
PARTS = [f"{side}_{what}" for side in SIDES for what in ("feasible", "certified")]
WORDS = (
    "bound_method",
    "predicted_stable",
    "predicted_faster",
    "local_controllability",
    "local_observability",
    "judged_noise_free",
    "faster_than_open_loop",
    "coverage_reference",
    *PARTS,
)
ABSENT = (
    "disturbances",
    "benchmark",
    "fold",
    "excitation_warning",
    "left_bound_first_s",
    "unsettled_as",
    "limited_rate",
    "piece_start",
    "fit_test_other_start_percent",
    "members",
    "fit_validation_members_percent",
    "fit_test_members_percent",
)  # here: all settle
MEMBERS = {"members", "fit_validation_members_percent", "fit_test_members_percent"}  # none here
REQUESTED = ("study", "run", "status", "seed", "fresh_sets", "order", "hidden_width", "slope_lower",
             "slope_upper", "model",
             "scaffold_in", "scaffold_out", "plant", "excitation", "synthesis_method",
             "data_source",
             "loop_on", "evidence", "evidence_reasons")  # fmt: skip
FILES = {"files", "folder", "certificate limits", "certificate starts", "certificate.json entries"}
FILES |= {"model.json entries", "model.json step_s", "evidence.json", "excitation.mcap"}
FILES |= {"fit_test_before_reduction_percent", "trials.mcap records"}
LOOPS = ("closed_loop.mcap", "closed_loop_model.mcap")
FILES |= {*LOOPS, "closed_loop.mcap loop_on", "closed_loop.mcap input"}
FILES |= {f"{name} settling_band" for name in LOOPS}
for name in ("validation.mcap", "test.mcap"):
    FILES |= {f"{name} records", f"{name} /simulated"}
RECORDINGS = ("excitation.mcap", "validation.mcap", "test.mcap", "trials.mcap", *LOOPS)
FILES |= {f"{name} labels" for name in RECORDINGS}

pytestmark = pytest.mark.usefixtures("made_once")


@pytest.fixture(scope="module")
def verification(smoke_run: Path, made_once: None) -> Verification:
    """Findings of `verify` about the run as it is."""
    del made_once
    return verify(smoke_run)


@pytest.fixture(scope="module")
def derived(smoke_run: Path, record: dict[str, Any]) -> dict[str, Any]:
    """Columns derived from the files of the run."""
    run = RunFiles(path=smoke_run, record=record)
    found = []
    for section in SECTIONS:
        found += [
            item.columns
            for item in section(run)
            if isinstance(item, DerivedColumns | UnconfirmableSettings)
        ]
    return {name: value for columns in found for name, value in columns.items()}


@pytest.fixture(scope="module")
def record(smoke_run: Path) -> dict[str, Any]:
    found = read_record(smoke_run)
    assert found is not None
    return found


def named(record: dict[str, Any], derived: dict[str, Any]) -> set[str]:
    names = {*derived, *record}
    judged = [judge_column(name, record, derived, {}) for name in names]
    return {
        finding.claim
        for finding in judged
        if isinstance(finding, CheckedClaim) and not finding.holds
    }


def moved(record: dict[str, Any], name: str, share: float) -> float:
    """The number of the record moved by `share` of what it is allowed to differ."""
    eigenvalues = EIGENVALUES.get(name, 0.0)
    return record[name] + share * (NUMBERS[name] * abs(record[name]) + eigenvalues)


def test_every_claim_is_in_one_of_the_lists_and_the_rest_has_a_reason(
    verification: Verification, record: dict[str, Any]
) -> None:
    """A claim added to `verify` has to be shown to be able to fail."""
    claims = {finding.claim for finding in verification}
    certificates = {
        claim for claim in claims if claim.startswith("certificate.") and claim not in FILES
    }
    assert verification.holds
    assert len(certificates) == 7
    listed = {*NUMBERS, *COUNTS, *WORDS, *ABSENT, *REQUESTED, *FILES}
    assert claims - certificates == listed - MEMBERS
    stored = {name for name, value in record.items() if value is not None}
    assert stored <= {*claims, *verification.unchecked}
    reasons = verification.unchecked.values()
    assert all(reasons)
    count = len(claims)
    start = f"{count} of {count} claims hold; {len(verification.unchecked)} not "
    assert verification.summary().startswith(start)


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_is_named_beyond_its_tolerance_and_not_within(
    name: str, record: dict[str, Any], derived: dict[str, Any]
) -> None:
    for share in (-0.9, 0.9):
        assert named(record | {name: moved(record, name, share)}, derived) == set()
    difference = -1 - record[name]
    wrongs = (
        moved(record, name, -1.1),
        moved(record, name, 1.1),
        difference,
        None,
        "inf",
        "unknown",
        10**400,
    )
    for wrong in wrongs:
        if wrong != record[name]:  # a number that is zero cannot be moved by a share of itself
            assert named(record | {name: wrong}, derived) == {name}


@pytest.mark.parametrize("name", COUNTS)
def test_a_count_is_named_when_it_is_one_off(
    name: str, record: dict[str, Any], derived: dict[str, Any]
) -> None:
    for wrong in (record[name] + 1, record[name] - 1, None):
        assert named(record | {name: wrong}, derived) == {name}


def other(value: Any) -> Any:
    """A value of the same kind that is not this one."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return value + 1
    return f"{value}_"


def test_every_column_is_named_when_it_alone_is_another_or_left_out(
    record: dict[str, Any], derived: dict[str, Any]
) -> None:
    """Over all columns of the record: a lie is found, unless the column is listed as not checked
    with its reason."""
    for name, value in record.items():
        if value is not None and not (column := find_declaration(name)).unchecked:  # type: ignore[union-attr]
            assert named(record | {name: other(value)}, derived) == {name}
            assert named({key: kept for key, kept in record.items() if key != name}, derived) == {
                name
            }
        assert column is not None


def test_a_value_where_there_is_none_and_an_invented_column_are_named(
    record: dict[str, Any], derived: dict[str, Any]
) -> None:
    for name in (*ABSENT, "controller_reason", "infeasible_reason", "score_test_1", "quality",
                 "certified",
                 "parent_run", "refinements", "mismatch_in_loop"):  # fmt: skip
        assert named(record | {name: 0.0}, derived) == {name}


def test_an_infinite_number_is_only_itself() -> None:
    """A margin is infinite where the gain is zero; no finite number is near to that."""
    for stored, holds in (
        ("inf", True),
        ("-inf", False),
        (1e300, False),
        (2.0, False),
        (None, False),
    ):
        checked = compare_column("mismatch_margin", stored, np.inf)
        assert checked.holds is holds


def test_a_part_without_certificate_is_recorded_with_its_reason(
    smoke_run: Path, record: dict[str, Any]
) -> None:
    """The matrices are those of another rate; the reason is the record's, and a claim like any
    other."""
    run = RunFiles(path=smoke_run, record=record)
    kept = read_free_runs(smoke_run / "validation.mcap")
    told = "riccati; not positive definite in exact arithmetic"
    observer = replace(run.design.observer, certified=False, solver_status=told)
    missed = replace(run.design, observer=observer)  # type: ignore[arg-type]
    shown = measure_model_error(run.model, kept.records, kept.start_up_samples)
    for made, reason in ((run.design, None), (missed, f"observer: {told}")):
        balls = certified_balls(run.model)
        facts = design_columns(made, run.model, balls, shown)
        assert facts.get("uncertified_reason") == reason


def test_the_seal_says_what_it_found(copied_run: Path) -> None:
    for change, holds, found in (
        ("", True, "as they were written"),
        (" ", False, "changed since: model.json"),
    ):
        path = copied_run / "model.json"
        text = path.read_text()
        path.write_text(text + change)
        seal = next(check_files(RunFiles(path=copied_run, record={})))
        assert isinstance(seal, CheckedClaim)
        assert seal.claim == "files"
        assert seal.holds == holds
        assert seal.found == found
        assert str(seal) == f"{'holds' if holds else 'FAILS'}  files: {found}"


def test_a_record_without_status_or_with_a_broken_seal(
    copied_run: Path, record: dict[str, Any]
) -> None:
    write_record(copied_run, {name: value for name, value in record.items() if name != "status"})
    assert failing(copied_run) == {"record.json"}
    (copied_run / "record.json").write_text("{}")
    assert failing(copied_run) == {"record.json"}


def test_a_record_that_is_lost_is_a_pair_that_differs() -> None:
    signal = np.zeros((3, 1))
    record = Trajectory(u=signal, y=signal, step_s=0.1, name="a")
    pairs = record_signal_pairs([record], [])
    assert pairs == {"records": (1, 0)}


def test_a_file_that_the_manifest_does_not_know_is_named(copied_run: Path) -> None:
    """The report draws it: nothing unsealed lies beside the run's files."""
    invented(copied_run, seal=False)
    assert failing(copied_run) == {"comparison.csv"}


def test_the_command_ends_with_one_line_and_speaks_json(
    smoke_run: Path,
    verification: Verification,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("ssm_study.study.verify.verify", {smoke_run: verification}.__getitem__)
    assert main(["verify", str(smoke_run)]) == 0
    (last,) = capsys.readouterr().out.splitlines()
    assert last.endswith(" (-v lists every claim)")
    assert main(["verify", str(smoke_run), "-v"]) == 0
    *claims, verdict = capsys.readouterr().out.splitlines()
    assert f"{verdict} (-v lists every claim)" == last
    assert any(line.startswith("holds  fit_test_percent") for line in claims)
    assert main(["verify", str(smoke_run), "--json"]) == 0
    out = capsys.readouterr().out
    said = json.loads(out)
    held = sum(claim["holds"] for claim in said["claims"])
    assert last.startswith(
        f"{held} of {len(said['claims'])} claims hold; {len(said['not_checked'])} not checked: "
    )
    assert said["holds"] is True


def test_of_a_lie_the_command_prints_the_failure_and_the_verdict(
    copied_run: Path, record: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    write_record(copied_run, record | {"settling_time_mean_s": 1e-3})
    assert main(["verify", str(copied_run)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert not [line for line in lines if line.startswith(("holds", "not checked"))]
    assert any(line.startswith("FAILS") and "settling_time_mean_s" in line for line in lines)
    assert "claims hold" in lines[-1]


def test_a_long_value_is_told_in_eighty_characters() -> None:
    lengths = (79, 80, 81, 500)
    expected = [79, 80, 80, 80]
    assert [len(_short_text("x" * length)) for length in lengths] == expected
