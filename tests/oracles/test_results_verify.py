"""Each claim that `verify` re-derives can fail: a number of a real run altered alone is named alone.

And only beyond its tolerance. Records are sealed anew after an alteration: the claim has to be found, not the seal.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_study.bounds.scaffolds import certified_balls
from ssm_study.data.mcap import write_mcap
from ssm_study.data.mcap_reading import read_mcap
from ssm_study.results import verify as verification
from ssm_study.results.facts import design_facts
from ssm_study.results.recordings import read_rollouts, read_simulation
from ssm_study.results.records import read_record, write_record
from ssm_study.results.verify import verify
from ssm_study.synthesis.certificate import Design, digest

# Relative tolerance of each number, written out again: what another machine's rounding may do.
ONE_FORMULA, DECOMPOSED, ITERATED = 1e-9, 1e-6, 1e-6
NUMBERS = {
    **dict.fromkeys(("hankel_largest", "hankel_smallest", "spectral_radius"), DECOMPOSED),
    **{f"{side}_slope_{end}": ONE_FORMULA for side in ("input", "output") for end in ("lower", "upper")},
    **{f"input_slope_{end}_spectral": ONE_FORMULA for end in ("lower", "upper")},
    **{f"rate_{side}": ITERATED for side in ("controller", "observer")},
    **{f"{side}_{what}": ITERATED for side in ("controller", "observer") for what in ("rate_limit", "gain_norm")},
    **{f"{side}_margin": ITERATED for side in ("controller", "observer", "mismatch", "resolved")},
    **dict.fromkeys(("mismatch_gain", "controller_radius"), ITERATED),
    **{f"fit_{record}_percent": ONE_FORMULA for record in ("validation", "test")},
    **dict.fromkeys(("rmse_test", "stable_fraction", "overshoot_worst", "input_peak_v", "control_energy"), ONE_FORMULA),
    **{f"settling_time_{which}_s": ONE_FORMULA for which in ("mean", "worst", "open_loop")},
    **dict.fromkeys(("integral_squared_error", "final_error_worst", "empirical_rate"), ONE_FORMULA),
    **dict.fromkeys(("estimate_decay_rate", "certified_bound_excess_plant"), ONE_FORMULA),
}
EIGENVALUES = {"controller_margin": 1e-12, "observer_margin": 1e-12}  # absolute, of matrices with unit diagonal
COUNTS = ("states", "initial_conditions", "stable_count", "left_bound_count", "certified_bound_violations")
PARTS = [f"{side}_{what}" for side in ("controller", "observer") for what in ("feasible", "certified")]
WORDS = ("bound_method", "predicted_stable", *PARTS)
ABSENT = ("left_bound_first_s",)  # of this run: no case left
FILES = ("files", "validation.mcap /simulated", "test.mcap /simulated", "closed_loop.mcap input")

Comparison = tuple[dict[str, Any], float]


@pytest.fixture(scope="module")
def compared(smoke_run: Path) -> list[Comparison]:
    """What one verification of the run derived, with the tolerance it was compared with."""
    kept: list[Comparison] = []
    compare = verification._same

    def kept_and_compared(record: dict[str, Any], derived: dict[str, Any], relative: float) -> Iterator[Any]:
        kept.append((derived, relative))
        return compare(record, derived, relative)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verification, "_same", kept_and_compared)
        assert all(finding.holds for finding in verify(smoke_run))
    return kept


@pytest.fixture(scope="module")
def record(smoke_run: Path) -> dict[str, Any]:
    found = read_record(smoke_run)
    assert found is not None
    return found


@pytest.fixture
def copied_run(smoke_run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(smoke_run, tmp_path / smoke_run.name)


def named(record: dict[str, Any], compared: list[Comparison]) -> set[str]:
    findings = (finding for derived, relative in compared for finding in verification._same(record, derived, relative))
    return {finding.claim for finding in findings if not finding.holds}


def failing(run: Path) -> set[str]:
    return {finding.claim for finding in verify(run) if not finding.holds}


def moved(record: dict[str, Any], name: str, share: float) -> float:
    """The number of the record moved by `share` of what it is allowed to differ."""
    return record[name] + share * (NUMBERS[name] * abs(record[name]) + EIGENVALUES.get(name, 0.0))


def test_every_claim_is_in_one_of_the_lists(smoke_run: Path) -> None:
    """A claim added to `verify` has to be shown to be able to fail."""
    claims = {finding.claim for finding in verify(smoke_run)}
    certificates = {claim for claim in claims if claim.startswith("certificate.")}
    assert len(certificates) == 2
    assert claims - certificates == {*NUMBERS, *COUNTS, *WORDS, *ABSENT, *FILES}


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_is_named_beyond_its_tolerance_and_not_within(
    name: str, record: dict[str, Any], compared: list[Comparison]
) -> None:
    for share in (-0.9, 0.9):
        assert named(record | {name: moved(record, name, share)}, compared) == set()
    for wrong in (moved(record, name, -1.1), moved(record, name, 1.1), -1 - record[name], None, "inf", "unknown"):
        if wrong != record[name]:  # a number that is zero cannot be moved by a share of itself
            assert named(record | {name: wrong}, compared) == {name}


@pytest.mark.parametrize("name", COUNTS)
def test_a_count_is_named_when_it_is_one_off(name: str, record: dict[str, Any], compared: list[Comparison]) -> None:
    for wrong in (record[name] + 1, record[name] - 1, None):
        assert named(record | {name: wrong}, compared) == {name}


@pytest.mark.parametrize("name", WORDS)
def test_a_word_is_named_when_it_is_another(name: str, record: dict[str, Any], compared: list[Comparison]) -> None:
    other = not record[name] if isinstance(record[name], bool) else f"{record[name]}_"
    for wrong in (other, None):
        assert named(record | {name: wrong}, compared) == {name}


def test_a_number_where_there_is_none_is_named(record: dict[str, Any], compared: list[Comparison]) -> None:
    for name in ABSENT:
        assert named(record | {name: 0.0}, compared) == {name}


def test_a_claim_left_out_of_the_record_is_named(record: dict[str, Any], compared: list[Comparison]) -> None:
    for name in {*NUMBERS, *COUNTS, *WORDS}:
        assert named({key: value for key, value in record.items() if key != name}, compared) == {name}


def test_a_part_without_certificate_is_recorded_with_its_reason(smoke_run: Path) -> None:
    """The matrices are those of another rate; the reason is the record's, and a claim like any other."""
    model = verification._read_model(smoke_run)
    balls, kept = certified_balls(model), read_simulation(smoke_run / "validation.mcap")
    design = Design.load(smoke_run / "certificate.json")
    told = "riccati; not positive definite in exact arithmetic"
    missed = replace(design, observer=replace(design.observer, certified=False, solver_status=told))  # type: ignore[arg-type]
    for made, reason in ((design, None), (missed, f"observer: {told}")):
        facts = design_facts(made, model, balls, kept.records, kept.start_up_samples)
        assert facts.get("uncertified_reason") == reason


