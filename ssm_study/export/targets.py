"""Export of a run's controller in all formats, with its certificate."""

import hashlib
import json
import runpy
import shutil
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float
from omegaconf import OmegaConf

from ssm_study.bounds.network import PortableMap
from ssm_study.bounds.slopes import certified_balls, network_bound
from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorem import Theorem, VerificationContext
from ssm_study.certificates.theorems.integral_action import augmented, controlled_system
from ssm_study.data.mcap import read_mcap
from ssm_study.durable import write_atomically
from ssm_study.export.c import c_files
from ssm_study.export.device import Device
from ssm_study.export.onnx import onnx_model
from ssm_study.export.portable import PortableController, as_floats, portable_controller
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.stored import model_from_json
from ssm_study.models.structured import Model
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Channel, input_limits
from ssm_study.stored_yaml import read_stored_yaml
from ssm_study.synthesis.deployed import within_limits
from ssm_study.synthesis.design import failed_checks
from ssm_study.systems import Balls, JacobianBall

UNLIMITED = 1e38  # either float's largest number stands for no limit
# As long as the replay of the C code: both loops have come to rest by then, or drift visibly.
LOOP_SAMPLES = 200
HALVINGS = 12  # of the rate, where the stored one does not survive rounding: to a 4000th of it
Range = Float[np.ndarray, "c"]
_SCRIPT = Path(__file__).with_name("script.py.txt")


def export(run: Path, to: Path, *, real: str = "double", prefix: str = "controller") -> list[Path]:
    """Write the controller of a run into the folder `to` and return the files that were written.

    C in `real`, "double" or "float", whose names begin with `prefix`, and the other files of
    docs/howto_export.md. Raises `BadRequest` for a run without controller, an unknown `real`, or
    when `to` is a file.
    """
    sources = c_sources(run, real=real, prefix=prefix)
    require(not to.exists() or to.is_dir(), "to", to, "is a file", "name a folder")
    to.mkdir(parents=True, exist_ok=True)
    controller = load(run)
    about = describe(run)
    numbers = {"about": about, **controller.to_json()}
    contents = {to / name: text.encode() for name, text in sources.items()}
    contents[to / "controller.json"] = (json.dumps(numbers, indent=1) + "\n").encode()
    contents[to / "controller.py"] = _SCRIPT.read_bytes()
    contents[to / "certificate.json"] = (run / "certificate.json").read_bytes()
    if find_spec("onnx") is not None:
        contents[to / "controller.onnx"] = onnx_model(controller, about).SerializeToString()
    for path, content in contents.items():
        write_atomically(path, content, durable=False)
    return sorted(contents)


def c_sources(run: Path, *, real: str = "double", prefix: str = "controller") -> dict[str, str]:
    """File name and text of the C code of a run's controller, with input limits as `limits` gives.
    Refuses what `export` refuses."""
    controller = load(run)
    design = Design.load(run / "certificate.json")
    device = Device.of(controller, real, *limits(run))
    rates = deployed_rates(device, design)
    sides = ", ".join(f"{side.replace('_', ' ')} {rate or 'none'}" for side, rate in rates.items())
    proved = f"Rates proved for the numbers below, in {real}: {sides}."
    return c_files(
        device,
        prefix,
        about=describe(run),
        signals=_signal_lines(run, device),
        digest=hashlib.sha256((run / "certificate.json").read_bytes()).hexdigest(),
        rates=(proved, *_limit_lines(run, design, device), *_rounding_lines(run, device)),
    )


def limits(run: Path) -> tuple[Range, Range]:
    """Lower and upper limit of the input, in physical units. Infinite for a run without records.

    `loop.input_lower` and `loop.input_upper` where they were given, else what the training records
    and rest visited: beyond that range nothing is known of S_u.
    """
    visited = _recorded_range(run, "excitation.mcap", "/input")
    if visited is None:
        return np.array([-np.inf]), np.array([np.inf])
    loop = _loop_settings(run)
    scale = _model(run).scale
    inputs = [np.stack(visited[1:])]
    around_rest = scale.append_equilibrium_input(inputs)
    return input_limits(loop.get("input_lower"), loop.get("input_upper"), around_rest)


def _loop_settings(run: Path) -> dict[str, Any]:
    """Settings of the loop in a run's configuration; empty for a design without one."""
    file = run / ".hydra" / "config.yaml"
    if not file.is_file():
        return {}
    settings = OmegaConf.to_container(OmegaConf.create(read_stored_yaml(file)))
    loop = settings.get("loop") if isinstance(settings, dict) else None
    return loop if isinstance(loop, dict) else {}


def _recorded_range(
    run: Path, name: str, topic: str
) -> tuple[tuple[Channel, ...], Range, Range] | None:
    """Channels of a topic, each with the least and greatest value in the records."""
    if not (run / name).is_file():
        return None
    mcap = read_mcap(run / name)
    groups = [group for group in mcap[0] if group.topic.endswith(topic)]
    if not groups:
        return None
    values = np.concatenate([group.values for group in groups])
    channels = groups[0].channels
    return channels, values.min(axis=0), values.max(axis=0)


