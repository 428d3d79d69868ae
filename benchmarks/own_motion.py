"""Which logs are refused because their output moves by itself, or runs away.

    python -m benchmarks.own_motion --aside --to results/reference/evidence     (five minutes on one
    core)
    python -m benchmarks.own_motion --drawn --to results/reference/evidence     (a minute)

`--aside`: 20 logs that had no part in setting the limits of
`ssm_study/evidence/autonomous_motion.py` and `feedback.py`, each fitted by `ssm_study.fit` as it is
by default. Writes own_motion.csv: level of the evidence, first reason against any judgement, the
shares of the output's power that follow from where each piece begins and from the input, the fit.
`--drawn`: 1,500 stable open-loop logs and 1,500 integrators in open loop, of 300 to 1,500 samples
each, with no model fitted. Writes own_motion_drawn.csv: how many of them are taken for outputs that
run away.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.signal import lfilter

import ssm_study as st
from benchmarks.feedback_shares import drawn, levels, opened
from ssm_study.evidence.autonomous_motion import predicted_power_shares
from ssm_study.evidence.feedback import judge_instability
from ssm_study.evidence.finding import CANNOT_JUDGE, EvidenceCase
from ssm_study.evidence.metrics import collect_findings
from ssm_study.models.metrics import Simulation
from ssm_study.robustness.mismatch import measure_model_error

sys.path += [
    str(Path(__file__).resolve().parents[1] / folder) for folder in ("tests", "tests/laws")
]
from test_evidence_controls import multilevel

COUNT = 1500
STEP_S = 0.1
U = multilevel(4000, 21)
MOVES = "moves by itself"
GROWS = "grows"
LOOP = "held by a loop"
HONEST = "honest"
PLANTS: dict[str, Callable] = {  # dx/dt of the state x under the input u
    "fitzhugh": lambda x, u: (
        x[0] - x[0] ** 3 / 3 - x[1] + 0.6 + 0.1 * u,
        0.1 * (x[0] + 0.7 - 0.8 * x[1]),
    ),
    "lotka": lambda x, u: (x[0] * (1 - x[1] + 0.05 * u), x[1] * (x[0] - 1)),
    "lorenz": lambda x, u: (
        10 * (x[1] - x[0]),
        x[0] * (28 - x[2]) - x[1] + u,
        x[0] * x[1] - 8 / 3 * x[2],
    ),
    "van_der_pol": lambda x, u: (x[1], 0.5 * (1 - x[0] ** 2) * x[1] - 2 * x[0] + 0.5 * u),
    "duffing": lambda x, u: (x[1], -0.2 * x[1] - x[0] - x[0] ** 3 + 2 * u),
    "resonance 0.02": lambda x, u: (
        x[1],
        -2 * 0.02 * 0.7 * x[1] - 0.7 * 0.7 * x[0] + 0.7 * 0.7 * u,
    ),
    "resonance 0.005": lambda x, u: (
        x[1],
        -2 * 0.005 * 1.3 * x[1] - 1.3 * 1.3 * x[0] + 1.3 * 1.3 * u,
    ),
}
Samples = np.ndarray


def integrated(plant: str, samples: int, x: list[float], held_s: float = 0.1) -> Samples:
    f = PLANTS[plant]
    state = np.array(x, float)
    y = np.zeros(samples)
    d = held_s / 20
    for k, level in enumerate(U[:samples]):
        y[k] = state[0]
        for _ in range(20):  # midpoint steps
            state = state + d * np.array(f(state + d / 2 * np.array(f(state, level)), level))
    return y


def noisy(y: Samples, share: float) -> Samples:
    return y + share * np.std(y) * np.random.default_rng(5).standard_normal(len(y))


def lag(samples: int, pole: float, gain: float, x: float = 0.0) -> Samples:
    return lfilter([0, gain], [1, -pole], U[:samples]) + x * pole ** np.arange(samples)


def relay(samples: int) -> Samples:
    y = np.zeros(samples)
    x = 0.0
    on = 1.0
    for k, level in enumerate(U[:samples]):
        y[k], on = x, -1.0 if x > 0.5 else 1.0 if x < -0.5 else on
        x = 0.97 * x + 0.03 * (1.5 * on + 0.2 * level)
    return y


def pendulum() -> tuple[Samples, Samples]:
    noise = 0.0005 * np.random.default_rng(11).standard_normal(1500)
    r = 0.3 * multilevel(1500, 14)
    angle = 0.05
    rate = 0.0
    u = np.zeros(1500)
    y = np.zeros(1500)
    for k in range(1500):
        y[k] = angle + noise[k]
        u[k] = np.clip(25 * (r[k] - y[k]) - 4 * rate, -20, 20)
        for _ in range(10):
            angle, rate = (
                angle + 0.005 * rate,
                rate + 0.005 * (9.81 * np.sin(angle) - 0.2 * rate + u[k]),
            )
    return u, y


def aside() -> list[tuple[str, str, Samples, Samples]]:
    """Name, what it is, input, output."""
    slow = U
    moved = 0.05 * U[:2000]
    for pole in (0.95, 0.9, 0.8):
        slow = lfilter([0, 1 - pole], [1, -pole], slow)
    walk = np.random.default_rng(9).standard_normal
    steps = np.random.default_rng(3).standard_normal(1500)
    made = [
        ("relay oscillator", MOVES, noisy(relay(1500), 0.01)),
        ("FitzHugh-Nagumo", MOVES, noisy(integrated("fitzhugh", 2000, [0, 0], 0.5), 0.02)),
        ("Lotka-Volterra", MOVES, noisy(integrated("lotka", 1500, [1.5, 1]), 0.02)),
        ("Lorenz", MOVES, noisy(integrated("lorenz", 2000, [1, 1, 20], 0.03), 0.01)),
        (
            "growing swing",
            GROWS,
            noisy(lfilter([0, 0.1], [1, -2 * 1.003 * np.cos(0.15), 1.003**2], U[:1000]), 0.01),
        ),
        *(
            (f"runaway reactor, {n} samples", GROWS, noisy(lag(n, 1.0025, 0.02), 0.03))
            for n in (1200, 500)
        ),
        (
            "van der Pol, five times the input",
            MOVES,
            noisy(integrated("van_der_pol", 2000, [0.1, 0]), 0.05),
        ),
        *(
            (f"three lags, noise {share}", HONEST, noisy(slow[:1500], share))
            for share in (0.2, 1.0, 1.5)
        ),
        ("resonance, damping 0.02", HONEST, noisy(integrated("resonance 0.02", 2000, [1, 0]), 0.3)),
        (
            "resonance, damping 0.005",
            HONEST,
            noisy(integrated("resonance 0.005", 1000, [2, 0]), 0.1),
        ),
        *(
            (f"integrator, noise {size}", HONEST, np.cumsum(moved + size * walk(2000)))
            for size in (0.01, 0.05)
        ),
        ("Wiener", HONEST, noisy(np.tanh(3 * slow[:1500]) + 0.3 * slow[:1500] ** 2, 0.05)),
        ("drift", HONEST, slow[:1500] + 0.5 * np.std(slow) * np.cumsum(steps) / 20),
        ("decay from afar", HONEST, noisy(lag(1500, 0.995, 0.05, 8.0), 0.03)),
        ("Duffing", HONEST, noisy(integrated("duffing", 2000, [0, 0]), 0.02)),
    ]
    held = ("inverted pendulum under PD", LOOP, *pendulum())
    return [*((name, kind, U[: len(y)], y) for name, kind, y in made), held]


def judged(name: str, kind: str, u: Samples, y: Samples) -> dict[str, object]:
    model = st.fit(u, y, STEP_S)
    data, fitted, skip = model.data, model.simulator, model.data.start_up_samples
    validation, test = (
        Simulation.simulate_records(fitted, part, skip) for part in (data.validation, data.test)
    )
    found = collect_findings(
        data,
        fitted,
        validation,
        test,
        measure_model_error(fitted, data.validation, skip, data.mismatch_records),
    )
    shares = predicted_power_shares(
        EvidenceCase(data=data, model=fitted, validation=validation, test=test)
    ) or (None, None)
    against = next((one.sentence for one in found.findings if one.level == CANNOT_JUDGE), None)
    told: dict[str, object] = {
        "log": name,
        "kind": kind,
        "evidence": found.level,
        "cannot_judge": against,
    }
    return told | {
        "share_own": shares[0],
        "share_input": shares[1],
        "fit_test_percent": test.fit_percent,
    }


def integrator(rng: np.random.Generator) -> tuple[Samples, Samples]:
    """Input and output of an integrator behind a lag, with sensor noise and a walk of disturbances,
    or without."""
    samples = int(rng.integers(300, 1501))
    u = levels(rng, samples)
    walk = rng.choice([0, 0.02, 0.2])
    noise = rng.choice([0, 0.05, 0.3])
    pole = rng.uniform(0, 0.9)
    drawn_noise = rng.standard_normal((samples, 2))  # the sensor's, the plant's
    steps = 0.1 * lfilter([1 - pole], [1, -pole], u) + walk * drawn_noise[:, 1]
    return u, np.append(0.0, np.cumsum(steps)[:-1]) + noise * drawn_noise[:, 0]


def refused(log: Callable) -> int:
    once = (replace(data, validation=(), test=()) for data in drawn(log, COUNT))
    return sum(any(judge_instability(data, is_closed_loop=False)) for data in once)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--aside", action="store_true")
    parser.add_argument("--drawn", action="store_true")
    parser.add_argument("--to", type=Path, required=True)
    asked = parser.parse_args()
    rows = []
    asked.to.mkdir(parents=True, exist_ok=True)
    if asked.drawn:
        counts = [("stable", COUNT, refused(opened)), ("integrators", COUNT, refused(integrator))]
        table = pd.DataFrame(counts, columns=["logs", "count", "refused"])
        table.to_csv(asked.to / "own_motion_drawn.csv", index=False, lineterminator="\n")
    for entry in aside() if asked.aside else ():
        rows.append(judged(*entry))
        pd.DataFrame(rows).to_csv(
            asked.to / "own_motion.csv", index=False, lineterminator="\n", float_format="%.4g"
        )