def test_verify_says_why_a_part_has_no_certificate(copied_run: Path) -> None:
    content = json.loads((copied_run / "certificate.json").read_text())
    content["observer"] |= {"rate": 0.999999, "certified": False, "solver_status": "riccati; a near miss"}
    content["observer"]["digest"] = digest(content["observer"])
    (copied_run / "certificate.json").write_text(json.dumps(content))
    (said,) = (finding for finding in verify(copied_run) if finding.claim.startswith("certificate.observer"))
    assert said.holds
    assert said.found.endswith("without certificate: riccati; a near miss")
    assert {"observer_certified", "uncertified_reason"} <= failing(copied_run)  # the record claims a certificate


def test_the_input_counts_from_its_rest_and_is_no_claim_where_that_was_not_recorded(smoke_run: Path) -> None:
    kept = read_rollouts(smoke_run / "closed_loop.mcap")
    inputs = {"input_peak_v", "control_energy"}
    zero, half, unknown = (
        verification._behaviour(replace(kept, input_equilibrium=rest)) for rest in (np.zeros(1), np.full(1, 0.5), None)
    )
    assert zero.keys() - unknown.keys() == inputs
    assert {name for name in zero if zero[name] != half[name]} == inputs
    assert {name: zero[name] for name in unknown} == unknown