def _signal_lines(run: Path, device: Device) -> tuple[str, ...]:
    """Text lines, one per signal: name, unit, and the limits of an input or the range of an
    output."""
    lines: list[str] = []
    inputs = _recorded_range(run, "excitation.mcap", "/input")
    if inputs is not None:
        lines += _range_lines("input", "limited to", inputs[0], device.lower, device.upper)
    disturbances = _recorded_range(run, "excitation.mcap", "/disturbance")
    if disturbances is not None:
        lines += _range_lines("disturbance", "measured, seen from", *disturbances)
    outputs = _recorded_range(run, "validation.mcap", "/measured")
    if outputs is not None:
        lines += _range_lines("output", "seen from", *outputs)
    return tuple(lines)


def _range_lines(
    side: str, relation: str, channels: tuple[Channel, ...], lower: Range, upper: Range
) -> list[str]:
    """Text lines with the range of each channel of the inputs or of the outputs."""
    lines = []
    for j, (channel, low, high) in enumerate(zip(channels, lower, upper, strict=True)):
        values = f"{relation} {low:.6g} to {high:.6g}"
        lines.append(f"{side} {j}: {channel.name} ({channel.unit}), {values}")
    return lines


def _limit_lines(run: Path, design: Design, device: Device) -> tuple[str, ...]:
    """Sentences on what the certificate proves within the limits. Empty where it proves nothing."""
    lower = np.asarray(device.lower, dtype=float)
    upper = np.asarray(device.upper, dtype=float)
    if max(-lower.min(), upper.max()) >= UNLIMITED:
        return ()
    model = _model(run)
    if not isinstance(model, SSM):
        unproved = "Within the limits nothing is proved: the theorems on them know no neurons."
        return (unproved, *_set_point_lines(device))
    try:
        proved = within_limits(model, design, lower, upper)
    except BadRequest as refusal:
        return (str(refusal),)
    beyond = "From everywhere nothing is proved within the limits."
    if proved.everywhere:
        beyond = (
            "From everywhere the state feedback, cut at the limits, contracts at rate "
            f"{proved.everywhere.rate:.3g}, and the estimate as fast as without them."
        )
    if device.set_points is None:
        cannot_start = (
            "The limits are proved not to act from rest alone: "
            "the estimate cannot start at an output on the device."
        )
        return cannot_start, beyond
    ends = " and ".join(
        f"{low:.6g} to {high:.6g}" for low, high in zip(proved.lower, proved.upper, strict=True)
    )
    inside = (
        f"Within the limits the full rates hold from rest at outputs from {ends}, "
        "at the set point of rest."
    )
    return inside, beyond


def _set_point_lines(device: Device) -> tuple[str, ...]:
    """Text line with the largest error of set points between stored equilibria, in the output's
    scale."""
    if device.set_points is None or not device.set_points.missed:
        return ()
    missed = f"missed by at most {device.set_points.missed:.1e}."
    return (f"Set points lie on lines between stored rest points: {missed}",)


def python_control_system(run: Path) -> Any:
    """Controller of a run as a `control.NonlinearIOSystem`.

    It is what `controller.py` makes elsewhere.
    """
    with TemporaryDirectory() as folder:
        controller_path = Path(folder) / "controller.json"
        controller_path.write_text(json.dumps(load(run).to_json()))
        shutil.copyfile(_SCRIPT, Path(folder) / "controller.py")
        path = runpy.run_path(str(Path(folder) / "controller.py"))
        return path["controller"]


def load(run: Path) -> PortableController:
    """Controller of a run as plain arrays."""
    for name in ("model.json", "certificate.json"):
        is_there = (run / name).is_file()
        remedy = "name the folder of a run that reached the controller"
        require(is_there, "run", run, f"it has no {name}", remedy)
    return portable_controller(_model(run), Design.load(run / "certificate.json"))


def _model(run: Path) -> Model:
    """Stored model of a run."""
    model = model_from_json(json.loads((run / "model.json").read_text()))
    kind = type(model).__name__
    is_certifiable = isinstance(model, Model)
    require(is_certifiable, "model", kind, "has no certificate", "use model=ssm or structured")
    return model  # type: ignore[return-value]  # just asked


def describe(run: Path) -> str:
    """Line of text with the run that the controller comes from and the exact verdict on its
    certificate."""
    model = _model(run)
    design = Design.load(run / "certificate.json")
    verdict = "NOT certified"
    # An internal model behind an output map that is not linear: no theorem covers it.
    with suppress(BadRequest):
        if _is_certified(run, model, design):
            verdict = (
                f"certified for its model at rates {design.state_feedback.rate:g} (controller), "
                f"{design.observer.rate:g} (observer) per sample"
            )
    name = f"{run.resolve().parent.name}/{run.resolve().name}"
    return f"Controller of run {name}, {verdict}; see certificate.json."


