"""`verify`: believe nothing of a run but its files, and derive every claim of its record from them again.

What is recomputed: the seals of the files; the slopes of the scaffoldings from their break points; both theorems in
exact rational arithmetic on the stored matrices; the frontier; the fits and the mismatch margin from the recordings;
the controller's inputs from the measured outputs with the certified gains; and what the closed loop did. Not the fit on
the training records, which are not kept; not Gramians, coverage, the solver's opinion and times, which decide nothing.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from ssm_study.bounds.scaffolds import certified_balls
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.metrics import behaviour, bound_columns
from ssm_study.loop.regulation import ClosedLoop
from ssm_study.models.free_run import free_run
from ssm_study.models.identified import SSM
from ssm_study.models.stored import model_from_json
from ssm_study.refusal import BadRequest, require
from ssm_study.results.facts import design_facts, linear_facts, rmse_over, slope_facts
from ssm_study.results.recordings import RecordedLoop, Simulation, read_rollouts, read_simulation
from ssm_study.results.records import FAILED, INFEASIBLE, OK, RECORD, read_record
from ssm_study.results.store import intact_manifest
from ssm_study.signals import fit_percent
from ssm_study.synthesis.certificate import Design, Infeasible, StateFeedback
from ssm_study.synthesis.integral import controlled_system
from ssm_study.synthesis.verify import broken_claims

FLOAT_AGREEMENT = 1e-9
"""Relative: the same float64 formula on another machine's libraries."""
ITERATED_AGREEMENT = 1e-6
"""Relative: what an iteration or a thousand steps produce (eigenvalues, frontier, norms, replayed trajectories)."""

EIGENVALUE_RESOLUTION = 1e-12
"""Absolute: what rounding moves the smallest eigenvalue of a matrix with unit diagonal."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One claim of the record, whether it holds, and what was found."""

    claim: str
    holds: bool
    found: str

    def __str__(self) -> str:
        return f"{'holds' if self.holds else 'FAILS'}  {self.claim}: {self.found}"


def verify(run: Path) -> list[Finding]:
    """Every claim of the run, re-derived. Raises `BadRequest` if `run` is no finished run folder."""
    record = read_record(run)
    require(record is not None, "run", run, f"there is no {RECORD}", "give the folder of one run")
    assert record is not None
    status = record["status"]
    require(status != FAILED, "run", run, "the run failed and claims nothing", f"see {run / 'traceback.txt'}")
    findings = [_seal(run, status)]
    certified = (run / "certificate.json").is_file() or "controller_certified" in record
    for claims in (_model, _certificate, _fits, _loop) if certified else (_fits,):  # a baseline claims its fits only
        findings += _guarded(claims, run, record)
    return findings


def _guarded(
    claims: Callable[[Path, dict[str, Any]], Iterator[Finding]], run: Path, record: dict[str, Any]
) -> list[Finding]:
    """A file that cannot be read is a claim that does not hold."""
    try:
        return list(claims(run, record))
    except (BadRequest, OSError, ValueError, KeyError, TypeError) as error:
        return [
            Finding(
                claim=claims.__name__.strip("_"),
                holds=False,
                found=f"cannot be derived: {' '.join(str(error).split())}",
            )
        ]


def _seal(run: Path, status: str) -> Finding:
    sealed = status in (OK, INFEASIBLE) and intact_manifest(run) is not None
    return Finding(
        claim="files", holds=sealed, found="as they were written" if sealed else f"changed since (status {status})"
    )


def _model(run: Path, record: dict[str, Any]) -> Iterator[Finding]:
    model = _read_model(run)
    yield from _same(record, linear_facts(model), ITERATED_AGREEMENT)
    yield from _same(record, slope_facts(model), FLOAT_AGREEMENT)


def _certificate(run: Path, record: dict[str, Any]) -> Iterator[Finding]:
    model, content = _read_model(run), _read_json(run / "certificate.json")
    balls = certified_balls(model)
    design = Design.from_json(content)
    feedback = design.state_feedback
    controlled = controlled_system(model, feedback.k) if isinstance(feedback, StateFeedback) else model.linear
    broken = broken_claims(content, model.linear, balls, controlled)
    for side, part in (("state_feedback", feedback), ("observer", design.observer)):
        wrong = [sentence for sentence in broken if sentence.startswith(side)]
        why = part.reason if isinstance(part, Infeasible) else part.solver_status
        found = f"exact arithmetic finds it {'certified' if part.certified else f'without certificate: {why}'}"
        yield Finding(
            claim=f"certificate.{side} at rate {part.rate:.6g}", holds=not wrong, found="; ".join(wrong) or found
        )
    validation = read_simulation(run / "validation.mcap")
    facts = design_facts(design, model, balls, validation.records, validation.start_up_samples)
    yield from _same(record, facts, ITERATED_AGREEMENT)


