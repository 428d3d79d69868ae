"""Export of a run's controller to files of all formats, with its certificate."""

import hashlib
import json
import runpy
import shutil
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float
from omegaconf import OmegaConf

from ssm_study.bounds.network import PortableMap
from ssm_study.bounds.slopes import certified_balls, network_slope_bound
from ssm_study.certificates.certificate import SIDES, Design
from ssm_study.certificates.theorem import Theorem, VerificationContext
from ssm_study.certificates.theorems.integral_action import augmented_system, controlled_system
from ssm_study.data.mcap import read_mcap
from ssm_study.durable import write_atomically
from ssm_study.export.c import render_c_files
from ssm_study.export.c_monitor import MonitorConstants
from ssm_study.export.device import DeviceController
from ssm_study.export.onnx import build_onnx_model
from ssm_study.export.portable import PortableController, convert_controller, convert_floats
from ssm_study.export.set_point_text import describe_set_points
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.stored import model_from_json
from ssm_study.models.structured import Model
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Channel, input_limits
from ssm_study.stored_yaml import read_stored_yaml
from ssm_study.synthesis.deployed import prove_within_input_limits
from ssm_study.synthesis.design import failed_checks
from ssm_study.systems import JacobianBall, JacobianBalls

UNLIMITED = 1e38  # either float's largest number stands for no limit
# As long as the replay of the C code: both loops have come to rest by then, or drift visibly.
LOOP_SAMPLES = 200
HALVINGS = 12  # of the rate, where the stored one does not survive rounding: to a 4000th of it
Range = Float[np.ndarray, "c"]
_SCRIPT = Path(__file__).with_name("script.py.txt")


def write_controller(
    run: Path, to: Path, *, real: str = "double", prefix: str = "controller"
) -> list[Path]:
    """Write the controller of a run to files of all export formats in a folder. C in `real`,
    "double" or "float", whose names begin with `prefix`, and the other files of
    docs/howto_export.md. Raises `BadRequest` for a run without controller, an unknown `real`, or
    when `to` is a file."""
    sources = render_c_sources(run, real=real, prefix=prefix)
    require(not to.exists() or to.is_dir(), "to", to, "is a file", "name a folder")
    to.mkdir(parents=True, exist_ok=True)
    controller = load_controller(run)
    about = describe_origin(run)
    numbers = {"about": about, **controller.to_json()}
    contents = {to / name: text.encode() for name, text in sources.items()}
    contents[to / "controller.json"] = (json.dumps(numbers, indent=1) + "\n").encode()
    contents[to / "controller.py"] = _SCRIPT.read_bytes()
    contents[to / "certificate.json"] = (run / "certificate.json").read_bytes()
    if find_spec("onnx") is not None:
        contents[to / "controller.onnx"] = build_onnx_model(controller, about).SerializeToString()
    for path, content in contents.items():
        write_atomically(path, content, durable=False)
    return sorted(contents)


def render_c_sources(
    run: Path, *, real: str = "double", prefix: str = "controller", name: str = ""
) -> dict[str, str]:
    """Names and texts of the C files of a run's controller. Raises `BadRequest` as
    `write_controller` does.

    `name` stands in the header in place of the run's, for a design without a run folder.
    """
    controller = load_controller(run)
    design = Design.load(run / "certificate.json")
    device = DeviceController.from_controller(controller, real, *find_input_limits(run))
    rates = prove_deployed_rates(device, design)
    sides = ", ".join(f"{side.replace('_', ' ')} {rate or 'none'}" for side, rate in rates.items())
    proved = f"Rates proved for the numbers below, in {real}: {sides}."
    return render_c_files(
        device,
        prefix,
        origin_text=describe_origin(run, name),
        signal_lines=_describe_signals(run, device),
        certificate_digest=hashlib.sha256((run / "certificate.json").read_bytes()).hexdigest(),
        rate_lines=(
            proved,
            *_describe_limits(run, design, device),
            *_describe_rounding_error(run, device),
        ),
        monitor=MonitorConstants.for_design(load_model(run), design),
    )