def _is_certified(run: Path, model: Model, design: Design) -> bool:
    """Whether exact arithmetic confirms every claim of the stored certificate."""
    content = json.loads((run / "certificate.json").read_text())
    feedback = design.parts()[0]
    controlled = controlled_system(model, feedback)
    if not design.certified:
        return False
    return not failed_checks(content, model.system, certified_balls(model), controlled)


def _rounding_lines(run: Path, device: Device) -> tuple[str, ...]:
    """Text line with the change of the simulated loop by rounding. Empty in double precision.

    From rest one output scale off.
    """
    if device.set_points is None or device.real == "double":
        return ()
    lower = device.lower.astype(float)
    upper = device.upper.astype(float)
    exact = Device.of(load(run), "double", lower, upper)
    model = _model(run)
    output_equilibrium = model.scale.output_equilibrium
    output_scale = model.scale.output_scale
    start = exact.start(output_equilibrium + output_scale)
    difference = _loop_outputs(model, device, start) - _loop_outputs(model, exact, start)
    apart = float((np.abs(difference) / model.scale.output_scale).max())
    distance = f"by at most {apart:.1e} output scales."
    return (f"Rounding to {device.real} moves the loop on the model {distance}",)


def _loop_outputs(model: Model, device: Device, start: Float[np.ndarray, "n"]) -> Any:
    """Outputs `(T, p)` of the model in closed loop with the device, both started at `start`, until
    they settle."""
    kind = device.lower.dtype
    output_equilibrium = model.scale.output_equilibrium
    set_point = np.asarray(output_equilibrium, dtype=kind)
    linear_b = model.linear.b
    nothing_applied = np.zeros(linear_b.shape[1])
    x = start[: model.order]
    state = start.astype(kind)
    outputs = []
    for _ in range(LOOP_SAMPLES):
        output = model.read(x, nothing_applied)
        y = np.asarray(output, dtype=kind)
        u, state = device.track(state, y, set_point)
        x = model.advance(x, model.lift(u.astype(float)))
        outputs.append(output)
    return np.array(outputs)


def deployed_rates(device: Device, design: Design) -> dict[str, float | None]:
    """Contraction rates that exact arithmetic proves for the rounded `A, B, C, K, L` and maps.

    Proved with the stored metrics. The device is an observer for its own rounded model, so that
    model is what is certified: the stored rate where the theorem still holds, else the largest of
    some smaller rates, else None. With an internal model the augmented pair is rebuilt from the
    rounded numbers. Source: [Z26] Theorems 1 and 2.
    """
    controller = as_floats(device.controller, np.float64)
    system = controller.recurrence()
    controlled = system
    if len(controller.a) > system.order:
        modes = controller.a[system.order :, system.order :]
        linear = controller.s_out.linear
        controlled = augmented(system, linear, modes)
    state_feedback = {"k": controller.k}
    observer = {"l": controller.l[: system.order]}
    gains = {"state_feedback": state_feedback, "observer": observer}
    if controller.neurons:
        gains["observer"]["l_z"] = controller.neurons.l_z
    inner = _rounded_ball(controller.s_in)
    outer = _rounded_ball(controller.s_out)
    if inner is None or outer is None:  # no ball, no theorem
        return dict.fromkeys(gains)
    balls = Balls(input=inner, output=outer)
    context = VerificationContext(system=system, controlled=controlled, balls=balls, gains={})
    proved: dict[str, float | None] = {}
    for side, gain in gains.items():
        # The certificate at the requested rate and that at the gain's largest rate.
        parts = [design.content[side], design.extra_certificates.get(f"{side}_deployed")]
        rates = [_largest_rate(part, context, gain) for part in parts if isinstance(part, Theorem)]
        proved[side] = max(rates, default=0.0) or None
    return proved


def _largest_rate(
    part: Theorem, context: VerificationContext, gain: dict[str, Float[np.ndarray, "r c"]]
) -> float:
    """Stored rate if it can be proved for the rounded numbers. Else the largest smaller one, by
    bisection; 0 if none can."""
    ball = part.ball(context)
    stored = float(part.variables["rate"])
    numbers = part.variables | part.model_data(context) | gain
    numbers |= {"alpha": ball.alpha, "beta": ball.beta}
    if part.holds(**numbers):
        return stored
    low = 0.0
    high = stored
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        if part.holds(**(numbers | {"rate": middle})):
            low = middle
        else:
            high = middle
    return low


def _rounded_ball(portable: PortableMap) -> JacobianBall | None:
    """Ball that contains the slopes of a rounded map. None where no sound one is known."""
    try:
        if portable.network is None:
            linear_scaffold = LinearScaffold(gain=portable.linear)
            return linear_scaffold.bound().ball
        return network_bound(portable.as_network()).ball
    except BadRequest:
        return None
