"""Response of a closed loop to an error of the output: transfer function, peaks, and stability of
the controller itself.

With `y = y_model + e` and `u = K xh`, `J_u` and `J_y` in the balls of Jacobians (D cancels),

    x+  = (A + B J_u K) x + B J_u K eps,     eps+ = (A + L J_y C) eps - L e,     u = K (x + eps).

With an internal model `u = K_x (x + eps) + K_z z` and `z+ = A_z z + E (J_y C x + e)`, driven by the
measured output (here D is taken as zero); integrators have `A_z = I`. The Jacobians are taken
constant, at the ends and the centre of their balls, and so are the slopes of neurons, at zero and
one: a loop whose neurons switch is not among them. Source: docs/theory.md, "Small gain for the
plant".
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from jaxtyping import Complex, Float

from ssm_study.bounds.frequency import frequency_response, hinf_norm
from ssm_study.systems import (
    Gains,
    JacobianBall,
    JacobianBalls,
    StateSpace,
    System,
    error_input_matrix,
)

MOST_CORNERS = 4  # neurons up to which every corner of their slopes is tried, beyond them a few
# Frequencies (rad/sample) of the weighted peak, beside those of the loop's own modes.
FINE_ANGLES = np.geomspace(1e-4, np.pi, 1000)

# System and gains at frozen slopes of the neurons, slopes of `S_u` and `S_y`.
LoopAtSlopes = tuple[StateSpace, Gains, float, float]
NeuronSlopes = Float[np.ndarray, "k q"]
Angles = Float[np.ndarray, "F"]
Square = Float[np.ndarray, "n n"]
InputMatrix = Float[np.ndarray, "n k"]
StateResponse = Complex[np.ndarray, "F n k"]
InternalModes = Float[np.ndarray, "z z"]
ObserverGain = Float[np.ndarray, "n p"]


def slopes_to_test(ball: JacobianBall) -> tuple[float, ...]:
    """Slopes of a static map at which a closed loop is evaluated: both ends and the centre of its
    range of slopes."""
    if ball.beta > 0:
        return ball.lower, ball.alpha, ball.upper
    return (ball.alpha,)


def systems_at_constant_slopes(
    system: System, gains: Gains, balls: JacobianBalls, neuron_slopes: NeuronSlopes | None = None
) -> Iterator[LoopAtSlopes]:
    """Linear system and gains for each combination of constant slopes of static maps and neurons.
    Slopes of neurons are at the corners unless given (`neuron_slopes`), where L is `L + E S
    L_z`."""
    slopes_in = slopes_to_test(balls.input)
    slopes_out = slopes_to_test(balls.output)
    for linear, own_gains in _systems_at_neuron_slopes(system, gains, neuron_slopes):
        for slope_in, slope_out in product(slopes_in, slopes_out):
            yield linear, own_gains, slope_in, slope_out


def _systems_at_neuron_slopes(
    system: System, gains: Gains, neuron_slopes: NeuronSlopes | None
) -> Iterator[tuple[StateSpace, Gains]]:
    """Linear system and gains for each combination of neuron slopes, with each neuron replaced by
    its slope."""
    if isinstance(system, StateSpace):
        yield system, gains
        return
    if neuron_slopes is None:
        neuron_slopes = system.slope_corners(MOST_CORNERS)
    for slopes in neuron_slopes:
        own_gains = gains
        if gains.l_z is not None:
            injection = (system.e * slopes) @ gains.l_z
            own_gains = replace(gains, l=gains.l + injection)
        yield system.linearise_at_slopes(slopes), own_gains


def error_to_input_response(
    system: StateSpace, gains: Gains, slope_in: float, slope_out: float
) -> StateSpace:
    """Closed-loop transfer function from an error of the output to the input, at constant slopes of
    the static maps. `T_ue` from `e (p)` to `u (m)`, state `(x, eps, z)`, z of the internal model.
    """
    order, outputs = gains.l.shape
    modes = gains.modes
    state_gain = gains.k[:, :order]
    internal_gain = gains.k[:, order:]
    drive = slope_in * system.b @ state_gain
    internal_drive = slope_in * system.b @ internal_gain
    error_input = error_input_matrix(modes, outputs)
    controlled_c = system.c[:outputs]
    measured = slope_out * error_input @ controlled_c
    estimation = system.a + slope_out * gains.l @ system.c
    no_coupling = np.zeros((len(modes), order))
    no_effect_of_state = np.zeros((order, order))
    state_row = [system.a + drive, drive, internal_drive]  # u reads the estimate `x + eps`
    error_row = [no_effect_of_state, estimation, no_coupling.T]
    internal_row = [measured, no_coupling, modes]
    a = np.block([state_row, error_row, internal_row])
    no_effect = np.zeros((order, outputs))
    injection = -gains.l
    b = np.vstack([no_effect, injection, error_input])
    c = np.hstack([state_gain, state_gain, internal_gain])
    inputs = len(gains.k)
    d = np.zeros((inputs, outputs))
    return StateSpace(a=a, b=b, c=c, d=d)


def noise_response(
    system: StateSpace, gains: Gains, slope_in: float, slope_out: float
) -> StateSpace:
    """Closed-loop transfer function from sensor noise to the model's noise-free output, at constant
    slopes of the static maps."""
    loop = error_to_input_response(system, gains, slope_in, slope_out)
    outputs = len(system.c)
    noise_inputs = loop.b.shape[1]
    other_states = loop.order - system.order
    no_effect = np.zeros((outputs, other_states))
    by_state = np.hstack([system.c, no_effect])
    by_input = slope_in * system.d @ loop.c
    c = slope_out * (by_state + by_input)
    d = np.zeros((outputs, noise_inputs))
    return StateSpace(a=loop.a, b=loop.b, c=c, d=d)


def noise_gain(system: System, gains: Gains, balls: JacobianBalls) -> float:
    """Largest closed-loop gain from the sensor noise to the model's output, over all frequencies
    and constant slopes.

    A number of the model, not a claim: slopes that vary may do more, and white noise does less.
    """
    combinations = systems_at_constant_slopes(system, gains, balls)
    return max(hinf_norm(noise_response(*end)) for end in combinations)


def control_sensitivity_peak(system: System, gains: Gains, balls: JacobianBalls) -> float:
    """Peak of the control sensitivity: largest closed-loop gain from an error of the output to the
    input, over all frequencies and constant slopes. `max ||T_ue||_inf`; infinite if one of these
    loops is unstable."""
    combinations = systems_at_constant_slopes(system, gains, balls)
    return max(hinf_norm(error_to_input_response(*end)) for end in combinations)


def controller_spectral_radius(
    system: System, gains: Gains, balls: JacobianBalls
) -> Float[np.ndarray, "*pairs"]:
    """Largest spectral radius of controller and observer while the plant's output is constant, over
    constant slopes of the static maps. The internal model is left out.

    While the plant holds still (friction holds it, its actuator saturates), `y = y*` and the
    controller runs alone: `xh+ = (A + B J_u K_x + L J_y (C + D J_u K_x)) xh`. At or above one, rest
    is unstable for every plant that holds still under small inputs, whatever its certificate says
    of the model. Field's term: strong stabilisation. Source: Youla, Bongiorno & Lu, Automatica 10
    (1974) 159-173.
    """
    state_gain = gains.k[..., : system.order]
    pairs = gains.k.shape[:-2]
    largest = np.zeros(pairs)
    for linear, own_gains, slope_in, slope_out in systems_at_constant_slopes(system, gains, balls):
        input_gain = slope_in * state_gain
        output = linear.c + linear.d @ input_gain
        injection = slope_out * own_gains.l @ output
        controller_matrix = linear.a + linear.b @ input_gain + injection
        eigenvalues = np.linalg.eigvals(controller_matrix)
        spectral_radius = np.abs(eigenvalues).max(axis=-1)
        largest = np.maximum(largest, spectral_radius)
    return np.asarray(largest)


@dataclass(frozen=True, kw_only=True, eq=False)
class ResponseCache:
    """Cache of frequency responses that the closed loops of many controllers and observers share.
    What pairs share is computed once.

    `T_ue = (I - J_u F G)^{-1} (K_z Z - K_x (z I - A - L J_y C)^{-1} L)`, `F = K_x + K_z Z J_y C`,
    `G = (z I - A)^{-1} B`, `Z = (z I - A_z)^{-1} E` (integrators: `1 / (z - 1)`), separates a pair
    into two factors: of the observer, and of the controller, G is common.
    """

    angles: Angles
    known: dict[bytes, StateResponse] = field(default_factory=dict)

    def state_response(self, a: Square, b: InputMatrix) -> StateResponse:
        """Frequency response of a linear system from input to state, cached for later calls."""
        key = a.tobytes() + b.tobytes()
        if key not in self.known:
            identity = np.eye(len(a))
            no_feedthrough = np.zeros_like(b)
            system = StateSpace(a=a, b=b, c=identity, d=no_feedthrough)
            self.known[key] = frequency_response(system, self.angles)
        return self.known[key]

    def loop_response(
        self,
        system: StateSpace,
        controller_gain: Float[np.ndarray, "m s"],
        internal_model: InternalModes,
        observer_gains: list[ObserverGain],
        *slope: float,
    ) -> Complex[np.ndarray, "O F m p"]:
        """Closed-loop frequency responses from an error of the output to the input, for one
        controller with each of several observers."""
        slope_in, slope_out = slope
        order = system.order
        outputs = observer_gains[0].shape[1]
        state_gain = controller_gain[:, :order]
        internal_gain = controller_gain[:, order:]
        error_input = error_input_matrix(internal_model, outputs)
        controlled_c = system.c[:outputs]
        through_internal = internal_gain @ self.state_response(internal_model, error_input)
        effective_gain = state_gain + slope_out * through_internal @ controlled_c
        loop = effective_gain @ self.state_response(system.a, system.b)
        observer_responses = []
        for observer_gain in observer_gains:
            observer_matrix = system.a + slope_out * observer_gain @ system.c
            observer_responses.append(self.state_response(observer_matrix, observer_gain))
        estimates = np.stack(observer_responses)
        through = -np.einsum("mn,ofnp->ofmp", state_gain, estimates)
        has_internal_model = controller_gain.shape[1] > order
        if has_internal_model:
            through = through + through_internal
        return_difference = np.eye(len(controller_gain)) - slope_in * loop
        return np.linalg.inv(return_difference) @ through


def gain_peaks_on_grid(
    system: System,
    controller_gains: Float[np.ndarray, "C m s"],
    observer_gains: Float[np.ndarray, "O n p"],
    balls: JacobianBalls,
    angles: Angles,
    weights: Angles | float = 1.0,
    neuron_injections: Float[np.ndarray, "O q p"] | None = None,
    internal_model: InternalModes | None = None,
) -> Float[np.ndarray, "C O"]:
    """Largest closed-loop gain from an error of the output to the input on a frequency grid, for
    every pair of controller and observer. It is `weight sigma_max(T_ue)`, over the neurons' slopes
    0, 1/2 and 1, all alike.

    From below: a peak between two frequencies is missed, an unstable loop is not seen.
    """
    neuron_slopes = None
    if not isinstance(system, StateSpace):
        equal_slopes = np.ones(system.neurons)
        neuron_slopes = np.outer((0.0, 0.5, 1.0), equal_slopes)
    responses = ResponseCache(angles=angles)
    controllers = len(controller_gains)
    observer_count = len(observer_gains)
    peaks = np.zeros((controllers, observer_count))
    gain_shape = controller_gains.shape[1:]
    no_controllers = np.zeros((observer_count, *gain_shape))
    observers = Gains(
        k=no_controllers, l=observer_gains, l_z=neuron_injections, internal=internal_model
    )
    modes = observers.modes
    for linear, frozen, *slope in systems_at_constant_slopes(
        system, observers, balls, neuron_slopes
    ):
        frozen_ls = list(frozen.l)
        for k, peak in zip(controller_gains, peaks, strict=True):
            response = responses.loop_response(linear, k, modes, frozen_ls, *slope)
            weighted = weights * largest_singular_values(response)
            largest = weighted.max(axis=1)
            np.maximum(peak, largest, out=peak)
    return peaks


def largest_singular_values(
    response: Complex[np.ndarray, "*many m p"],
) -> Float[np.ndarray, "*many"]:
    """Largest singular value of each matrix in a stack of matrices."""
    *_, rows, columns = response.shape
    is_scalar = rows == columns == 1
    if is_scalar:
        entries = response[..., 0, 0]
        return np.asarray(np.abs(entries))  # one channel needs no singular values
    return np.linalg.norm(response, ord=2, axis=(-2, -1))
