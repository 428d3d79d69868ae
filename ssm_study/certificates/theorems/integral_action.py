"""Internal models: the identified model joined with the modes of a disturbance to be rejected or of
a reference to be followed.

Problem. Remove errors that constants, ramps or sines of known frequency cause, as disturbances or
as references, with a certified rate. Integral action is the constant's case.

Hypotheses. Those of `state_feedback`; a linear output map `S_y(v) = G v`, an input for every
controlled output, and no transmission zero of the model at a mode.

Statement. With `z+ = A_z z + E (y - y*) / s_y`, `A_z` holding for each output the modes asked for,
1 for a constant, a double 1 for a ramp, `e^{+-j 2 pi f step_s}` for a sine, and `u = u* + K_x (xh -
x*) + K_z z`,

    (x, z)+ = [A 0; E G C A_z] (x, z) + [B; E G D] S_u(u)

is again a linear recurrence behind `S_u`, so the inequality of `state_feedback` with this `(A, B)`,
`[(1 - rate) P - sigma B B^T, ...] > 0`, its frontier and its verdict hold as they stand; z is known
exactly, so the observer is unchanged. The loop contracts: under a disturbance of period T every
trajectory tends to one of period T, z too, which is bounded only if the error has no component at
the modes: exactly, whatever `S_u`. Behind a linear `S_u` nothing else of a sine is left; a curved
one leaves harmonics, to which modes of their own can be given.

When not to use it. With a nonlinear output map, fewer inputs than outputs, or inputs that saturate
for long.

Reference. [Z26] Theorem 1, eq. (11), for the augmented pair, announced as future work in its
section V; the internal model principle: Francis & Wonham 1976.

Example. A gain `y = 0.5 x` of `x+ = 0.9 x + S_u(u)`: the integrator is a second state, driven by
`0.5 x`.

>>> import numpy as np
>>> from ssm_study.systems import StateSpace
>>> one = np.ones((1, 1))
>>> model = StateSpace(a=0.9 * one, b=one, c=0.5 * one, d=0 * one)
>>> print(augmented_system(model, np.eye(1), np.eye(1)).a.tolist())
[[0.9, 0.0], [0.5, 1.0]]
>>> print(internal_model(["ramp", "sine(0.25Hz)"], step_s=1.0, outputs=1).round(9).tolist())
[[1.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 1.0, 0.0]]
"""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.bounds.frequency import frequency_response
from ssm_study.certificates.certificate import StateFeedback
from ssm_study.models.structured import Model, linearise_at_equilibrium
from ssm_study.refusal import require
from ssm_study.systems import StateSpace, StructuredSystem, System, error_input_matrix

OutputGain = Float[np.ndarray, "p k"]
InternalModes = Float[np.ndarray, "z z"]

FIELD = "synthesis.internal_model"
# of the model's largest gain: an output that the inputs move by less at a mode cannot be held there
BLOCKED = 1e-6
ANGLES = np.geomspace(1e-3, np.pi, 100)  # where that gain is looked for (rad/sample)
NUDGE = 1e-9  # a pole on the circle has a gain, too
SINE = re.compile(r"sine\((\d+(?:\.\d*)?(?:e-?\d+)?) ?Hz\)")


def count_modes_by_frequency(signal_names: Sequence[str]) -> dict[float, int]:
    """Number of internal-model modes at each frequency (Hz) for signals named such as `step`,
    `ramp` or `sine(0.5Hz)`. `step` is one at zero, `ramp` two, `sine(0.5Hz)` one at 0.5.

    Raises `BadRequest` for other words, and for the frequency zero.
    """
    mode_counts: dict[float, int] = {}
    for word in signal_names:
        sine = SINE.fullmatch(word)
        ramp = word == "ramp"
        hertz = float(sine[1]) if sine else 0.0
        is_allowed = hertz > 0 if sine else word in ("step", "ramp")
        remedy = "use step, ramp, or a sine such as sine(0.5Hz)"
        require(is_allowed, FIELD, word, "is no internal model", remedy)
        count_so_far = mode_counts.get(hertz, 0)
        mode_counts[hertz] = max(count_so_far, 1 + ramp)
    # modes at one come first, as the exported code has them
    return dict(sorted(mode_counts.items()))


def internal_model(signal_names: Sequence[str], step_s: float, outputs: int) -> InternalModes:
    """State matrix of the internal model that generates given kinds of references or disturbances.
    `A_z` has the modes of one output, each state repeated for every output. Raises `BadRequest` for
    sines faster than the sampling allows."""
    blocks = []
    nyquist = 0.5 / step_s
    for hertz, count in count_modes_by_frequency(signal_names).items():
        problem = (
            f"half the sampling rate is {nyquist:g} Hz, and a model has no frequency beyond it"
        )
        remedy = "name a slower sine, or sample faster"
        require(hertz < nyquist, FIELD, f"sine({hertz:g}Hz)", problem, remedy)
        angle = 2 * np.pi * hertz * step_s
        lower_triangle = np.tril(np.ones((count, count)))
        block = _rotation_matrix(angle) if hertz else lower_triangle
        blocks.append(block)
    modes_of_one_output = scipy.linalg.block_diag(*blocks)
    return np.kron(modes_of_one_output, np.eye(outputs))


