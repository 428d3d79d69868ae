"""Design of a certified controller from Python."""

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ssm_study.api.arguments import Slopes
from ssm_study.api.design import Design
from ssm_study.api.model import Model
from ssm_study.api.parts import StudyParts, part_of_setting
from ssm_study.api.rest_design import RestDesign
from ssm_study.api.steps import design_controller
from ssm_study.api.systems import (
    read_linear_system,
    read_number,
    read_numbers,
    read_positive_slope_range,
)
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import SIDES, Infeasible
from ssm_study.certificates.certificate import Design as Certificates
from ssm_study.models.bilinear import Bilinear
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.refusal import require, require_one_of
from ssm_study.synthesis.design import require_contraction_rate
from ssm_study.systems import JacobianBall

if TYPE_CHECKING:
    import control as python_control

LOOP = {"loop": "regulation"}
IDENTITY = (1.0, 1.0)  # the slopes of a map that is not given
REMEDIES = {
    "raise the slope floor (model.slope_lower)": "give slopes that lie closer together",
    "drop states (reduction.truncate_to)": "give a model with fewer states",
    "try synthesis=riccati": "try method='riccati'",
    " or use a scaffolding with slopes bounded by construction": "",
}
OF_THE_MODEL = ("data", "model", "training", "reduction", "seed")


def control(
    model: "Model | python_control.StateSpace | tuple[Any, ...]",
    *overrides: str,
    rate: float | None = None,
    observer_rate: float | None = None,
    method: str | None = None,
    slopes: Slopes | None = None,
    output_slopes: Slopes | None = None,
    input_limits: tuple[Any, Any] = (None, None),
    **settings: Any,
) -> Design | RestDesign:
    """Design a certified controller with an observer for a model. `u = K xh`, `xh+ = A xh + B
    S_u(u) + L (yh - y)`.

    `model` is what `fit` returned; rates and weights are then chosen from its records
    (`method="auto"`), unless `rate` and `observer_rate` ask for some. Or it is a discrete-time
    linear system: `control.StateSpace`, `control.TransferFunction`, or `(A, B, C, D, step_s)`,
    behind an input map with `slopes` and before an output map with `output_slopes`; it has no
    records, so the default is `method="riccati"` with `observer_rate=rate`. The observer is proved
    for maps that it computes itself: a design with a map that is known only by its slopes cannot be
    exported (`unknown_maps`), one with equal slopes `(g, g)` can.

    `method` is a choice of `conf/synthesis`, `settings` are its further fields, `overrides` the
    same as the command takes them (`"synthesis.input_weight=0.1"`). `input_limits` are the lowest
    and the highest input, physical; None is what the records visited. The rates hold without limits
    on the input, for slopes that hold everywhere; `record["limited_rate"]` holds within them. For a
    bare system `rate` is 0.05 unless it is given, and the largest rate that the gains prove is
    printed; limits are refused; with D nonzero it is certified and exported, but `st.simulate` and
    pictures refuse it.

    For a model with products of input and state (`model="bilinear"`) the result is a `RestDesign`:
    it is proved that the loop comes to rest, from a stated set of starts or from every start;
    `input_weight` and `sensor_noise` are its settings.

    Where the request is infeasible the design says so, and how much is possible. Raises
    `BadRequest` for a baseline, and for what the command refuses.

    >>> import control, ssm_study as st
    >>> plant = control.StateSpace([[0.9, 0.1], [0, 0.8]], [[0], [1]], [[1, 0]], [[0]], 0.1)
    >>> design = st.control(plant, rate=0.5, slopes=(0.8, 1.2))
    >>> design.verdicts  # with slopes=(1, 1) the observer knows the map, and all are True
    {'controller': True, 'observer': True, 'loop': False}
    """
    if isinstance(model, Model) and isinstance(model.simulator, Bilinear):
        given: dict[str, Any] = {"rate": rate, "observer_rate": observer_rate, "method": method}
        given |= {"slopes": slopes, "output_slopes": output_slopes}
        given |= {"overrides": overrides or None}
        return design_bilinear_controller(model, given, input_limits, settings)
    require_pair_of_limits(input_limits)
    rate_setting = ("rate", rate)
    observer_rate_setting = ("observer_rate", observer_rate)
    for name, requested_rate in (rate_setting, observer_rate_setting):
        if requested_rate is not None:
            require_contraction_rate(name, requested_rate, "try 0.1")
    identified = isinstance(model, Model)
    default = "auto" if identified else "riccati"
    chosen = default if method is None else method
    refuse_model_settings(overrides)
    earlier = model.later_words if isinstance(model, Model) else ()
    choice_of_method = () if method is None else (f"synthesis={method}",)
    words = (*earlier, *choice_of_method, *overrides)
    choices = LOOP | {"synthesis": chosen}
    parts = StudyParts(choices, words)
    if not identified:
        problem = (
            "apply to a model with records; for a bare system nothing is proved within input limits"
        )
        is_unlimited = all(limit is None for limit in input_limits)
        require(is_unlimited, "input_limits", input_limits, problem, "leave them out")
        rate, observer_rate = _rates_without_records(parts, rate, observer_rate)
    parts.change_settings(
        "synthesis", rate_controller=rate, rate_observer=observer_rate, **settings
    )
    if isinstance(model, Model):
        problem = "are for a bare system of matrices; this model has slope bounds of its own"
        settings_given = output_slopes if slopes is None else slopes
        require(settings_given is None, "slopes", settings_given, problem, "leave them out")
        return _design_for_model(model, parts, input_limits)
    return _design_for_system(model, parts, slopes, output_slopes, overrides)