def test_the_seal_says_what_it_found(copied_run: Path) -> None:
    for change, holds, found in (("", True, "as they were written"), (" ", False, "changed since (status ok)")):
        path = copied_run / "model.json"
        path.write_text(path.read_text() + change)
        (seal,) = (finding for finding in verify(copied_run) if finding.claim == "files")
        assert (seal.holds, seal.found) == (holds, found)
        assert str(seal) == f"{'holds' if holds else 'FAILS'}  files: {found}"


def test_an_infinite_number_is_only_itself() -> None:
    """A margin is infinite where the gain is zero; no finite number is near to that."""
    for stored, holds in (("inf", True), ("-inf", False), (1e300, False), (2.0, False), (None, False)):
        (finding,) = verification._same({"mismatch_margin": stored}, {"mismatch_margin": np.inf}, 1e-6)
        assert finding.holds is holds


def test_a_record_sealed_anew_is_judged_by_its_numbers(copied_run: Path, record: dict[str, Any]) -> None:
    for share, expected in ((0.9, set()), (1.1, {name for name in NUMBERS if record[name]})):
        write_record(copied_run, record | {name: moved(record, name, share) for name in NUMBERS})
        assert failing(copied_run) == expected


def altered(run: Path, file: str, topic: str, change: Callable[[np.ndarray], object]) -> None:
    groups, about = read_mcap(run / file)
    assert any(group.topic == topic for group in groups)

    def of(group: Any) -> Any:
        values = group.values.copy()
        change(values)
        return replace(group, values=values) if group.topic == topic else group

    write_mcap(run / file, tuple(of(group) for group in groups), about)


def add_to_last(run: Path, file: str, topic: str, amount: float) -> None:
    def change(values: np.ndarray) -> None:
        values[-1, 0] += amount

    altered(run, file, topic, change)


def largest(run: Path, file: str, name: str) -> float:
    groups, _ = read_mcap(run / file)
    return max(float(np.abs(group.values).max()) for group in groups if group.topic.endswith(f"/{name}"))


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
    step = tolerance * largest(smoke_run, file, topic.rpartition("/")[2])
    for share in (0.9, -0.9, 1.1, -1.1):
        run = shutil.copytree(smoke_run, tmp_path / f"run{share}")
        add_to_last(run, file, topic, share * step)
        assert "files" in failing(run)
        assert (claim in failing(run)) is (abs(share) > 1)


def test_a_measured_output_that_was_another_is_named(copied_run: Path) -> None:
    altered(copied_run, "test.mcap", "/measured", lambda y: np.multiply(y, 1 + 1e-6, out=y))
    assert "fit_test_percent" in failing(copied_run)


OF_THE_OUTPUT = [
    "stable_fraction",
    "settling_time_worst_s",
    "overshoot_worst",
    "integral_squared_error",
    "final_error_worst",
]


@pytest.mark.parametrize(
    ("file", "topic", "claims"),
    [
        ("closed_loop.mcap", "/case_1/output", {"stable_count", "settling_time_mean_s", *OF_THE_OUTPUT}),
        ("closed_loop.mcap", "/case_1/uncontrolled", {"settling_time_open_loop_s"}),
        ("closed_loop.mcap", "/case_1/estimate", {"certified_bound_excess_plant"}),
        ("closed_loop_model.mcap", "/case_1/states", {"certified_bound_violations", "estimate_decay_rate"}),
    ],
)
def test_a_last_sample_a_million_away_is_named(file: str, topic: str, claims: set[str], copied_run: Path) -> None:
    add_to_last(copied_run, file, topic, 1e6)
    assert failing(copied_run) == {"files", *claims}