def find_input_limits(run: Path) -> tuple[Range, Range]:
    """Lower and upper input limits of a run's controller in physical units, from the settings or
    else from the recorded range.

    `loop.input_lower` and `loop.input_upper` where they were given, else what the training records
    and rest visited: beyond that range nothing is known of S_u.
    """
    visited = _read_recorded_ranges(run, "excitation.mcap", "/input")
    if visited is None:
        return np.array([-np.inf]), np.array([np.inf])
    loop = _read_loop_settings(run)
    scale = load_model(run).scale
    inputs = [np.stack(visited[1:])]
    around_rest = scale.append_equilibrium_input(inputs)
    return input_limits(loop.get("input_lower"), loop.get("input_upper"), around_rest)


def _read_loop_settings(run: Path) -> dict[str, Any]:
    """Settings of the closed loop in a run's stored configuration."""
    file = run / ".hydra" / "config.yaml"
    if not file.is_file():
        return {}
    settings = OmegaConf.to_container(OmegaConf.create(read_stored_yaml(file)))
    loop = settings.get("loop") if isinstance(settings, dict) else None
    return loop if isinstance(loop, dict) else {}


def _read_recorded_ranges(
    run: Path, file_name: str, topic_ending: str
) -> tuple[tuple[Channel, ...], Range, Range] | None:
    """Channels of a recorded signal, with the smallest and largest value of each."""
    if not (run / file_name).is_file():
        return None
    mcap = read_mcap(run / file_name)
    groups = [group for group in mcap[0] if group.topic.endswith(topic_ending)]
    if not groups:
        return None
    values = np.concatenate([group.values for group in groups])
    channels = groups[0].channels
    return channels, values.min(axis=0), values.max(axis=0)


def _describe_signals(run: Path, device: DeviceController) -> tuple[str, ...]:
    """Lines of text with the name, unit and range of every signal of an exported controller."""
    lines: list[str] = []
    inputs = _read_recorded_ranges(run, "excitation.mcap", "/input")
    if inputs is not None:
        lines += _describe_ranges("input", "limited to", inputs[0], device.lower, device.upper)
    disturbances = _read_recorded_ranges(run, "excitation.mcap", "/disturbance")
    if disturbances is not None:
        lines += _describe_ranges("disturbance", "measured, seen from", *disturbances)
    outputs = _read_recorded_ranges(run, "validation.mcap", "/measured")
    if outputs is not None:
        seen = _describe_ranges("output", "seen from", *outputs)
        lines += [f"{line} in the validation records" for line in seen]
    return tuple(lines)


def _describe_ranges(
    side: str, relation: str, channels: tuple[Channel, ...], lower: Range, upper: Range
) -> list[str]:
    """Lines of text with the range of every channel of the inputs or outputs."""
    lines = []
    for j, (channel, low, high) in enumerate(zip(channels, lower, upper, strict=True)):
        values = f"{relation} {low:.6g} to {high:.6g}"
        lines.append(f"{side} {j}: {channel.name_with_unit}, {values}")
    return lines


def _describe_limits(run: Path, design: Design, device: DeviceController) -> tuple[str, ...]:
    """Sentences on what the certificate of a design proves under the input limits."""
    lower = np.asarray(device.lower, dtype=float)
    upper = np.asarray(device.upper, dtype=float)
    if max(-lower.min(), upper.max()) >= UNLIMITED:
        return ()
    model = load_model(run)
    if not isinstance(model, SSM):
        unproved = "Within the limits nothing is proved: the theorems on them know no neurons."
        return (unproved, *describe_set_points(device))
    try:
        proved = prove_within_input_limits(model, design, lower, upper)
    except BadRequest as refusal:
        return (str(refusal),)
    beyond = "From everywhere nothing is proved within the limits."
    if proved.everywhere:
        beyond = (
            "From everywhere the state feedback, cut at the limits, contracts at rate "
            f"{proved.everywhere.rate:.3g}, and the estimate as fast as without them."
        )
    if device.set_point_maps is None:
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
    return (inside, beyond, *describe_set_points(device))