def design_bilinear_controller(
    model: Model, other_arguments: dict[str, Any], limits: tuple[Any, Any], settings: dict[str, Any]
) -> RestDesign:
    """Design a controller for a bilinear model, and prove that the closed loop comes to rest.
    Raises `BadRequest` for arguments that such a design has no use for."""
    from ssm_study.synthesis.bilinear_design import BilinearSynthesis  # loads CVXPY

    require_pair_of_limits(limits)
    is_unlimited = all(limit is None for limit in limits)
    input_limits = None if is_unlimited else limits
    other_arguments = other_arguments | {"input_limits": input_limits}
    problem = "is for other models: the design for products of input and state takes no such choice"
    for name, value in other_arguments.items():
        require(value is None, name, value, problem, "leave it out")
    settings_of_synthesis = fields(BilinearSynthesis)
    known = [part.name for part in settings_of_synthesis]
    for name, value in settings.items():
        require_one_of(known, name, name)
        read_number(name, value)
    simulator = model.simulator
    assert isinstance(simulator, Bilinear)
    certificates = BilinearSynthesis(**settings).design(simulator)
    channels = (*model.data.inputs, *model.data.outputs)
    return RestDesign(model=simulator, certificates=certificates, channels=channels)


def require_pair_of_limits(limits: Any) -> None:
    """Raise `BadRequest` unless input limits are a pair (lowest, highest) of numbers or None."""
    is_sequence = isinstance(limits, tuple | list)
    is_pair = is_sequence and len(limits) == 2
    remedy = "give (lowest, highest), or None for the range that the records visited"
    require(is_pair, "input_limits", limits, "is no pair", remedy)
    for name, limit in zip(("lower", "upper"), limits, strict=True):
        if limit is not None:
            read_numbers(f"input_limits ({name})", limit)


def refuse_model_settings(overrides: tuple[str, ...]) -> None:
    """Raise `BadRequest` for settings of a control design that would change the model."""
    for word in overrides:
        part = part_of_setting(word)
        remedy = "give it to st.fit"
        may_change = part not in OF_THE_MODEL
        require(may_change, "overrides", word, f"changes {part}, and with it the model", remedy)


