"""What a log from a closed loop does to the model: python benchmarks/closed_loop_log.py (a minute).

`x+ = 0.9 x + 0.1 u` under `u = 3 (r - y)` or in open loop, `y` with white noise or a slow drift of the same power, half
of what the input moves: gain at rest and pole of the model of order one, of u -> y and of r -> y.
"""

import numpy as np

import ssm_study as st

SAMPLES, POLE, GAIN, NOISE, DRIFT = 4000, 0.9, 3.0, 0.15, 0.95
OVERRIDES = ("model.order=1", "model.hidden_width=4", "data.equilibrium=zero", "model.slope_lower=0.5")


def log(gain: float, colour: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reference, input and measured output."""
    rng = np.random.default_rng(0)
    r, w = rng.uniform(-1, 1, SAMPLES // 10).repeat(10), NOISE * rng.standard_normal(SAMPLES)
    u, y, x, drift = np.zeros(SAMPLES), np.zeros(SAMPLES), 0.0, 0.0
    for k in range(SAMPLES):
        drift = colour * drift + np.sqrt(1 - colour**2) * w[k]
        y[k] = x + drift
        u[k] = gain * (r[k] - y[k]) if gain else r[k]
        x = POLE * x + (1 - POLE) * u[k]
    return r, u, y


if __name__ == "__main__":
    for gain, colour in ((0.0, 0.0), (0.0, DRIFT), (GAIN, 0.0), (GAIN, DRIFT)):
        r, u, y = log(gain, colour)
        truth = {"u": (1.0, POLE), "r": (gain / (1 + gain), POLE - (1 - POLE) * gain)}
        for name, given in {"u": u, **({"r": r} if gain else {})}.items():
            model = st.fit(given, y, 0.1, *OVERRIDES).to_control()
            at_rest, pole = float(np.squeeze(model.dcgain())), float(np.real(model.poles()[0]))
            loop, noise = "closed" if gain else "open", "drift" if colour else "white"
            print(f"{loop:6} {noise} {name} -> y: gain {at_rest:.3f} of {truth[name][0]:.3f}, ", end="")
            print(f"pole {pole:.3f} of {truth[name][1]:.3f}", flush=True)
