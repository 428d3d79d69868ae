"""`verify` against a liar: each claim altered alone is named alone, and only beyond its tolerance.

Everything is sealed anew after an alteration, and what depends on it made consistent: the lie has
to be found, not the seal.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from docs_commands import FEW

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import digest
from ssm_study.cli.main import main
from ssm_study.data.mcap import read_mcap, write_mcap
from ssm_study.data.recorded import RecordedData
from ssm_study.durable import sealed, sha256_of_file, unsealed, write_json_atomically
from ssm_study.engine.records import read_record, write_record
from ssm_study.engine.runs import seal_run
from ssm_study.loop.metrics import behaviour, certified
from ssm_study.models.metrics import Simulation, fit_facts
from ssm_study.models.warm_start import PAST, choose_piece_starts, start_facts
from ssm_study.plants.wrapper import Wrapper
from ssm_study.refusal import BadRequest
from ssm_study.robustness.mismatch import measure_mismatch
from ssm_study.study.claims import SECTIONS
from ssm_study.study.claims import data as section_data
from ssm_study.study.claims import loop as section_loop
from ssm_study.study.findings import Checked, Derived, NotChecked
from ssm_study.study.loop_recordings import read_experiment
from ssm_study.study.recordings import read_simulation, states_to_text
from ssm_study.study.run_files import RunFiles
from ssm_study.study.verify import _short, compared, judge, verify
from ssm_study.synthesis.deployed import outputs_of
from ssm_study.synthesis.metrics import design_facts
from ssm_study.table.columns import declared
from ssm_study.table.gather import MARKS, gather

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
REQUESTED = ("study", "run", "status", "seed", "fresh_sets", "order", "hidden_width", "slope_lower",
             "slope_upper", "model",
             "scaffold_in", "scaffold_out", "plant", "excitation", "synthesis_method",
             "rates_chosen", "data_source",
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


@pytest.fixture(scope="module")
def derived(smoke_run: Path, record: dict[str, Any]) -> dict[str, Any]:
    """Columns derived from the files of the run."""
    run = RunFiles(path=smoke_run, record=record)
    found = [
        item.columns for section in SECTIONS for item in section(run) if isinstance(item, Derived)
    ]
    return {name: value for columns in found for name, value in columns.items()}


@pytest.fixture(scope="module")
def record(smoke_run: Path) -> dict[str, Any]:
    found = read_record(smoke_run)
    assert found is not None
    return found


@pytest.fixture
def copied_run(smoke_run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(smoke_run, tmp_path / smoke_run.name)


def named(record: dict[str, Any], derived: dict[str, Any]) -> set[str]:
    judged = [judge(name, record, derived, {}) for name in {*derived, *record}]
    return {
        finding.claim for finding in judged if isinstance(finding, Checked) and not finding.holds
    }


def failing(run: Path) -> set[str]:
    return {finding.claim for finding in verify(run) if not finding.holds}


def moved(record: dict[str, Any], name: str, share: float) -> float:
    """The number of the record moved by `share` of what it is allowed to differ."""
    return record[name] + share * (NUMBERS[name] * abs(record[name]) + EIGENVALUES.get(name, 0.0))


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
    assert claims - certificates == {*NUMBERS, *COUNTS, *WORDS, *ABSENT, *REQUESTED, *FILES}
    assert {name for name, value in record.items() if value is not None} <= {
        *claims,
        *verified.unchecked,
    }
    assert all(verified.unchecked.values())
    assert verified.summary().startswith(
        f"{len(claims)} of {len(claims)} claims hold; {len(verified.unchecked)} not "
    )


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_is_named_beyond_its_tolerance_and_not_within(
    name: str, record: dict[str, Any], derived: dict[str, Any]
) -> None:
    for share in (-0.9, 0.9):
        assert named(record | {name: moved(record, name, share)}, derived) == set()
    wrongs = (
        moved(record, name, -1.1),
        moved(record, name, 1.1),
        -1 - record[name],
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
        if value is not None and not (column := declared(name)).unchecked:  # type: ignore[union-attr]
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
        assert compared("mismatch_margin", stored, np.inf).holds is holds


def test_a_part_without_certificate_is_recorded_with_its_reason(
    smoke_run: Path, record: dict[str, Any]
) -> None:
    """The matrices are those of another rate; the reason is the record's, and a claim like any
    other."""
    run = RunFiles(path=smoke_run, record=record)
    kept = read_simulation(smoke_run / "validation.mcap")
    told = "riccati; not positive definite in exact arithmetic"
    missed = replace(
        run.design, observer=replace(run.design.observer, certified=False, solver_status=told)
    )  # type: ignore[arg-type]
    shown = measure_mismatch(run.model, kept.records, kept.start_up_samples)
    for made, reason in ((run.design, None), (missed, f"observer: {told}")):
        facts = design_facts(made, run.model, certified_balls(run.model), shown)
        assert facts.get("uncertified_reason") == reason


def test_the_seal_says_what_it_found(copied_run: Path) -> None:
    for change, holds, found in (
        ("", True, "as they were written"),
        (" ", False, "changed since: model.json"),
    ):
        path = copied_run / "model.json"
        path.write_text(path.read_text() + change)
        (seal,) = (finding for finding in verify(copied_run) if finding.claim == "files")
        assert (seal.holds, seal.found) == (holds, found)
        assert str(seal) == f"{'holds' if holds else 'FAILS'}  files: {found}"


def altered(
    run: Path, file: str, topic: str, change: Callable[[np.ndarray], object], **about: str
) -> None:
    groups, told = read_mcap(run / file)
    assert any(group.topic.endswith(topic) for group in groups)

    def of(group: Any) -> Any:
        values = group.values.copy()
        change(values)
        return replace(group, values=values) if group.topic.endswith(topic) else group

    write_mcap(run / file, tuple(of(group) for group in groups), told | about)


def sealed_anew(run: Path, **claims: Any) -> None:
    seal_run(run)
    write_record(run, (read_record(run) or {}) | claims)


def edited(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def loop_again(run: Path) -> dict[str, Any]:
    """The columns that the altered recordings would give."""
    kept, _ = read_experiment(run)
    return behaviour(kept) | certified(kept, RunFiles(path=run, record={}).design)


def fits_again(run: Path) -> dict[str, Any]:
    model = RunFiles(path=run, record={}).model
    pair = (read_simulation(run / f"{name}.mcap") for name in ("validation", "test"))
    return fit_facts(*(Simulation.of(model, kept.records, kept.start_up_samples) for kept in pair))


def levenberg_marquardt_step(values: np.ndarray) -> None:
    """Comes to rest sooner."""
    values[1:] *= 0.5


def nothing(_: np.ndarray) -> None: ...


def lie_about_loop(run: Path, topic: str, file: str = "closed_loop.mcap") -> None:
    altered(run, file, topic, levenberg_marquardt_step)
    sealed_anew(run, **loop_again(run))


def lie_about_reference(run: Path) -> None:
    """Forge the reference of one case alone: the reader took that of the first for all."""
    altered(run, "closed_loop_model.mcap", "/case_1/reference", lambda r: np.add(r, 0.1, out=r))
    sealed_anew(run)


def lie_about_record(run: Path, file: str) -> None:
    altered(run, file, "/measured", lambda y: np.multiply(y, 1.01, out=y))
    sealed_anew(run, **fits_again(run))


def lie_about_band(run: Path) -> None:
    altered(run, "closed_loop.mcap", "/case_0/output", nothing, settling_band="1.5")
    sealed_anew(run, **loop_again(run))


def lie_about_observer(run: Path, columns: dict[str, Any], **fields: Any) -> None:
    """The certificate with these fields, its digest made anew."""

    def change(content: dict[str, Any]) -> None:
        content["observer"] |= fields
        content["observer"]["digest"] = digest(content["observer"])

    edited(run / "certificate.json", change)
    sealed_anew(run, **columns)


def lie_about_starts(run: Path) -> None:
    """Starts within the level set that are no states at rest, with the outputs that they have."""
    stored = RunFiles(path=run, record={})
    model = stored.model
    part = stored.design.extra_certificates["state_feedback_unlimited"]
    farthest = part.p @ model.linear.c.T
    size = np.sqrt((model.linear.c @ farthest).item() / part.level)
    starts = (1 - 1e-9) * farthest / size
    assert type(part).holds(**(part.variables | {"starts": starts}))
    low, high = outputs_of(model, starts)
    assert high[0] > 1.5 * (read_record(run) or {})["unlimited_to"]

    def change(content: dict[str, Any]) -> None:
        entry = content["state_feedback_unlimited"]
        entry["starts"] = starts.tolist()
        entry["digest"] = digest(entry)

    edited(run / "certificate.json", change)
    sealed_anew(run, unlimited_from=float(low[0]), unlimited_to=float(high[0]))


def lie_about_excitation(run: Path) -> None:
    altered(run, "excitation.mcap", "/record_0/input", levenberg_marquardt_step)
    sealed_anew(run)


def lie_about_configuration(run: Path, old: str, new: str, **columns: Any) -> None:
    path = run / ".hydra" / "config.yaml"
    assert path.read_text().count(old) == 1
    path.write_text(path.read_text().replace(old, new))
    sealed_anew(run, **columns)


def lie_about_labels(
    run: Path, file: str, change: Callable[[Any], Any] = lambda group: group, **words: str
) -> None:
    """Beside the numbers, which stay."""
    groups, told = read_mcap(run / file)
    write_mcap(run / file, tuple(change(group) for group in groups), told | words)
    sealed_anew(run)


def in_thousands(group: Any) -> Any:
    return replace(group, channels=tuple(replace(one, unit="krpm") for one in group.channels))


def sooner(group: Any) -> Any:
    return replace(group, time_s=group.time_s / 2)


def lie_twice(run: Path, file: str = "certificate.json", key: str = '"rate":') -> None:
    """Who reads the first of two equal keys sees another rate than who reads the last."""
    path = run / file
    path.write_text(path.read_text().replace(key, f"{key} 0.99, {key}", 1))
    sealed_anew(run)


def lie_beside(run: Path) -> None:
    """Where no reader looks."""

    def change(content: dict[str, Any]) -> None:
        part = content["observer_deployed"] | {"certified_rate": 0.99}
        content["observer_deployed"] = part | {"digest": digest(part)}

    edited(run / "certificate.json", change)
    sealed_anew(run)


def without(run: Path, name: str) -> None:
    (run / name).unlink()
    sealed_anew(run)


def lie_about_trial(run: Path) -> None:
    """Milder than it was: the mismatch it shows would be smaller."""
    altered(run, "trials.mcap", "/record_1/measured", levenberg_marquardt_step)
    sealed_anew(run)


def lie_about_evidence(run: Path) -> None:
    (run / "evidence.json").write_text("[]")
    sealed_anew(run)


def invented(run: Path, seal: bool) -> None:
    (run / "comparison.csv").write_text("controller,situation,settled\nours,nominal,1\n")
    sealed_anew(run) if seal else None


def lie_about_model(run: Path, **entries: Any) -> None:
    edited(run / "model.json", lambda model: model.update(entries))
    sealed_anew(run)


pytestmark = pytest.mark.usefixtures("made_once")

MODEL_LOOP = "closed_loop_model.mcap"
# Each: a consistent lie about one thing, sealed anew, and a claim that has to name it.
LIES: dict[str, tuple[Callable[[Path], object], str]] = {
    "infeasible, with 4 of 4 settled": (lambda run: sealed_anew(run, status="infeasible"),
                                        "status"),
    "sampling time of the model": (lambda run: lie_about_model(run, step_s=0.02),
                                   "model.json step_s"),
    "true output at rest sooner": (lambda run: lie_about_loop(run, "/output"), "closed_loop.mcap"),
    "slower without control": (lambda run: lie_about_loop(run, "/case_0/uncontrolled"),
                               "closed_loop.mcap"),
    "smaller inputs": (lambda run: lie_about_loop(run, "/input"), "closed_loop.mcap input"),
    "estimate": (lambda run: lie_about_loop(run, "/estimate"), "closed_loop.mcap"),
    "states": (lambda run: lie_about_loop(run, "/case_1/states"), "closed_loop.mcap"),
    "a reference of the second case": (
        lie_about_reference,
        "loop",
    ),
    "the loop on the model": (lambda run: lie_about_loop(run, "/states", MODEL_LOOP), MODEL_LOOP),
    "wider settling band": (lie_about_band, "closed_loop.mcap"),
    "twice as fast": (lambda run: lie_about_labels(run, MODEL_LOOP, sooner),
                      f"{MODEL_LOOP} labels"),
    "another unit": (lambda run: lie_about_labels(run, "test.mcap", in_thousands),
                     "test.mcap labels"),
    "another plant": (lambda run: lie_about_labels(run, "closed_loop.mcap", plant="Rig"),
                      "closed_loop.mcap labels"),
    "a note": (lambda run: lie_about_labels(run, "excitation.mcap", on="the machine"),
               "excitation.mcap labels"),
    "a rate said twice": (lie_twice, "certificate"),
    "a key of the model said twice": (lambda run: lie_twice(run, "model.json", '"step_s":'),
                                      "model"),
    "a word in the model": (lambda run: lie_about_model(run, quality="high"), "model.json entries"),
    "a rate beside the certificate": (lie_beside, "certificate.json entries"),
    "an empty column": (lambda run: sealed_anew(run, quality=None), "quality"),
    "validation record": (lambda run: lie_about_record(run, "validation.mcap"),
                          "validation.mcap records"),
    "test record": (lambda run: lie_about_record(run, "test.mcap"), "test.mcap records"),
    "excitation": (lie_about_excitation, "excitation.mcap"),
    "margin": (lambda run: lie_about_observer(run, {"observer_margin": 0.5}, margin=0.5),
               "certificate.observer"),
    "condition": (lambda run: lie_about_observer(run, {}, condition=1.0), "certificate.observer"),
    "method": (lambda run: lie_about_observer(run, {}, method="lmi"), "certificate.observer"),
    "starts that do not rest": (lie_about_starts, "certificate starts"),
    "no certificate, claims kept": (lambda run: without(run, "certificate.json"),
                                    "certificate.json"),
    "no closed loop, claims kept": (lambda run: without(run, "closed_loop.mcap"),
                                    "closed_loop.mcap"),
    "a trial": (lambda run: lie_about_trial(run), "trials.mcap records"),
    "evidence": (lambda run: lie_about_evidence(run), "evidence.json"),
    "a comparison that nobody made": (lambda run: invented(run, seal=True), "comparison.csv"),
    "no configuration": (lambda run: without(run, ".hydra/config.yaml"), ".hydra/config.yaml"),
    "seed": (lambda run: lie_about_configuration(run, "seed: 0\nloop", "seed: 1\nloop", seed=1),
             "run"),
    "order": (lambda run: lie_about_configuration(run, "order: 4", "order: 6", order=6), "run"),
    "noise": (lambda run: lie_about_configuration(run, "noise_factor: 1.0", "noise_factor: 0.1"),
              "closed_loop.mcap"),
}  # fmt: skip


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
    index = unsealed((study / MARKS).read_bytes()) or {}
    sums = {"runs.parquet": sha256_of_file(study / "runs.parquet")}
    write_json_atomically(
        study / MARKS, sealed({k: v for k, v in index.items() if k != "sha256"} | sums)
    )
    assert gather(study)["fit_test_percent"].item() == 99.9
    assert main([command, str(study)]) == 0
    assert "99.9" not in capsys.readouterr().out
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

        @property
        def data(self) -> Any:
            raise BadRequest("data.path", "log.csv", "no such file", "check the spelling")

    (found,) = section_data(Elsewhere())  # type: ignore[arg-type]
    assert isinstance(found, NotChecked)
    told = {"predicted_stable": True}
    assert "cannot be read" in judge("predicted_stable", told, told, found.reasons)  # type: ignore[operator]
    assert compared("predicted_stable", True, True).holds


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
    (run / ".hydra" / "config.yaml").write_text("results_dir: results\nstudy: mine\nrun: order2\n")
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    u = np.random.default_rng(0).standard_normal(200)
    log = (made if "was made" in place else elsewhere) / "log.csv"
    pd.DataFrame({"u": u, "y": np.cumsum(u)}).to_csv(log, index=False)
    source = RecordedData(path="log.csv", input="u", output="y", step_s=0.1)
    files = RunFiles(path=run, record={})
    vars(files)["specification"] = SimpleNamespace(plant=None, seed=0, refine=None, data=source)
    assert sum(map(len, (*files.data.training, *files.data.validation, *files.data.test))) == 200
    assert Path.cwd() == elsewhere


class Rig(Wrapper):
    """A device, for `verify` alone."""

    real = True  # type: ignore[assignment]


def test_of_a_device_the_loop_on_the_model_is_made_again(copied_run: Path) -> None:
    """Its violations of the certified bound are a claim on the model, whatever the loop was closed
    on."""

    def found() -> tuple[set[str], dict[str, str]]:
        run = RunFiles(path=copied_run, record=read_record(copied_run) or {})
        vars(run)["specification"] = replace(
            run.specification, plant=Rig(plant=run.specification.plant)
        )
        told = list(section_loop(run))
        wrong = {one.claim for one in told if isinstance(one, Checked) and not one.holds}
        return wrong, {
            name: why
            for one in told
            if isinstance(one, NotChecked)
            for name, why in one.reasons.items()
        }

    recorded_on = "closed_loop.mcap loop_on"  # here the plant that was simulated
    assert found() == (
        {recorded_on},
        {"closed_loop.mcap output, states": "recorded on a device, which is not run again"},
    )
    lie_about_loop(copied_run, "/states", MODEL_LOOP)
    assert found()[0] == {recorded_on, MODEL_LOOP}


def logged(folder: Path) -> list[str]:
    """The words for a log of a system that answers its input at once."""
    u = np.random.default_rng(0).uniform(-3, 3, 120).repeat(5)
    x = np.zeros(len(u) + 1)
    for k in range(len(u)):
        x[k + 1] = 0.9 * x[k] + 0.2 * np.tanh(u[k])
    pd.DataFrame({"u": u, "y": x[:-1] + 0.1 * u}).to_csv(folder / "log.csv", index=False)
    return [
        "data=recorded",
        f"data.path={folder}/log.csv",
        "data.input=u",
        "data.output=y",
        "data.step_s=0.1",
    ]


def test_a_run_without_controller_has_no_certificate_and_no_loop(
    copied_run: Path, tmp_path: Path
) -> None:
    """Invented beside an infeasible run or a baseline, they would be drawn as its own."""
    beyond = [
        "experiment=smoke",
        "+data.trials=false",
        "synthesis=riccati",
        "synthesis.rate_controller=0.999",
    ]
    baseline = [*logged(tmp_path), "model=gru", "training.max_epochs=1"]
    for study, asked in {"none": beyond, "baseline": baseline}.items():
        assert (
            main(["run", *asked, "progress=false", f"results_dir={tmp_path}", f"study={study}"])
            == 0
        )
        (run,) = (path.parent for path in (tmp_path / study).glob("*/record.json"))
        assert failing(run) == set()
        assert (read_record(run) or {})["model"] == {"none": "ssm", "baseline": "gru"}[study]
        for name in ("certificate.json", "closed_loop.mcap")[study == "none" :]:
            shutil.copy(copied_run / name, run / name)
        sealed_anew(run)
        assert failing(run) == {"certificate.json", "closed_loop.mcap"} - {
            "certificate.json" * (study == "none")
        }


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
        "training.max_epochs=5",
    ]
    shape += [f"+synthesis.{name}={values}".replace(" ", "") for name, values in FEW.items()]
    for study, path in {
        "idle": [],
        "neurons": ["model.input_path=free", "model.output_path=free"],
    }.items():
        assert (
            main(["run", *log, *shape, *path, f"study={study}", f"model.neurons={len(path)}"]) == 0
        )
        assert "certified, not tried: both certificates hold" in " ".join(
            capsys.readouterr().out.split()
        )
        (run,) = (path.parent for path in (tmp_path / study).glob("*/record.json"))
        assert ("neurons" in json.loads((run / "model.json").read_text())) == (study == "neurons")
        assert failing(run) == set()
    lie_about_start(run)
    missed = failing(run)
    print(missed)
    assert missed >= {"test.mcap start", "validation.mcap start"}


def lie_about_start(run: Path) -> None:
    """Free runs from the start that the records do not prefer, with the fits that they have."""
    files = RunFiles(path=run, record={})
    starts = choose_piece_starts(files.model, files.data)
    fitted = []
    for split in ("validation", "test"):
        states = getattr(starts, split)
        assert starts.choice is not None
        forged = (None,) * len(states) if starts.choice == PAST else states
        kept = read_simulation(run / f"{split}.mcap")
        made = Simulation.of(files.model, kept.records, kept.start_up_samples, forged)
        groups, about = read_mcap(run / f"{split}.mcap")
        signals = iter(made.simulated)
        forged_groups = [
            replace(group, values=next(signals)) if group.topic.endswith("/simulated") else group
            for group in groups
        ]
        about = dict(about) | {"start_states": states_to_text(forged)}
        write_mcap(run / f"{split}.mcap", tuple(forged_groups), about)
        fitted.append(made)
    fits = fit_facts(*fitted)
    sealed_anew(run, **fits, **start_facts(files.model, files.data, fitted[1]))


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


DAMAGES: dict[str, Callable[[Path], object]] = {
    "a part is null": lambda run: edited(
        run / "certificate.json", lambda c: c.update(observer=None)
    ),
    "a part is a list": lambda run: edited(
        run / "certificate.json", lambda c: c.update(state_feedback=[1])
    ),
    "a number of 400 digits": lambda run: edited(
        run / "certificate.json", lambda c: c["observer"].update(eta=10**400)
    ),
    "a matrix of such": lambda run: edited(run / "model.json", lambda m: m.update(a=[[10**400]])),
    "the model is a list": lambda run: (run / "model.json").write_text("[]"),
    "the model is no json": lambda run: (run / "model.json").write_text("{"),
    "broken yaml": lambda run: (run / ".hydra" / "config.yaml").write_text("a: [b"),
    "yaml of another kind": lambda run: (run / ".hydra" / "config.yaml").write_text("- 1"),
    "a recording cut": lambda run: (run / "test.mcap").write_bytes(
        (run / "test.mcap").read_bytes()[:-500]
    ),
    "an empty manifest": lambda run: (run / "manifest.json").write_text(""),
    "a list as manifest": lambda run: (run / "manifest.json").write_text("[]"),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_a_damaged_file_is_a_claim_that_does_not_hold(what: str, copied_run: Path) -> None:
    DAMAGES[what](copied_run)
    assert not verify(copied_run).holds


def shorter(run: Path, part: str, *names: str) -> None:
    """These matrices without their last row, those that are square without their last column,
    too."""

    def change(content: dict[str, Any]) -> None:
        for name in names:
            rows = content[part][name]
            content[part][name] = [row[:-1] if len(row) == len(rows) else row for row in rows[:-1]]

    edited(run / "certificate.json", change)


def finding(run: Path, entry: dict[str, Any]) -> None:
    (run / "evidence.json").write_text(json.dumps([entry]))


PLAIN: dict[str, tuple[Callable[[Path], object], str]] = {
    "a shape": (
        lambda run: shorter(run, "observer", "l"),
        "certificate.observer.l (shape) = (3, 1): is to be n by p, and n is 4 in a; "
        "synthesise again.",
    ),
    "a part": (
        lambda run: shorter(run, "state_feedback_unlimited", "a", "b", "p", "starts"),
        "certificate.state_feedback_unlimited.k (shape) = (1, 4): is to be m by n, and n is "
        "3 in a; synthesise again.",
    ),
    "a weight": (
        lambda run: shorter(run, "tolerance", "p"),
        "tolerance: the matrices do not fit the model",
    ),
    "a part is a text": (
        lambda run: edited(run / "certificate.json", lambda c: c.update(observer="x")),
        "certificate.observer = x: is no object; synthesise again.",
    ),
    "a word": (
        lambda run: finding(run, {"level": "grave", "sentence": "The log is short."}),
        "evidence.json [0].level = grave: unknown; use note, doubt or cannot judge.",
    ),
    "a key": (
        lambda run: finding(run, {"levl": "note"}),
        "evidence.json [0] = {'levl': 'note'}: is no finding; run the study again.",
    ),
}


@pytest.mark.parametrize("what", PLAIN)
def test_a_wrong_shape_or_word_is_told_in_a_sentence_of_ours(what: str, copied_run: Path) -> None:
    """Not in NumPy's or Python's words."""
    damage, sentence = PLAIN[what]
    damage(copied_run)
    found = [one.found for one in verify(copied_run) if not one.holds]
    assert any(one.endswith(sentence) for one in found), found
    assert not any(
        word in one
        for one in found
        for word in ("operand", "dimension", "tuple", "attribute", "argument")
    )


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
    last = capsys.readouterr().out.splitlines()[-1]
    assert main(["verify", str(smoke_run), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    held = sum(claim["holds"] for claim in said["claims"])
    assert last.startswith(
        f"{held} of {len(said['claims'])} claims hold; {len(said['not_checked'])} not checked: "
    )
    assert said["holds"] is True


def test_a_long_value_is_told_in_eighty_characters() -> None:
    assert [len(_short("x" * length)) for length in (79, 80, 81, 500)] == [79, 80, 80, 80]
