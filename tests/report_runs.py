"""Run folders with made-up but schema-true content, for testing what reads and exports them. Never
a result."""

import json
from pathlib import Path

import numpy as np

from ssm_study.bounds.network import Network
from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.integral_action import internal_model
from ssm_study.certificates.theorems.observer import ObserverOfBall
from ssm_study.certificates.theorems.state_feedback import StateFeedbackOfBall
from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.mlp import MlpScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.models.scaffolds.residual import ResidualScaffold
from ssm_study.models.scaffolds.scaffold import Scaffold
from ssm_study.signals import Channel, Scale
from ssm_study.systems import StateSpace, error_input_matrix

KINDS = ("linear", "mlp", "monotone", "residual")
ORDER = 4


def random_run(
    folder: Path, *, kind: str, channels: int, seed: int, integral: bool | list[str] = False
) -> Path:
    """A stable model with a gentle controller; the certificate's numbers are placeholders of the
    right shape."""
    rng = np.random.default_rng(seed)
    model = random_model(rng, kind, channels)
    design = random_design(rng, model, integral)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.json").write_text(json.dumps(model.to_json()))
    design.save(folder / "certificate.json")
    return folder


def random_model(rng: np.random.Generator, kind: str, channels: int) -> SSM:
    a = rng.standard_normal((ORDER, ORDER))
    d = 0.1 * rng.standard_normal((channels, channels))
    b = rng.standard_normal((ORDER, channels))
    c = rng.standard_normal((channels, ORDER))
    return SSM(
        linear=StateSpace(a=0.6 * a / np.abs(np.linalg.eigvals(a)).max(), b=b, c=c, d=d),
        scaffold_in=random_scaffold(rng, kind, channels),
        scaffold_out=random_scaffold(rng, kind, channels),
        scale=Scale(
            input_scale=rng.uniform(0.5, 2, channels),
            output_scale=rng.uniform(0.5, 2, channels),
            input_equilibrium=rng.standard_normal(channels),
            output_equilibrium=rng.standard_normal(channels),
        ),
        step_s=0.01,
    )


def random_scaffold(rng: np.random.Generator, kind: str, channels: int) -> Scaffold:
    if kind == "linear":
        return LinearScaffold(
            gain=np.eye(channels) + 0.1 * rng.standard_normal((channels, channels))
        )
    if kind == "mlp":
        return MlpScaffold(network=_network(rng, channels, (5, 6)))
    if kind == "monotone":
        breaks = np.sort(rng.standard_normal((channels, 5)), axis=1)
        return MonotoneScaffold(breakpoints=breaks, slopes=rng.uniform(0.1, 1, (channels, 6)))
    network = _network(rng, channels, (5,))
    return ResidualScaffold(alpha=0.7, beta=0.3, network=network, multipliers=(np.ones(5),))


def _network(rng: np.random.Generator, channels: int, hidden: tuple[int, ...]) -> Network:
    widths = (channels, *hidden, channels)
    pairs = list(zip(widths[1:], widths[:-1], strict=True))
    return Network(
        weights=tuple(rng.standard_normal(shape) / np.sqrt(shape[1]) for shape in pairs),
        biases=tuple(rng.standard_normal(h) for h in hidden),
        negative_slopes=tuple(np.full(h, 0.1) for h in hidden),
        positive_slopes=tuple(rng.uniform(0.5, 1, h) for h in hidden),
    )


def random_design(rng: np.random.Generator, model: SSM, integral: bool | list[str]) -> Design:
    (n, m), p, linear = model.linear.b.shape, model.scale.outputs, model.linear
    shared = {
        "alpha": 0.5,
        "beta": 0.1,
        "rate": 0.2,
        "certified": True,
        "margin": 0.1,
        "condition": 1.0,
    }
    shared |= {"rate_limit": 0.4, "method": "placeholder", "solver_status": "none", "seconds": 0.0}
    a = linear.a
    b = linear.b
    if integral:  # of one output a ramp and a sine, of several outputs constants, unless named
        named = (
            integral
            if isinstance(integral, list)
            else ["ramp", "sine(5Hz)"]
            if p == 1
            else ["step"]
        )
        modes = internal_model(named, model.step_s, p)
        fed = error_input_matrix(modes, p) @ (0.7 * np.eye(p))
        a = np.block([[a, np.zeros((n, len(modes)))], [fed @ linear.c, modes]])
        b = np.vstack([b, fed @ linear.d])
    k = 0.1 * rng.standard_normal((m, len(a)))
    l = 0.05 * rng.standard_normal((n, p))  # noqa: E741
    wide = np.eye(len(a))
    eye = np.eye(n)
    return Design(
        state_feedback=StateFeedbackOfBall(a=a, b=b, p=wide, y=wide, x=k, sigma=1.0, k=k, **shared),
        observer=ObserverOfBall(a=linear.a, c=linear.c, q=eye, u=eye, v=l, eta=1.0, l=l, **shared),
    )


def write_recordings(run: Path, *, seed: int = 0) -> Path:
    """`validation.mcap`, `excitation.mcap` and `closed_loop.mcap` with ten made-up cases, as a
    study leaves them."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(200) * 0.01
    u = np.sign(rng.standard_normal((200, 1))) * 5
    y = rng.standard_normal((200, 1))
    volt = (Channel(name="armature_voltage", unit="V"),)
    speed = (Channel(name="load_speed", unit="rad/s"),)

    def group(topic: str, channels: tuple[Channel, ...], values: np.ndarray) -> SignalGroup:
        return SignalGroup(topic=topic, time_s=time_s, channels=channels, values=values)

    signals = [("/input", volt, u), ("/measured", speed, y), ("/simulated", speed, 0.9 * y)]
    for name in ("validation", "test"):
        written = tuple(group(*signal) for signal in signals)
        write_mcap(run / f"{name}.mcap", written, {"step_s": "0.01"})
    records = [group(f"/record_{i}/input", volt, rng.uniform(-5, 5, (200, 1))) for i in range(3)]
    write_mcap(run / "excitation.mcap", tuple(records), {})
    cases = []
    for i, start in enumerate(rng.uniform(-4, 4, 11)):
        decay = start * np.exp(-time_s / 0.05)[:, None]
        cases += [
            group(f"/case_{i}/reference", speed, 0 * y),
            group(f"/case_{i}/output", speed, decay),
        ]
        cases += [group(f"/case_{i}/input", volt, -decay)]
        cases += [group(f"/case_{i}/uncontrolled", speed, np.sqrt(np.abs(decay)))]
    write_mcap(run / "closed_loop.mcap", tuple(cases), {"settling_band": "0.5"})
    rows = [
        f"{name},{case},0.9,0.1,0.2,3.0" for name in ("pi", "auto") for case in ("nominal", "delay")
    ]
    head = "controller,situation,stable_fraction,"
    head += "settling_time_mean_s,settling_time_open_loop_s,input_peak_v"
    (run / "comparison.csv").write_text("\n".join([head, *rows]) + "\n")
    (run / "training_curve.json").write_text(
        json.dumps([{"epoch": k, "loss_training": 1 / (k + 1)} for k in range(9)])
    )
    return run
