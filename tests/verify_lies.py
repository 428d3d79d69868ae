"""Alterations of a run after which all its seals are in order: each claim, told another way."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ssm_study as st
from ssm_study.certificates.certificate import certificate_digest
from ssm_study.data.mcap import read_mcap, write_mcap
from ssm_study.engine.records import read_record, write_record
from ssm_study.engine.runs import write_run_manifest
from ssm_study.loop.metrics import behaviour_columns, certified_bound_columns
from ssm_study.models.metrics import Simulation, fit_columns
from ssm_study.models.warm_start import PAST, choose_initial_state_source, initial_state_columns
from ssm_study.refusal import BadRequest
from ssm_study.study.loop_recordings import read_loop_recordings
from ssm_study.study.recordings import initial_states_to_text, read_free_runs
from ssm_study.study.run_files import RunFiles
from ssm_study.study.verify import verify
from ssm_study.synthesis.deployed import initial_output_range


def failing(run: Path) -> set[str]:
    return {finding.claim for finding in verify(run) if not finding.holds}


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
    write_run_manifest(run)
    record = (read_record(run) or {}) | claims
    write_record(run, record)


def edited(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    text = path.read_text()
    content = json.loads(text)
    change(content)
    text = json.dumps(content)
    path.write_text(text)


def loop_again(run: Path) -> dict[str, Any]:
    """The columns that the altered recordings would give."""
    kept, _ = read_loop_recordings(run)
    run_files = RunFiles(path=run, record={})
    design = run_files.design
    return behaviour_columns(kept) | certified_bound_columns(kept, design)


def fits_again(run: Path) -> dict[str, Any]:
    run_files = RunFiles(path=run, record={})
    model = run_files.model
    names = ("validation", "test")
    pair = (read_free_runs(run / f"{name}.mcap") for name in names)
    return fit_columns(
        *(Simulation.simulate_records(model, kept.records, kept.start_up_samples) for kept in pair)
    )


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
        content["observer"]["digest"] = certificate_digest(content["observer"])

    edited(run / "certificate.json", change)
    sealed_anew(run, **columns)


def lie_about_limits(run: Path) -> None:
    """Twice the room for the input: the certificate holds all the more."""
    stored = RunFiles(path=run, record={})
    part = stored.design.extra_certificates["state_feedback_unlimited"]
    wider = 2 * part.limits
    assert type(part).holds(**(part.variables | {"limits": wider}))
    lower, upper = stored.model.scale.physical_input(wider.T)

    def change(content: dict[str, Any]) -> None:
        entry = content["state_feedback_unlimited"]
        entry["limits"] = wider.tolist()
        entry["digest"] = certificate_digest(entry)

    edited(run / "certificate.json", change)
    sealed_anew(run, limit_lower=float(lower[0]), limit_upper=float(upper[0]))


def lie_about_starts(run: Path) -> None:
    """Starts within the level set that are no states at rest, with the outputs that they have."""
    stored = RunFiles(path=run, record={})
    model = stored.model
    part = stored.design.extra_certificates["state_feedback_unlimited"]
    linear_c = model.linear.c
    farthest = part.p @ linear_c.T
    item = (linear_c @ farthest).item()
    size = np.sqrt(item / part.level)
    starts = (1 - 1e-9) * farthest / size
    assert type(part).holds(**(part.variables | {"starts": starts}))
    low, high = initial_output_range(model, starts)
    unlimited_to = (read_record(run) or {})["unlimited_to"]
    lower_limit = 1.5 * unlimited_to
    assert high[0] > lower_limit

    def change(content: dict[str, Any]) -> None:
        entry = content["state_feedback_unlimited"]
        entry["starts"] = starts.tolist()
        entry["digest"] = certificate_digest(entry)

    edited(run / "certificate.json", change)
    unlimited_from = float(low[0])
    unlimited_to = float(high[0])
    sealed_anew(run, unlimited_from=unlimited_from, unlimited_to=unlimited_to)


def lie_about_excitation(run: Path) -> None:
    altered(run, "excitation.mcap", "/record_0/input", levenberg_marquardt_step)
    sealed_anew(run)


def lie_about_configuration(run: Path, old: str, new: str, **columns: Any) -> None:
    path = run / ".hydra" / "config.yaml"
    text = path.read_text()
    assert text.count(old) == 1
    text = path.read_text()
    path.write_text(text.replace(old, new))
    sealed_anew(run, **columns)


def lie_about_labels(
    run: Path, file: str, change: Callable[[Any], Any] = lambda group: group, **words: str
) -> None:
    """Beside the numbers, which stay."""
    groups, told = read_mcap(run / file)
    write_mcap(run / file, tuple(change(group) for group in groups), told | words)
    sealed_anew(run)


def in_thousands(group: Any) -> Any:
    channels = tuple(replace(one, unit="krpm") for one in group.channels)
    return replace(group, channels=channels)


def sooner(group: Any) -> Any:
    time_s = group.time_s / 2
    return replace(group, time_s=time_s)


def lie_twice(run: Path, file: str = "certificate.json", key: str = '"rate":') -> None:
    """Who reads the first of two equal keys sees another rate than who reads the last."""
    path = run / file
    text = path.read_text()
    path.write_text(text.replace(key, f"{key} 0.99, {key}", 1))
    sealed_anew(run)


def lie_beside(run: Path) -> None:
    """Where no reader looks."""

    def change(content: dict[str, Any]) -> None:
        part = content["observer_deployed"] | {"certified_rate": 0.99}
        content["observer_deployed"] = part | {"digest": certificate_digest(part)}

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


def lie_about_start(run: Path) -> None:
    """Free runs from the start that the records do not prefer, with the fits that they have."""
    files = RunFiles(path=run, record={})
    starts = choose_initial_state_source(files.model, files.data)
    fitted = []
    for split in ("validation", "test"):
        states = getattr(starts, split)
        assert starts.choice is not None
        forged = (None,) * len(states) if starts.choice == PAST else states
        kept = read_free_runs(run / f"{split}.mcap")
        made = Simulation.simulate_records(files.model, kept.records, kept.start_up_samples, forged)
        groups, about = read_mcap(run / f"{split}.mcap")
        signals = iter(made.simulated)
        forged_groups = [
            replace(group, values=next(signals)) if group.topic.endswith("/simulated") else group
            for group in groups
        ]
        about = dict(about) | {"start_states": initial_states_to_text(forged)}
        write_mcap(run / f"{split}.mcap", tuple(forged_groups), about)
        fitted.append(made)
    fits = fit_columns(*fitted)
    sealed_anew(run, **fits, **initial_state_columns(files.model, files.data, fitted[1]))


def check_seal_of_saved_model(saved: Path) -> None:
    """A test record nearer to zero than it was measured is refused; a model as a version without
    seals would have saved it is read with a warning."""
    arrays = dict(np.load(saved / "records.npz"))
    arrays["test/0/y"] = arrays["test/0/y"] * 0.99
    np.savez_compressed(saved / "records.npz", **arrays)
    with pytest.raises(BadRequest, match=r"changed since it was saved: records\.npz"):
        st.load(saved)

    def take_seal_off(content: dict[str, Any]) -> None:
        del content["files"]
        del content["sha256"]

    edited(saved / "identification.json", take_seal_off)
    with pytest.warns(UserWarning, match="has no seal"):
        st.load(saved)
