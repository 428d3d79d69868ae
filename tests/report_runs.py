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
    text = json.dumps(model.to_json())
    (folder / "model.json").write_text(text)
    design.save(folder / "certificate.json")
    return folder


def random_model(rng: np.random.Generator, kind: str, channels: int) -> SSM:
    a = rng.standard_normal((ORDER, ORDER))
    white_noise = rng.standard_normal((channels, channels))
    d = 0.1 * white_noise
    b = rng.standard_normal((ORDER, channels))
    c = rng.standard_normal((channels, ORDER))
    eigenvalues = np.linalg.eigvals(a)
    spectral_radius = np.abs(eigenvalues).max()
    scaled = 0.6 * a / spectral_radius
    linear = StateSpace(a=scaled, b=b, c=c, d=d)
    scaffold_in = random_scaffold(rng, kind, channels)
    scaffold_out = random_scaffold(rng, kind, channels)
    input_scale = rng.uniform(0.5, 2, channels)
    output_scale = rng.uniform(0.5, 2, channels)
    input_equilibrium = rng.standard_normal(channels)
    output_equilibrium = rng.standard_normal(channels)
    scale = Scale(
        input_scale=input_scale,
        output_scale=output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
    )
    return SSM(
        linear=linear, scaffold_in=scaffold_in, scaffold_out=scaffold_out, scale=scale, step_s=0.01
    )


def random_scaffold(rng: np.random.Generator, kind: str, channels: int) -> Scaffold:
    if kind == "linear":
        white_noise = rng.standard_normal((channels, channels))
        gain = np.eye(channels) + 0.1 * white_noise
        return LinearScaffold(gain=gain)
    if kind == "mlp":
        hidden = (5, 6)
        mlp_scaffold_network = _network(rng, channels, hidden)
        return MlpScaffold(network=mlp_scaffold_network)
    if kind == "monotone":
        white_noise = rng.standard_normal((channels, 5))
        breaks = np.sort(white_noise, axis=1)
        slopes = rng.uniform(0.1, 1, (channels, 6))
        return MonotoneScaffold(breakpoints=breaks, slopes=slopes)
    network = _network(rng, channels, (5,))
    multipliers = (np.ones(5),)
    return ResidualScaffold(alpha=0.7, beta=0.3, network=network, multipliers=multipliers)


def _network(rng: np.random.Generator, channels: int, hidden: tuple[int, ...]) -> Network:
    widths = (channels, *hidden, channels)
    pairs = list(zip(widths[1:], widths[:-1], strict=True))
    weights = tuple(rng.standard_normal(shape) / np.sqrt(shape[1]) for shape in pairs)
    biases = tuple(rng.standard_normal(h) for h in hidden)
    negative_slopes = tuple(np.full(h, 0.1) for h in hidden)
    positive_slopes = tuple(rng.uniform(0.5, 1, h) for h in hidden)
    return Network(
        weights=weights,
        biases=biases,
        negative_slopes=negative_slopes,
        positive_slopes=positive_slopes,
    )


def random_design(rng: np.random.Generator, model: SSM, integral: bool | list[str]) -> Design:
    linear_b = model.linear.b
    outputs = model.scale.outputs
    n, m = linear_b.shape
    p = outputs
    linear = model.linear
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
        if isinstance(integral, list):
            named = integral
        else:
            named = ["ramp", "sine(5Hz)"] if p == 1 else ["step"]
        modes = internal_model(named, model.step_s, p)
        gain_of_errors = 0.7 * np.eye(p)
        fed = error_input_matrix(modes, p) @ (gain_of_errors)
        no_coupling = np.zeros((n, len(modes)))
        a = np.block([[a, no_coupling], [fed @ linear.c, modes]])
        b = np.vstack([b, fed @ linear.d])
    white_noise = rng.standard_normal((m, len(a)))
    k = 0.1 * white_noise
    white_noise = rng.standard_normal((n, p))
    l = 0.05 * white_noise  # noqa: E741
    wide = np.eye(len(a))
    eye = np.eye(n)
    state_feedback = StateFeedbackOfBall(a=a, b=b, p=wide, y=wide, x=k, sigma=1.0, k=k, **shared)
    observer = ObserverOfBall(a=linear.a, c=linear.c, q=eye, u=eye, v=l, eta=1.0, l=l, **shared)
    return Design(state_feedback=state_feedback, observer=observer)


def write_recordings(run: Path, *, seed: int = 0) -> Path:
    """`validation.mcap`, `excitation.mcap` and `closed_loop.mcap` with ten made-up cases, as a
    study leaves them."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(200) * 0.01
    white_noise = rng.standard_normal((200, 1))
    u = np.sign(white_noise) * 5
    y = rng.standard_normal((200, 1))
    channel = Channel(name="armature_voltage", unit="V")
    volt = (channel,)
    channel = Channel(name="load_speed", unit="rad/s")
    speed = (channel,)

    def group(topic: str, channels: tuple[Channel, ...], values: np.ndarray) -> SignalGroup:
        return SignalGroup(topic=topic, time_s=time_s, channels=channels, values=values)

    signals = [("/input", volt, u), ("/measured", speed, y), ("/simulated", speed, 0.9 * y)]
    for name in ("validation", "test"):
        written = tuple(group(*signal) for signal in signals)
        metadata = {"step_s": "0.01"}
        write_mcap(run / f"{name}.mcap", written, metadata)
    records = [group(f"/record_{i}/input", volt, rng.uniform(-5, 5, (200, 1))) for i in range(3)]
    write_mcap(run / "excitation.mcap", tuple(records), {})
    cases = []
    start_outputs = rng.uniform(-4, 4, 11)
    for i, start in enumerate(start_outputs):
        envelope = np.exp(-time_s / 0.05)
        decay = start * envelope[:, None]
        signal_group = group(f"/case_{i}/reference", speed, 0 * y)
        cases += [signal_group, group(f"/case_{i}/output", speed, decay)]
        signal_group = group(f"/case_{i}/input", volt, -decay)
        cases += [signal_group]
        slow_decay = np.sqrt(np.abs(decay))
        signal_group = group(f"/case_{i}/uncontrolled", speed, slow_decay)
        cases += [signal_group]
    metadata = {"settling_band": "0.5"}
    write_mcap(run / "closed_loop.mcap", tuple(cases), metadata)
    write_comparison(run)
    return run


def write_comparison(run: Path) -> None:
    """`comparison.csv` of two controllers in two situations, and a `training_curve.json`."""
    names = ("pi", "auto")
    rows = [f"{name},{case},0.9,0.1,0.2,3.0" for name in names for case in ("nominal", "delay")]
    head = "controller,situation,stable_fraction,"
    head += "settling_time_mean_s,settling_time_open_loop_s,input_peak_v"
    text = "\n".join([head, *rows])
    (run / "comparison.csv").write_text(text + "\n")
    curve = [{"epoch": k, "loss_training": 1 / (k + 1)} for k in range(9)]
    text = json.dumps(curve)
    (run / "training_curve.json").write_text(text)
