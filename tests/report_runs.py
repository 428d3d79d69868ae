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
    content = model.to_json()
    text = json.dumps(content)
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
    scaffolds = {
        "scaffold_in": random_scaffold(rng, kind, channels),
        "scaffold_out": random_scaffold(rng, kind, channels),
    }
    input_scale = rng.uniform(0.5, 2, channels)
    output_scale = rng.uniform(0.5, 2, channels)
    scales = {"input_scale": input_scale, "output_scale": output_scale}
    input_equilibrium = rng.standard_normal(channels)
    output_equilibrium = rng.standard_normal(channels)
    scale = Scale(
        **scales, input_equilibrium=input_equilibrium, output_equilibrium=output_equilibrium
    )
    return SSM(linear=linear, scale=scale, step_s=0.01, **scaffolds)


def random_scaffold(rng: np.random.Generator, kind: str, channels: int) -> Scaffold:
    if kind == "linear":
        white_noise = rng.standard_normal((channels, channels))
        gain = np.eye(channels) + 0.1 * white_noise
        return LinearScaffold(gain=gain)
    if kind == "mlp":
        hidden = (5, 6)
        network = _network(rng, channels, hidden)
        return MlpScaffold(network=network)
    if kind == "monotone":
        white_noise = rng.standard_normal((channels, 5))
        breaks = np.sort(white_noise, axis=1)
        shape = (channels, 6)
        slopes = rng.uniform(0.1, 1, shape)
        return MonotoneScaffold(breakpoints=breaks, slopes=slopes)
    network = _network(rng, channels, (5,))
    multipliers = (np.ones(5),)
    return ResidualScaffold(alpha=0.7, beta=0.3, network=network, multipliers=multipliers)


def _network(rng: np.random.Generator, channels: int, hidden: tuple[int, ...]) -> Network:
    widths = (channels, *hidden, channels)
    weights = []
    for rows, columns in zip(widths[1:], widths[:-1], strict=True):
        white_noise = rng.standard_normal((rows, columns))
        weights.append(white_noise / np.sqrt(columns))
    biases = tuple(rng.standard_normal(width) for width in hidden)
    negative_slopes = tuple(np.full(width, 0.1) for width in hidden)
    positive_slopes = tuple(rng.uniform(0.5, 1, width) for width in hidden)
    slopes = {"negative_slopes": negative_slopes, "positive_slopes": positive_slopes}
    return Network(weights=tuple(weights), biases=biases, **slopes)


PLACEHOLDER_NUMBERS = {"alpha": 0.5, "beta": 0.1, "rate": 0.2, "rate_limit": 0.4}
PLACEHOLDER_OUTCOME = {"certified": True, "margin": 0.1, "condition": 1.0}
PLACEHOLDER_WORDS = {"method": "placeholder", "solver_status": "none", "seconds": 0.0}
PLACEHOLDERS = PLACEHOLDER_NUMBERS | PLACEHOLDER_OUTCOME | PLACEHOLDER_WORDS


def add_internal_model(model: SSM, integral: bool | list[str]) -> tuple[np.ndarray, np.ndarray]:
    """State and input matrix with an internal model: of one output a ramp and a sine, of several
    outputs constants, unless named."""
    linear = model.linear
    outputs = model.scale.outputs
    if isinstance(integral, list):
        signals = integral
    elif outputs == 1:
        signals = ["ramp", "sine(5Hz)"]
    else:
        signals = ["step"]
    modes = internal_model(signals, model.step_s, outputs)
    gain_of_errors = 0.7 * np.eye(outputs)
    error_inputs = error_input_matrix(modes, outputs) @ gain_of_errors
    no_coupling = np.zeros((len(linear.a), len(modes)))
    own_states = [linear.a, no_coupling]
    model_states = [error_inputs @ linear.c, modes]
    a = np.block([own_states, model_states])
    b = np.vstack([linear.b, error_inputs @ linear.d])
    return a, b