def _rotation_matrix(angle: float) -> Float[np.ndarray, "2 2"]:
    """Matrix that rotates the plane by a given angle."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    return np.array([[cosine, -sine], [sine, cosine]])


def append_internal_model(
    model: Model, signal_names: Sequence[str] = ("step",), weight: float = 1.0
) -> System:
    """Append an internal model of references or disturbances to the identified model, with the
    joint state `(x, z)`.

    Raises `BadRequest` for a nonlinear output map, for more outputs than inputs, which could not
    steer them all, and where the inputs do not move every output at a mode.
    """
    gain = linear_output_gain(model)
    inputs = model.linear.b.shape[1]
    linear = linearise_at_equilibrium(model)
    linear = replace(linear, a=linear.a * (1 - NUDGE))
    problem = "an input is needed for every controlled output"
    remedy = "use a synthesis without an internal model"
    require(len(gain) <= inputs, FIELD, f"{len(gain)} outputs, {inputs} inputs", problem, remedy)
    outputs = len(gain)
    hertz = np.array(list(count_modes_by_frequency(signal_names)))
    modes = internal_model(signal_names, model.step_s, outputs)
    mode_angles = 2 * np.pi * hertz * model.step_s
    angles = np.concatenate([mode_angles, ANGLES])
    response = gain @ frequency_response(linear, angles)
    singular_values = np.linalg.svd(response, compute_uv=False)
    sizes = singular_values[:, outputs - 1]  # of the output that is moved least
    at_modes = sizes[: len(hertz)]
    at_others = sizes[len(hertz) :]
    shares = at_modes / at_others.max()
    least_share = shares.min()
    weakest = hertz[shares.argmin()]
    problem = f"at {weakest:g} Hz the model passes {least_share:.0e} of its largest gain"
    remedy = "leave this mode out: no controller holds the output there"
    require(bool(least_share > BLOCKED), FIELD, list(signal_names), problem, remedy)
    return augmented_system(model.system, gain, modes, weight)


def augmented_system(
    system: System,
    output_gain: OutputGain,
    internal_model_matrix: InternalModes,
    weight: float = 1.0,
) -> System:
    """System of the model together with an internal model of references or disturbances. Neurons
    drive both but depend on x alone."""
    n, m = system.b.shape
    p = len(output_gain)
    z = len(internal_model_matrix)
    output_to_modes = error_input_matrix(internal_model_matrix, p) @ output_gain
    weighted_modes = np.sqrt(weight) * np.eye(z)
    state_row = [system.a, np.zeros((n, z))]
    mode_row = [output_to_modes @ system.c, internal_model_matrix]
    output_row = [output_gain @ system.c, np.zeros((p, z))]
    weighted_mode_row = [np.zeros((z, n)), weighted_modes]
    linear = {
        "a": np.block([state_row, mode_row]),
        "b": np.vstack([system.b, output_to_modes @ system.d]),
        "c": np.block([output_row, weighted_mode_row]),
        "d": np.vstack([output_gain @ system.d, np.zeros((z, m))]),
    }
    if isinstance(system, StateSpace):
        return StateSpace(**linear)
    modes_to_neurons = np.zeros((system.neurons, z))
    neurons_to_modes = output_to_modes @ system.h
    neurons_to_output = output_gain @ system.h
    return StructuredSystem(
        **linear,
        e=np.vstack([system.e, neurons_to_modes]),
        f=np.hstack([system.f, modes_to_neurons]),
        g=system.g,
        h=np.vstack([neurons_to_output, np.zeros((z, system.neurons))]),
    )


def linear_output_gain(model: Model) -> OutputGain:
    """Gain of a model's static output map, which must be linear if the controller has an internal
    model. `G` of `S_y(v) = G v`. Raises `BadRequest` for any other output map."""
    portable_map = model.scaffold_out.as_portable()
    problem = "it needs a linear output map, so that it is part of the recurrence"
    remedy = "use scaffold@model.scaffold_out=linear"
    require(portable_map.network is None, FIELD, model.scaffold_out.kind, problem, remedy)
    return portable_map.linear


def controlled_system(model: Model, feedback: StateFeedback) -> System:
    """System for which a state feedback is certified: the model, together with its internal model
    if there is one.

    The verifier compares this system with the requested one.
    """
    n = model.order
    if feedback.a.shape[0] <= n:
        return model.system
    modes = feedback.a[n:, n:]
    return augmented_system(model.system, linear_output_gain(model), modes)