def _fits(run: Path, record: dict[str, Any]) -> Iterator[Finding]:
    model = model_from_json(_read_json(run / "model.json"))
    for name, file in (("fit_validation_percent", "validation.mcap"), ("fit_test_percent", "test.mcap")):
        kept = read_simulation(run / file)
        again = [free_run(model, r, kept.start_up_samples) for r in kept.records]
        pairs = zip(again, kept.simulated, strict=True)
        apart = max(float(np.abs(a - b).max() / np.abs(a).max()) for a, b in pairs)
        yield Finding(
            claim=f"{file} /simulated", holds=apart <= FLOAT_AGREEMENT, found=f"model.json replays it to {apart:.1e}"
        )
        yield from _same(record, {name: _fit(kept, again)}, FLOAT_AGREEMENT)
    yield from _same(record, {"rmse_test": rmse_over(model, kept.records, kept.start_up_samples)}, FLOAT_AGREEMENT)


def _fit(kept: Simulation, simulated: list[np.ndarray]) -> float:
    skip = kept.start_up_samples
    measured = np.concatenate([record.y[skip:] for record in kept.records])
    return fit_percent(measured, np.concatenate([y[skip:] for y in simulated]))


def _loop(run: Path, record: dict[str, Any]) -> Iterator[Finding]:
    design = Design.load(run / "certificate.json")
    feedback, observer = design.state_feedback, design.observer
    if isinstance(feedback, Infeasible) or isinstance(observer, Infeasible):
        return
    controller = ObserverFeedback.of(_read_model(run), design)
    kept, on_model = read_rollouts(run / "closed_loop.mcap"), read_rollouts(run / "closed_loop_model.mcap")
    apart = replay_error(controller, kept, *input_limits(run))
    yield Finding(
        claim="closed_loop.mcap input",
        holds=apart <= ITERATED_AGREEMENT,
        found=f"the certified gains give it from the measured output to {apart:.1e}",
    )
    derived, bounds = _behaviour(kept), bound_columns(kept.run, on_model.run, feedback, observer)
    missing_in_older = {"estimate_decay_rate", "certified_bound_excess_plant"} - set(record)
    derived |= {name: value for name, value in bounds.items() if name not in missing_in_older}
    yield from _same(record, derived, FLOAT_AGREEMENT)


def _behaviour(kept: RecordedLoop) -> dict[str, Any]:
    """The columns of `loop.metrics.behaviour` that the recording decides: an older one lacks the input at rest."""
    rest = np.zeros(kept.run.u.shape[2]) if kept.input_equilibrium is None else kept.input_equilibrium
    loop = ClosedLoop(
        controlled=kept.run,
        uncontrolled=kept.alone or kept.run,
        on_model=None,
        settling_band=kept.settling_band,
        input_equilibrium=rest,
    )
    unknown = {"input_peak_v", "control_energy"} if kept.input_equilibrium is None else set()
    unknown |= {"settling_time_open_loop_s"} if kept.alone is None else set()
    return {name: value for name, value in behaviour(loop).items() if name not in unknown}


def input_limits(run: Path) -> tuple[float, float]:
    """`loop.input_lower`, `loop.input_upper` of the run's own configuration, unit of the input; infinite for none."""
    configuration = OmegaConf.load(run / ".hydra" / "config.yaml")
    lower, upper = (OmegaConf.select(configuration, f"loop.input_{side}") for side in ("lower", "upper"))
    return -np.inf if lower is None else float(lower), np.inf if upper is None else float(upper)


def replay_error(
    controller: ObserverFeedback, kept: RecordedLoop, lower: float = -np.inf, upper: float = np.inf
) -> float:
    """Largest `|u - u_again| / max |u|` over cases that stayed: `u_again` from the recorded measurements alone.

    `u_again` is cut at the limits that the controller knew of; an integrator replays its own hold at a limit.
    """
    run = kept.run
    stayed, targets = run.stayed, controller.targets(run.reference)
    memory, worst = controller.start(int(stayed.sum())), 0.0
    for k in range(run.u.shape[1]):
        applied, measured = run.u[stayed, k], run.measured[stayed, k]
        again = np.clip(controller.input(memory, measured, targets[k]), lower, upper)
        worst = float(np.abs(again - applied).max(initial=worst))
        memory = controller.advance(memory, applied, measured, targets[k])
    return worst / max(float(np.abs(run.u).max()), np.finfo(float).tiny)


def _same(record: dict[str, Any], derived: dict[str, Any], relative: float) -> Iterator[Finding]:
    for name, value in derived.items():
        stored = record.get(name)
        stored = float(stored) if stored in ("inf", "-inf") else stored
        holds = _agrees(stored, value, relative, _resolution(name))
        yield Finding(claim=name, holds=holds, found=f"{value}" if holds else f"derived {value}, stored {stored}")


def _agrees(stored: Any, value: Any, relative: float, resolution: float) -> bool:
    """Equal, or finite numbers as near as two machines' roundings."""
    if isinstance(value, float) and np.isfinite(value) and type(stored) in (int, float):
        return abs(stored - value) <= relative * abs(value) + resolution
    return bool(stored == value)


def _resolution(name: str) -> float:
    return EIGENVALUE_RESOLUTION if name in ("controller_margin", "observer_margin") else 0.0


def _read_model(run: Path) -> SSM:
    return SSM.from_json(_read_json(run / "model.json"))


def _read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))
