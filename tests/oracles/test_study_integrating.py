"""An integrating plant, a motor's position, through the whole line: from its log to rest on the true plant."""

import numpy as np
import pytest

import ssm_study as st
from ssm_study.loop.controller import ObserverFeedback


def moved(x: np.ndarray, volts: float) -> np.ndarray:
    """Speed and position."""
    return np.array([0.8 * x[0] + 0.2 * volts, x[1] + 0.05 * x[0]])


def test_a_position_is_identified_certified_doubted_and_brought_to_rest() -> None:
    rng, x = np.random.default_rng(0), np.zeros(2)
    u = rng.uniform(-1, 1, 200).repeat(10)
    u, y = np.concatenate([u - u.mean(), np.zeros(200)]), []
    for volts in u:
        y.append(x[1] + 0.01 * rng.standard_normal())
        x = moved(x, volts)
    words = (
        "model.order=2",
        "model=ssm",
        "model.hidden_width=4",
        "data.equilibrium=zero",
        "model.slope_lower=0.3",
        "training.max_epochs=30",
        "loop.horizon_s=10",
        "loop.initial_conditions=2",
    )
    design = st.control(st.fit(u, np.array(y), 0.05, *words))
    assert design.record["fit_test_percent"] > 90
    assert design.record["spectral_radius"] > 0.999
    assert design.certificate.certified
    assert design.record["evidence"] == "doubt"
    assert "The output integrates its input" in design.record["evidence_reasons"]
    assert "data.decimate" not in design.record["evidence_reasons"]
    law = ObserverFeedback.of(design.model, design.certificate)
    limits, rest = (design.record["limit_lower"], design.record["limit_upper"]), law.targets(np.zeros((1, 1)))[0]
    for start in (0.2, -2.0):  # from positions far beyond one step
        x, memory = np.array([0.0, start]), law.start(1)
        for _ in range(800):
            seen = x[None, 1:]
            applied = np.clip(law.input(memory, seen, rest), *limits)
            memory, x = law.advance(memory, applied, seen, rest), moved(x, float(applied[0, 0]))
        assert x == pytest.approx([0, 0], abs=1e-3 * abs(start))
