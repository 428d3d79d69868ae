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
from ssm_study.robustness.mismatch import measure_mismatch
from ssm_study.study.claims import SECTIONS
from ssm_study.study.findings import Checked, DerivedColumns, RepeatedSettings
from ssm_study.study.recordings import read_simulation
from ssm_study.study.run_files import RunFiles
from ssm_study.study.verify import _short_text, compare_column, judge_column, verify
from ssm_study.synthesis.metrics import design_columns
from ssm_study.table.columns import find_declaration

# Relative tolerance of each number, written out again: what another machine's rounding may do.
ONE_FORMULA = 1e-9
DECOMPOSED = 1e-6
ITERATED = 1e-6
NUMBERS = {
    **dict.fromkeys(("hankel_largest", "hankel_smallest", "spectral_radius"), DECOMPOSED),
    **{
        f"{what}ability_gramian_{end}": DECOMPOSED
        for what in ("controll", "observ")
        for end in ("lower", "upper")
    },
    **{
        f"{side}_slope_{end}": ONE_FORMULA
        for side in ("input", "output")
        for end in ("lower", "upper")
    },
    **{f"input_slope_{end}_spectral": ONE_FORMULA for end in ("lower", "upper")},
    **{f"rate_{side}": ITERATED for side in ("controller", "observer")},
    **{
        f"{side}_{what}": ITERATED
        for side in ("controller", "observer")
        for what in ("rate_limit", "gain_norm")
    },
    **{f"{side}_certified_rate": ITERATED for side in ("controller", "observer")},
    **dict.fromkeys(("certified_tolerance", "coverage", "coverage_needed"), ITERATED),
    **{f"{side}_margin": ITERATED for side in ("controller", "observer", "mismatch", "resolved")},
    **dict.fromkeys(
        (
            "mismatch_gain",
            "mismatch_seen",
            "mismatch_spread",
            "controller_radius",
            "noise_peak",
            "sine_coverage",
            "sine_margin",
        ),
        ITERATED,
    ),
    **{f"fit_{record}_percent": ONE_FORMULA for record in ("train", "validation", "test")},
    **dict.fromkeys(
        (
            "rmse_test",
            "input_coverage",
            "stable_fraction",
            "overshoot_worst",
            "input_peak_v",
            "control_energy",
        ),
        ONE_FORMULA,
    ),
    **{f"settling_time_{which}_s": ONE_FORMULA for which in ("mean", "worst", "open_loop", "pi")},
    **dict.fromkeys(("integral_squared_error", "final_error_worst", "empirical_rate"), ONE_FORMULA),
    **dict.fromkeys(
        (
            "estimate_decay_rate",
            "certified_bound_excess_plant",
            "noise_gain_measured",
            "swings_at_rest",
        ),
        ONE_FORMULA,
    ),
    **dict.fromkeys(
        ("limit_lower", "limit_upper", "unlimited_from", "unlimited_to", "noise_gain_model"),
        ITERATED,
    ),
}
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
PARTS = [
    f"{side}_{what}" for side in ("controller", "observer") for what in ("feasible", "certified")
]
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
FILES = (
    *(
        "files",
        "folder",
        "certificate limits",
        "certificate starts",
        "closed_loop.mcap settling_band",
        "closed_loop_model.mcap settling_band",
        "fit_test_before_reduction_percent",
        "certificate.json entries",
        "model.json entries",
        "evidence.json",
        "model.json step_s",
        "excitation.mcap",
    ),
    *("trials.mcap records", "closed_loop.mcap loop_on"),
    *(
        f"{name}.mcap {what}"
        for name in ("validation", "test")
        for what in ("records", "/simulated")
    ),
    *("closed_loop.mcap", "closed_loop.mcap input", "closed_loop_model.mcap"),
    *(
        f"{name}.mcap labels"
        for name in (
            "excitation",
            "validation",
            "test",
            "trials",
            "closed_loop",
            "closed_loop_model",
        )
    ),
)

pytestmark = pytest.mark.usefixtures("made_once")


@pytest.fixture(scope="module")
def derived(smoke_run: Path, record: dict[str, Any]) -> dict[str, Any]:
    """Columns derived from the files of the run."""
    run = RunFiles(path=smoke_run, record=record)
    found = []
    for section in SECTIONS:
        found += [
            item.columns
            for item in section(run)
            if isinstance(item, DerivedColumns | RepeatedSettings)
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
        finding.claim for finding in judged if isinstance(finding, Checked) and not finding.holds
    }


def moved(record: dict[str, Any], name: str, share: float) -> float:
    """The number of the record moved by `share` of what it is allowed to differ."""
    eigenvalues = EIGENVALUES.get(name, 0.0)
    return record[name] + share * (NUMBERS[name] * abs(record[name]) + eigenvalues)


def test_every_claim_is_in_one_of_the_lists_and_the_rest_has_a_reason(
    smoke_run: Path, record: dict[str, Any]
) -> None:
    """A claim added to `verify` has to be shown to be able to fail."""
    verified = verify(smoke_run)
    claims = {finding.claim for finding in verified}
    certificates = {
        claim for claim in claims if claim.startswith("certificate.") and claim not in FILES
    }
    assert verified.holds
    assert len(certificates) == 7
    listed = {*NUMBERS, *COUNTS, *WORDS, *ABSENT, *REQUESTED, *FILES}
    assert claims - certificates == listed - MEMBERS
    upper_limit = {*claims, *verified.unchecked}
    assert {name for name, value in record.items() if value is not None} <= upper_limit
    signals = verified.unchecked.values()
    assert all(signals)
    assert verified.summary().startswith(
        f"{len(claims)} of {len(claims)} claims hold; {len(verified.unchecked)} not "
    )


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
    return (
        not value
        if isinstance(value, bool)
        else value + 1
        if isinstance(value, int | float)
        else f"{value}_"
    )


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
    kept = read_simulation(smoke_run / "validation.mcap")
    told = "riccati; not positive definite in exact arithmetic"
    observer = replace(run.design.observer, certified=False, solver_status=told)
    missed = replace(run.design, observer=observer)  # type: ignore[arg-type]
    shown = measure_mismatch(run.model, kept.records, kept.start_up_samples)
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
        (seal,) = (finding for finding in verify(copied_run) if finding.claim == "files")
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


def test_a_file_that_the_manifest_does_not_know_is_named(copied_run: Path) -> None:
    """The report draws it: nothing unsealed lies beside the run's files."""
    invented(copied_run, seal=False)
    assert failing(copied_run) == {"comparison.csv"}


def test_the_command_ends_with_one_line_and_speaks_json(
    smoke_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
