"""A run's controller for use elsewhere, with the certificate beside it."""

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
from ssm_study.engine.settings import resolved
from ssm_study.export.c import c_files
from ssm_study.export.device import Device
from ssm_study.export.onnx import onnx_model
from ssm_study.export.portable import PortableController, as_floats, portable
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.structured import Model, model_from_json
from ssm_study.refusal import BadRequest, require
from ssm_study.signals import Channel, input_limits
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
    """Write the controller of the run folder into the folder `to`; returns what was written.

    C in `real`, "double" or "float", whose names begin with `prefix`, and the other files of
    docs/howto_export.md.
    Raises `BadRequest` for a run without controller, an unknown `real`, or when `to` is a file.
    """
    sources = c_sources(run, real=real, prefix=prefix)
    require(not to.exists() or to.is_dir(), "to", to, "is a file", "name a folder")
    to.mkdir(parents=True, exist_ok=True)
    controller, about = load(run), describe(run)
    written = {to / name: text.encode() for name, text in sources.items()}
    written[to / "controller.json"] = (
        json.dumps({"about": about, **controller.to_json()}, indent=1) + "\n"
    ).encode()
    written[to / "controller.py"] = _SCRIPT.read_bytes()
    written[to / "certificate.json"] = (run / "certificate.json").read_bytes()
    if find_spec("onnx") is not None:
        written[to / "controller.onnx"] = onnx_model(controller, about).SerializeToString()
    for path, content in written.items():
        path.write_bytes(content)
    return sorted(written)


def c_sources(run: Path, *, real: str = "double", prefix: str = "controller") -> dict[str, str]:
    """File name and text of the C code, limited as `limits` finds. Refuses as `export` does."""
    controller, design = load(run), Design.load(run / "certificate.json")
    device = Device.of(controller, real, *limits(run))
    rates = deployed_rates(device, design)
    sides = ", ".join(f"{side.replace('_', ' ')} {rate or 'none'}" for side, rate in rates.items())
    proved = f"Rates proved for the numbers below, in {real}: {sides}."
    return c_files(
        device,
        prefix,
        about=describe(run),
        signals=_described(run, device),
        digest=hashlib.sha256((run / "certificate.json").read_bytes()).hexdigest(),
        rates=(proved, *_limited(run, design, device), *_rounded_loop(run, device)),
    )


def limits(run: Path) -> tuple[Range, Range]:
    """`loop.input_lower`, `loop.input_upper` where they were given, else what the training records
    and rest visited.

    Beyond that range nothing is known of S_u. Infinite for a run without records.
    """
    seen, file = _seen(run, "excitation.mcap", "/input"), run / ".hydra" / "config.yaml"
    if seen is None:
        return np.array([-np.inf]), np.array([np.inf])
    asked = OmegaConf.load(file) if file.is_file() else OmegaConf.create()
    given = [OmegaConf.select(asked, f"loop.input_{end}") for end in ("lower", "upper")]
    return input_limits(
        resolved(given[0]), resolved(given[1]), _model(run).scale.with_rest([np.stack(seen[1:])])
    )


def _seen(run: Path, name: str, topic: str) -> tuple[tuple[Channel, ...], Range, Range] | None:
    """The channels of a topic, and the least and greatest value that the records hold of each."""
    if not (run / name).is_file():
        return None
    groups = [group for group in read_mcap(run / name)[0] if group.topic.endswith(topic)]
    values = np.concatenate([group.values for group in groups])
    return groups[0].channels, values.min(axis=0), values.max(axis=0)


def _described(run: Path, device: Device) -> tuple[str, ...]:
    """One line per signal: name, unit, and the limits of an input or the range an output was seen
    in."""
    inputs, outputs = (
        _seen(run, "excitation.mcap", "/input"),
        _seen(run, "validation.mcap", "/measured"),
    )
    rows = [("input", "limited to", (inputs[0], device.lower, device.upper))] if inputs else []
    rows += [("output", "seen from", outputs)] if outputs else []
    return tuple(
        f"{side} {j}: {channel.name} ({channel.unit}), {said} {low:.6g} to {high:.6g}"
        for side, said, known in rows
        for j, (channel, low, high) in enumerate(zip(*known, strict=True))
    )


def _limited(run: Path, design: Design, device: Device) -> tuple[str, ...]:
    """What the certificate says of the limits; nothing where there are none."""
    lower, upper = (np.asarray(limit, dtype=float) for limit in (device.lower, device.upper))
    if max(-lower.min(), upper.max()) >= UNLIMITED:
        return ()
    model = _model(run)
    if not isinstance(model, SSM):
        return (
            "Within the limits nothing is proved: the theorems on them know no neurons.",
            *_between(device),
        )
    try:
        found = within_limits(model, design, lower, upper)
    except BadRequest as refusal:
        return (str(refusal),)
    ends = " and ".join(
        f"{low:.6g} to {high:.6g}" for low, high in zip(found.lower, found.upper, strict=True)
    )
    beyond = "From everywhere nothing is proved within the limits."
    if found.everywhere:
        beyond = f"From everywhere the state feedback, cut at the limits, contracts at rate {found.everywhere.rate:.3g}"
        beyond += ", and the estimate as fast as without them."
    inside = f"Within the limits the full rates hold from rest at outputs from {ends}, at the set point of rest."
    cannot_start = "The limits are proved not to act from rest alone: the estimate cannot start at an output on the device."
    return cannot_start if device.set_points is None else inside, beyond