def _rates_without_records(
    parts: StudyParts, rate: float | None, observer_rate: float | None
) -> tuple[float | None, float | None]:
    """Contraction rates of controller and observer for a linear system that comes without recorded
    data. Raises `BadRequest` where records would be needed to choose them."""
    choice = parts.choices["synthesis"]
    problem = "needs a validation record to choose by, and there is none"
    remedy = "use method='riccati' with rate and observer_rate"
    takes_rates_from_records = choice.startswith("auto")
    require(not takes_rates_from_records, "synthesis", choice, problem, remedy)
    return rate, rate if observer_rate is None else observer_rate


def _design_for_model(model: Model, parts: StudyParts, limits: tuple[Any, Any]) -> Design:
    """Design a controller for an identified model that was fitted to records."""
    lower, upper = limits
    parts.change_settings("loop", input_lower=lower, input_upper=upper)
    loop = parts.build("loop")
    synthesis = parts.build("synthesis")
    input_limits = (loop.input_lower, loop.input_upper)
    certificate = design_controller(
        synthesis, model.ssm, model.data, model.mismatch, model.evidence, input_limits
    )
    design_overrides = parts.command_overrides()
    words = (*model.overrides, *design_overrides)
    loop_seed = parts.numbers["loop_seed"]
    return Design(
        certificate=certificate,
        model=model.ssm,
        origin=model,
        overrides=words,
        loop=loop,
        loop_seed=loop_seed,
    )


def _design_for_system(
    system: Any,
    parts: StudyParts,
    slopes: Slopes | None,
    output_slopes: Slopes | None,
    overrides: tuple[str, ...],
) -> Design:
    """Design a controller for a linear system behind static maps with known slopes."""
    from ssm_study.synthesis.deployed import add_largest_rate_certificates

    linear, step_s = read_linear_system(system)
    model = SSM.from_linear(linear, step_s)
    input_slopes = IDENTITY if slopes is None else slopes
    inner = jacobian_ball_of_slopes("slopes", input_slopes)
    slopes_of_output = IDENTITY if output_slopes is None else output_slopes
    outer = jacobian_ball_of_slopes("output_slopes", slopes_of_output)
    inward = _mean_slope_map(inner, model.scale.inputs)
    outward = _mean_slope_map(outer, model.scale.outputs)
    model = replace(model, scaffold_in=inward, scaffold_out=outward)
    balls = certified_balls(model)
    if inner.beta:
        balls = replace(balls, input=inner)
    if outer.beta:
        balls = replace(balls, output=outer)
    synthesis = parts.build("synthesis")
    certificate = synthesis.design(model, balls)
    certificate = add_largest_rate_certificates(replace_setting_names_in_advice(certificate))
    return Design(certificate=certificate, model=model, overrides=overrides)


def _mean_slope_map(ball: JacobianBall, channels: int) -> LinearScaffold:
    """Linear static map whose gain is the middle of a range of slopes. Pictures are drawn with
    it."""
    gain = ball.alpha * np.eye(channels)
    return LinearScaffold(gain=gain)


def replace_setting_names_in_advice(certificate: Certificates) -> Certificates:
    """Replace names of study settings in a certificate's advice, for a system that is given as
    matrices."""
    sides = {}
    for side in SIDES:
        part = certificate.certificates_by_name[side]
        words = "reason" if isinstance(part, Infeasible) else "solver_status"
        text = getattr(part, words)
        for setting, remedy in REMEDIES.items():
            text = text.replace(setting, remedy)
        side_part = cast("Any", part)
        sides[side] = replace(side_part, **{words: text})
    return replace(certificate, **sides)


def jacobian_ball_of_slopes(name: str, slopes: Slopes) -> JacobianBall:
    """Ball of matrices that contains all Jacobians of a static map with given smallest and largest
    slope."""
    lower, upper = read_positive_slope_range(name, slopes)
    return JacobianBall.from_slopes(lower, upper)