def random_design(rng: np.random.Generator, model: SSM, integral: bool | list[str]) -> Design:
    linear = model.linear
    n, m = linear.b.shape
    p = model.scale.outputs
    a = linear.a
    b = linear.b
    if integral:
        a, b = add_internal_model(model, integral)
    white_noise = rng.standard_normal((m, len(a)))
    k = 0.1 * white_noise
    white_noise = rng.standard_normal((n, p))
    l = 0.05 * white_noise  # noqa: E741
    wide = np.eye(len(a))
    eye = np.eye(n)
    variables = {"p": wide, "y": wide, "x": k, "sigma": 1.0}
    state_feedback = StateFeedbackOfBall(a=a, b=b, k=k, **variables, **PLACEHOLDERS)
    variables = {"q": eye, "u": eye, "v": l, "eta": 1.0}
    observer = ObserverOfBall(a=linear.a, c=linear.c, l=l, **variables, **PLACEHOLDERS)
    return Design(state_feedback=state_feedback, observer=observer)


TIME_S = np.arange(200) * 0.01
VOLT = (Channel(name="armature_voltage", unit="V"),)
SPEED = (Channel(name="load_speed", unit="rad/s"),)


def make_group(topic: str, channels: tuple[Channel, ...], values: np.ndarray) -> SignalGroup:
    """Signals of one topic, at the times that all made-up records share."""
    return SignalGroup(topic=topic, time_s=TIME_S, channels=channels, values=values)


def make_closed_loop_case(i: int, start: float) -> list[SignalGroup]:
    """One made-up closed loop that decays from its start."""
    envelope = np.exp(-TIME_S / 0.05)
    decay = start * envelope[:, None]
    slow_decay = np.sqrt(np.abs(decay))
    reference = make_group(f"/case_{i}/reference", SPEED, 0 * decay)
    output = make_group(f"/case_{i}/output", SPEED, decay)
    applied = make_group(f"/case_{i}/input", VOLT, -decay)
    uncontrolled = make_group(f"/case_{i}/uncontrolled", SPEED, slow_decay)
    return [reference, output, applied, uncontrolled]


def write_recordings(run: Path, *, seed: int = 0) -> Path:
    """`validation.mcap`, `excitation.mcap` and `closed_loop.mcap` with ten made-up cases, as a
    study leaves them."""
    rng = np.random.default_rng(seed)
    white_noise = rng.standard_normal((200, 1))
    u = np.sign(white_noise) * 5
    y = rng.standard_normal((200, 1))
    simulated = 0.9 * y
    groups = (
        make_group("/input", VOLT, u),
        make_group("/measured", SPEED, y),
        make_group("/simulated", SPEED, simulated),
    )
    for name in ("validation", "test"):
        metadata = {"step_s": "0.01"}
        write_mcap(run / f"{name}.mcap", groups, metadata)
    records = []
    for i in range(3):
        levels = rng.uniform(-5, 5, (200, 1))
        records.append(make_group(f"/record_{i}/input", VOLT, levels))
    write_mcap(run / "excitation.mcap", tuple(records), {})
    cases: list[SignalGroup] = []
    start_outputs = rng.uniform(-4, 4, 11)
    for i, start in enumerate(start_outputs):
        cases += make_closed_loop_case(i, start)
    metadata = {"settling_band": "0.5"}
    write_mcap(run / "closed_loop.mcap", tuple(cases), metadata)
    write_comparison(run)
    return run


def write_comparison(run: Path) -> None:
    """`comparison.csv` of two controllers in two situations, and a `training_curve.json`."""
    rows = ["controller,situation,stable_fraction,"]
    rows[0] += "settling_time_mean_s,settling_time_open_loop_s,input_peak_v"
    for name in ("pi", "auto"):
        rows.append(f"{name},nominal,0.9,0.1,0.2,3.0")
        rows.append(f"{name},delay,0.9,0.1,0.2,3.0")
    text = "\n".join(rows)
    path = run / "comparison.csv"
    path.write_text(text + "\n")
    curve = [{"epoch": k, "loss_training": 1 / (k + 1)} for k in range(9)]
    text = json.dumps(curve)
    (run / "training_curve.json").write_text(text)