def as_python_control(run: Path) -> Any:
    """Controller of a run as a nonlinear system of the library python-control.

    The exported file `controller.py` makes the same system.
    """
    with TemporaryDirectory() as folder:
        controller_path = Path(folder) / "controller.json"
        controller_path.write_text(json.dumps(load_controller(run).to_json()))
        shutil.copyfile(_SCRIPT, Path(folder) / "controller.py")
        path = runpy.run_path(str(Path(folder) / "controller.py"))
        return path["controller"]


def load_controller(run: Path) -> PortableController:
    """Controller of a run, read from its files as plain arrays."""
    for name in ("model.json", "certificate.json"):
        is_there = (run / name).is_file()
        remedy = "name the folder of a run that reached the controller"
        require(is_there, "run", run, f"it has no {name}", remedy)
    return convert_controller(load_model(run), Design.load(run / "certificate.json"))


def load_model(run: Path) -> Model:
    """Model of a run, read from its file."""
    model = model_from_json(json.loads((run / "model.json").read_text()))
    kind = type(model).__name__
    is_certifiable = isinstance(model, Model)
    require(is_certifiable, "model", kind, "has no certificate", "use model=ssm or structured")
    return model  # type: ignore[return-value]  # just asked


def describe_origin(run: Path, design_name: str = "") -> str:
    """Line of text with the run that a controller comes from, and the exact verdict on its
    certificate.

    `design_name` names a design that has no run folder.
    """
    model = load_model(run)
    design = Design.load(run / "certificate.json")
    reason = _first_failed_claim(run, model, design)
    verdict = f"NOT certified: {reason}"
    if not reason:
        verdict = (
            f"certified for its model at rates {design.state_feedback.rate:g} (controller), "
            f"{design.observer.rate:g} (observer) per sample"
        )
    if design_name:
        return f"Controller {design_name}, {verdict}."
    place = f"run {run.resolve().parent.name}/{run.resolve().name}"
    if not (run / "record.json").is_file():
        place = "a design from Python"
    return f"Controller of {place}, {verdict}; see certificate.json."


def _first_failed_claim(run: Path, model: Model, design: Design) -> str:
    """First claim in a run's stored certificate that exact arithmetic does not confirm; empty if
    none."""
    for side in SIDES:
        if not design.certificates_by_name[side].certified:
            return f"exact arithmetic does not confirm the {side.replace('_', ' ')}"
    failed = failed_certificate_claims(run, model, design)
    return failed[0].rstrip(".") if failed else ""


def failed_certificate_claims(run: Path, model: Model, design: Design) -> list[str]:
    """Sentences on certificate claims of a run that exact arithmetic does not confirm for the
    stored model."""
    content = json.loads((run / "certificate.json").read_text())
    try:
        # Refused for an internal model behind a nonlinear output map, which no theorem covers.
        controlled = controlled_system(model, design.controller_and_observer()[0])
    except BadRequest as refused:
        return [str(refused)]
    return failed_checks(content, model.system, certified_balls(model), controlled)


def _describe_rounding_error(run: Path, device: DeviceController) -> tuple[str, ...]:
    """Text on how much rounding of the controller's numbers changes the simulated loop; empty in
    double precision.

    The loop starts at rest, one output scale away from the equilibrium.
    """
    if device.set_point_maps is None or device.real == "double":
        return ()
    lower = device.lower.astype(float)
    upper = device.upper.astype(float)
    exact = DeviceController.from_controller(load_controller(run), "double", lower, upper)
    model = load_model(run)
    output_equilibrium = model.scale.output_equilibrium
    output_scale = model.scale.output_scale
    start = exact.equilibrium_state(output_equilibrium + output_scale)
    difference = _simulate_loop(model, device, start) - _simulate_loop(model, exact, start)
    apart = float((np.abs(difference) / model.scale.output_scale).max())
    distance = f"by at most {apart:.1e} output scales."
    return (f"Rounding to {device.real} moves the loop on the model {distance}",)


