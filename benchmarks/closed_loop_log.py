"""What a log from a closed loop does to the model.

    python benchmarks/closed_loop_log.py --to results/reference/evidence        (a minute)

`x+ = 0.9 x + 0.1 u` under `u = 3 (r - y)` or in open loop, `y` with white noise or a slow drift of
the same power, half of what the input moves: gain at rest and pole of the one-layer model of order
one, mean and root mean square error of five seeds: of u -> y, of u -> y where the controller is
named (`data.controller`), and of r -> y. Writes closed_loop_log.csv.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

import ssm_study as st

SAMPLES = 4000
POLE = 0.9
GAIN = 3.0
NOISE = 0.15
DRIFT = 0.95
SEEDS = 5
OVERRIDES = (
    "model=ssm",
    "model.order=1",
    "model.hidden_width=4",
    "data.equilibrium=zero",
    "model.slope_lower=0.5",
)
NAMED = f"data.controller=[{GAIN},1e9]"  # it has no integral


def log(gain: float, colour: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reference, input and measured output."""
    rng = np.random.default_rng(seed)
    r = rng.uniform(-1, 1, SAMPLES // 10).repeat(10)
    w = NOISE * rng.standard_normal(SAMPLES)
    u = np.zeros(SAMPLES)
    y = np.zeros(SAMPLES)
    x = 0.0
    drift = 0.0
    for k in range(SAMPLES):
        drift = colour * drift + np.sqrt(1 - colour**2) * w[k]
        y[k] = x + drift
        u[k] = gain * (r[k] - y[k]) if gain else r[k]
        x = POLE * x + (1 - POLE) * u[k]
    return r, u, y


def row(gain: float, colour: float, route: str) -> dict[str, object]:
    """What the models of all seeds come to."""
    truth = (gain / (1 + gain), POLE - (1 - POLE) * gain) if route == "r" else (1.0, POLE)
    found = []
    for seed in range(SEEDS):
        r, u, y = log(gain, colour, seed)
        named = (NAMED,) if route == "u, named" else ()
        model = st.fit(r if route == "r" else u, y, 0.1, *OVERRIDES, *named).to_control()
        found.append((float(np.squeeze(model.dcgain())), float(np.real(model.poles()[0]))))
    told: dict[str, object] = {
        "noise": "drift" if colour else "white",
        "loop": "closed" if gain else "open",
    }
    told["input"] = route
    for name, true, values in zip(("gain", "pole"), truth, np.transpose(found), strict=True):
        told |= {
            name: true,
            f"{name}_mean": values.mean(),
            f"{name}_error": np.sqrt(np.mean((values - true) ** 2)),
        }
    return told


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--to", type=Path, required=True)
    to = parser.parse_args().to
    to.mkdir(parents=True, exist_ok=True)
    routes = ((0.0, "u"), (GAIN, "u"), (GAIN, "u, named"), (GAIN, "r"))
    rows = [row(gain, colour, route) for colour in (0.0, DRIFT) for gain, route in routes]
    pd.DataFrame(rows).to_csv(
        to / "closed_loop_log.csv", index=False, lineterminator="\n", float_format="%.4g"
    )