def _between(device: Device) -> tuple[str, ...]:
    """How far set points are missed between stored rest points, in the output's scale."""
    if device.set_points is None or not device.set_points.missed:
        return ()
    return (
        f"Set points lie on lines between stored rest points: missed by at most {device.set_points.missed:.1e}.",
    )


def python_control_system(run: Path) -> Any:
    """The controller of the run folder as a `control.NonlinearIOSystem`, what `controller.py` makes
    elsewhere."""
    with TemporaryDirectory() as folder:
        (Path(folder) / "controller.json").write_text(json.dumps(load(run).to_json()))
        shutil.copyfile(_SCRIPT, Path(folder) / "controller.py")
        return runpy.run_path(str(Path(folder) / "controller.py"))["controller"]


def load(run: Path) -> PortableController:
    """The controller of a run folder as plain arrays."""
    for name in ("model.json", "certificate.json"):
        found = (run / name).is_file()
        require(
            found,
            "run",
            run,
            f"it has no {name}",
            "name the folder of a run that reached the controller",
        )
    return portable(_model(run), Design.load(run / "certificate.json"))


def _model(run: Path) -> Model:
    model = model_from_json(json.loads((run / "model.json").read_text()))
    require(
        isinstance(model, Model),
        "model",
        type(model).__name__,
        "has no certificate",
        "use model=ssm or structured",
    )
    return model  # type: ignore[return-value]  # just asked


def describe(run: Path) -> str:
    """One line on where the controller comes from and what exact arithmetic finds of every claim of
    its certificate."""
    model, design = _model(run), Design.load(run / "certificate.json")
    content, verdict = json.loads((run / "certificate.json").read_text()), "NOT certified"
    rates = f"rates {design.state_feedback.rate:g} (controller), {design.observer.rate:g} (observer) per sample"
    # An internal model behind an output map that is not linear: no theorem covers it.
    with suppress(BadRequest):
        controlled = controlled_system(model, design.parts()[0])
        if design.certified and not failed_checks(
            content, model.system, certified_balls(model), controlled
        ):
            verdict = f"certified for its model at {rates}"
    return f"Controller of run {run.resolve().parent.name}/{run.resolve().name}, {verdict}; see certificate.json."


def _rounded_loop(run: Path, device: Device) -> tuple[str, ...]:
    """What rounding does to the loop on the model, from rest one output scale off; nothing in
    double."""
    if device.set_points is None or device.real == "double":
        return ()
    model, limits = _model(run), (end.astype(float) for end in (device.lower, device.upper))
    exact = Device.of(load(run), "double", *limits)
    rest, found = model.scale.output_equilibrium, []
    start = exact.start(rest + model.scale.output_scale)
    for one in (device, exact):
        x, state, y = start[: model.order], start.astype(one.lower.dtype), []
        for _ in range(LOOP_SAMPLES):
            y.append(model.read(x, np.zeros(model.linear.b.shape[1])))
            u, state = one.track(
                state, *(np.asarray(seen, dtype=one.lower.dtype) for seen in (y[-1], rest))
            )
            x = model.advance(x, model.lift(u.astype(float)))
        found.append(np.array(y))
    apart = float((np.abs(found[0] - found[1]) / model.scale.output_scale).max())
    return (
        f"Rounding to {device.real} moves the loop on the model by at most {apart:.1e} output scales.",
    )


def deployed_rates(device: Device, design: Design) -> dict[str, float | None]:
    """The rates that exact arithmetic proves for the rounded `A, B, C, K, L` and maps, with the
    stored metrics.

    The device is an observer for its own rounded model, so that model is what is certified: the
    stored rate where the
    theorem still holds, else the largest of some smaller rates, else None. With an internal model
    the augmented pair is
    rebuilt from the rounded numbers. Source: [Z26] Theorems 1 and 2.
    """
    c = as_floats(device.controller, np.float64)
    system = controlled = c.recurrence()
    if len(c.a) > system.order:
        controlled = augmented(system, c.s_out.linear, c.a[system.order :, system.order :])
    gains = {"state_feedback": {"k": c.k}, "observer": {"l": c.l[: system.order]}}
    gains["observer"] |= {"l_z": c.neurons.l_z} if c.neurons else {}
    inner, outer = _ball(c.s_in), _ball(c.s_out)
    if inner is None or outer is None:  # no ball, no theorem
        return dict.fromkeys(gains)
    known = VerificationContext(
        system=system, controlled=controlled, balls=Balls(input=inner, output=outer), gains={}
    )
    found: dict[str, float | None] = {}
    # The certificate at the requested rate and that at the gain's largest rate.
    for side, gain in gains.items():
        parts = [design.content[side], design.beside.get(f"{side}_deployed")]
        rates = [_largest(part, known, gain) for part in parts if isinstance(part, Theorem)]
        found[side] = max(rates, default=0.0) or None
    return found


def _largest(
    part: Theorem, known: VerificationContext, gain: dict[str, Float[np.ndarray, "r c"]]
) -> float:
    """The stored rate if it holds; else bisected from below, where any rate at all does; else 0."""
    ball, stored = part.ball(known), float(part.numbers["rate"])
    numbers = part.numbers | part.given(known) | gain | {"alpha": ball.alpha, "beta": ball.beta}
    if part.holds(**numbers):
        return stored
    low, high = 0.0, stored
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if part.holds(**(numbers | {"rate": middle})) else (low, middle)
    return low


def _ball(portable: PortableMap) -> JacobianBall | None:
    """Of the map as it is rounded; None where no sound one is known."""
    try:
        if portable.network is None:
            bound = LinearScaffold(gain=portable.linear).bound()
        else:
            bound = network_bound(portable.as_network())
    except BadRequest:
        return None
    return bound.ball