def _simulate_loop(
    model: Model, device: DeviceController, initial_state: Float[np.ndarray, "n"]
) -> Any:
    """Outputs of a model in closed loop with the exported controller, until they settle."""
    kind = device.lower.dtype
    output_equilibrium = model.scale.output_equilibrium
    set_point = np.asarray(output_equilibrium, dtype=kind)
    linear_b = model.linear.b
    nothing_applied = np.zeros(linear_b.shape[1])
    x = initial_state[: model.order]
    state = initial_state.astype(kind)
    outputs = []
    for _ in range(LOOP_SAMPLES):
        output = model.output_at(x, nothing_applied)
        y = np.asarray(output, dtype=kind)
        u, state = device.compute_step(state, y, set_point)
        x = model.next_state(x, model.map_input(u.astype(float)))
        outputs.append(output)
    return np.array(outputs)


def prove_deployed_rates(device: DeviceController, design: Design) -> dict[str, float | None]:
    """Contraction rates that exact arithmetic proves for the rounded numbers of a controller.

    Proved with the stored metrics. The device is an observer for its own rounded model, so that
    model is what is certified: the stored rate where the theorem still holds, else the largest of
    some smaller rates, else None. With an internal model the augmented pair is rebuilt from the
    rounded numbers. Source: [Z26] Theorems 1 and 2.
    """
    controller = convert_floats(device.controller, np.float64)
    system = controller.recurrence()
    controlled = system
    if len(controller.a) > system.order:
        modes = controller.a[system.order :, system.order :]
        linear = controller.s_out.linear
        controlled = augmented_system(system, linear, modes)
    state_feedback = {"k": controller.k}
    observer = {"l": controller.l[: system.order]}
    gains = {"state_feedback": state_feedback, "observer": observer}
    if controller.neurons:
        gains["observer"]["l_z"] = controller.neurons.l_z
    inner = _ball_of_rounded_slopes(controller.s_in)
    outer = _ball_of_rounded_slopes(controller.s_out)
    if inner is None or outer is None:  # no ball, no theorem
        return dict.fromkeys(gains)
    balls = JacobianBalls(input=inner, output=outer)
    context = VerificationContext(system=system, controlled=controlled, balls=balls, gains={})
    proved: dict[str, float | None] = {}
    for side, gain in gains.items():
        # The certificate at the requested rate and that at the gain's largest rate.
        parts = [
            design.certificates_by_name[side],
            design.extra_certificates.get(f"{side}_deployed"),
        ]
        rates = [_provable_rate(part, context, gain) for part in parts if isinstance(part, Theorem)]
        proved[side] = max(rates, default=0.0) or None
    return proved


def _provable_rate(
    part: Theorem, context: VerificationContext, rounded_gains: dict[str, Float[np.ndarray, "r c"]]
) -> float:
    """Largest contraction rate, not above the certified one, that exact arithmetic proves for the
    rounded numbers of a controller. It is found by bisection; 0 if none can be proved."""
    ball = part.required_ball(context)
    stored = float(part.variables["rate"])
    numbers = part.variables | part.model_data(context) | rounded_gains
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


def _ball_of_rounded_slopes(static_map: PortableMap) -> JacobianBall | None:
    """Ball that contains the slopes of a static map with rounded coefficients; None if no proved
    ball is known."""
    try:
        if static_map.network is None:
            linear_scaffold = LinearScaffold(gain=static_map.linear)
            return linear_scaffold.slope_bound().ball
        return network_slope_bound(static_map.as_network()).ball
    except BadRequest:
        return None
