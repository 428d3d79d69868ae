"""Settings of the structured model (`conf/model/structured.yaml`), and its trainable static maps
with derivatives."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int

from ssm_study.models.scaffolds.linear import Linear, LinearScaffold
from ssm_study.models.scaffolds.monotone import Monotone, MonotoneScaffold
from ssm_study.models.scaffolds.scaffold import Scaffold
from ssm_study.models.spec import ModelSpec, SSMSpec, check_slope_bounds, require_whole_number
from ssm_study.models.structured import activation_codes
from ssm_study.refusal import require, require_at_least, require_one_of

AUTO = "auto"  # chosen from the records
# Settings that the records may choose, and what they are where records are too short to choose.
AUTOMATIC: dict[str, Any] = {
    "order": 5,
    "neurons": 5,
    "input_path": "none",
    "feedthrough": False,
    "dead_time": 0,
    "integrating_output": False,
    "knots": 16,
    "rate": 0.999,
}
# Settings that are whole numbers, and the least that each may be.
LEAST = {
    "order": 1,
    "neurons": 0,
    "knots": 0,
    "output_knots": 0,
    "dead_time": 0,
    "starts": 1,
    "members": 1,
    "draws": 1,
}
Free = Float[np.ndarray, "P"]
Signals = Float[np.ndarray, "*batch c"]


@dataclass(frozen=True)
class TrainablePiecewiseMap:
    """Trainable piecewise-linear static map with analytical derivatives, used without torch.
    `S_c(v) = int_0^v s_c`, slopes `s = lower + (upper - lower) / (1 + exp(-free))` between the
    sorted `points`.

    Its parameters in order: `free (c, h + 1)`, then `points (c, h)`; without break points (`knots`)
    the identity, which has none. The last `passed` channels are measured disturbances, which stay
    unchanged.
    """

    channels: int
    knots: int
    lower: float
    upper: float
    passed: int = 0

    @property
    def parameter_channels(self) -> Int[np.ndarray, "P"]:
        """Index of the channel to which each parameter of a piecewise-linear map belongs."""
        each = np.arange(self.channels)
        if not self.knots:
            return each[:0]
        slope_count = self.knots + 1
        of_slopes = np.repeat(each, slope_count)
        of_points = np.repeat(each, self.knots)
        return np.concatenate([of_slopes, of_points])

    def initial_parameters(self, samples: Float[np.ndarray, "N c"]) -> Free:
        """Initial parameters of a piecewise-linear map: equal slopes and evenly spaced break
        points. None of them is near the ends, which are rarely visited."""
        if not self.knots:
            return np.zeros(0)
        mapped = samples[:, : self.channels]
        low = mapped.min(axis=0)
        high = mapped.max(axis=0)
        middles = np.arange(self.knots) + 0.5
        places = (high - low) * middles[:, None]
        points = low + places / self.knots
        slope_count = self.knots + 1
        slopes = np.zeros(self.channels * slope_count)
        flat_points = points.T.ravel()
        return np.concatenate([slopes, flat_points])

    def _slopes_and_points(self, theta: Free) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Slopes of a piecewise-linear map, their derivatives with respect to the free parameters,
        and the break points. Each has one row per channel."""
        slope_count = self.knots + 1
        split = self.channels * slope_count
        free_slopes = theta[:split]
        free = free_slopes.reshape(self.channels, -1)
        free_points = theta[split:]
        points = free_points.reshape(self.channels, -1)
        odds = np.exp(-free)
        share = 1.0 / (1.0 + odds)  # the logistic function
        width = self.upper - self.lower
        slopes = self.lower + width * share
        by_free = width * share * (1.0 - share)
        return slopes, by_free, points

    def evaluate_with_derivatives(
        self, theta: Free, v: Signals
    ) -> tuple[Signals, Signals, Float[np.ndarray, "*batch P"]]:
        """Values and slopes of a piecewise-linear map at given inputs, and derivatives of the
        values with respect to the parameters. A parameter changes only the channel to which it
        belongs.

        `dS/ds_j` is the signed length of `[0, v]` within piece j; `dS/dt_j = s_j - s_{j+1}` where
        t_j lies between 0 and v, negative where v < 0.
        """
        if not self.knots:
            unit_slopes = np.ones_like(v)
            return v, unit_slopes, np.zeros((*v.shape[:-1], 0))
        values = v.copy()
        at = np.ones_like(v)
        frees = []
        moves = []
        pieces_of_channels = self._slopes_and_points(theta)
        channels = zip(*pieces_of_channels, strict=True)
        for c, (slopes, by_free, points) in enumerate(channels):
            order = np.argsort(points, kind="stable")
            inner = points[order]
            minus_infinity = [-np.inf]
            lower = np.concatenate([minus_infinity, inner])
            infinity = [np.inf]
            upper = np.concatenate([inner, infinity])
            x = v[..., c, None]
            clipped = np.clip(x, lower, upper)
            clipped_zero = np.clip(0.0, lower, upper)
            inside = clipped - clipped_zero
            values[..., c] = inside @ slopes
            channel_values = v[..., c]
            piece = np.searchsorted(inner, channel_values, side="right")
            at[..., c] = slopes[piece]
            frees.append(inside * by_free)
            # Which break points lie between 0 and v.
            is_beyond = (x > inner).astype(float)
            passed = is_beyond - (inner < 0.0)
            by_points = passed * -np.diff(slopes)
            in_order_of_parameters = np.argsort(order)
            moves.append(by_points[..., in_order_of_parameters])
        derivatives = [*frees, *moves]
        return values, at, np.concatenate(derivatives, axis=-1)

    def evaluate(self, theta: Free, v: Signals) -> Signals:
        """Values of a piecewise-linear map at given inputs, with untrained channels returned
        unchanged."""
        trained_map = self.to_numpy(theta)
        mapped = trained_map(v[..., : self.channels])
        if not self.passed:
            return mapped
        unchanged = v[..., self.channels :]
        all_channels = [mapped, unchanged]
        return np.concatenate(all_channels, axis=-1)

    def to_numpy(self, theta: Free) -> Scaffold:
        """Copy of a trained piecewise-linear map with fixed parameters, as the stored model
        contains it."""
        if not self.knots:
            return LinearScaffold.identity(self.channels)
        slopes, _, points = self._slopes_and_points(theta)
        breakpoints = np.sort(points, axis=1)
        return MonotoneScaffold(breakpoints=breakpoints, slopes=slopes)


@dataclass(frozen=True, kw_only=True)
class StructuredSpec(ModelSpec):
    """Settings of the structured model, a recurrence with neurons between a static input map and a
    static output map. `x+ = A x + B v + E w, w = phi(F x + G v + b) - phi(b), y = S_y(C x + D v + H
    w), v = S_u(u)`.

    What each setting does: conf/model/structured.yaml and docs/models.md. `among_starts` takes one
    of the results of several trainings (`settings_of_training_run`), null that of the best
    validation fit. Source: docs/theory.md, "With neurons".
    """

    gives_ssm: ClassVar[bool] = True

    order: int | str
    neurons: int | str
    kinds: str | list[str] = "tanh"
    input_path: str = "none"
    output_path: str = "none"
    feedthrough: bool | str = False
    dead_time: int | str = 0
    knots: int | str = 16
    output_knots: int = 0
    slope_lower: float = 0.01
    slope_upper: float = 1.0
    rate: float | str | None = 0.999
    ridge: float = 1e-6
    starts: int = 4
    members: int = 1
    among_starts: Callable[[Any], Any] | None = None
    draws: int = 8
    start_steps: list[int] | tuple[int, int, int] = (15, 20, 10)
    integrating_output: bool | str = False
    gain_share: float = 0.0
    refit: bool = True

    def __post_init__(self) -> None:
        self._check_whole_numbers()
        self._check_allowed_words()
        self._check_numbers()
        self._check_integrator()

    def _check_whole_numbers(self) -> None:
        """Raise `BadRequest` for settings of the structured model that should be whole numbers but
        are not."""
        for name, least in LEAST.items():
            value = getattr(self, name)
            may_be_chosen = name in AUTOMATIC
            if may_be_chosen and value == AUTO:
                continue
            alternative = f", or {AUTO}" if may_be_chosen else ""
            require_whole_number(least, name, value, f"use 4 or so{alternative}")

    def _check_allowed_words(self) -> None:
        """Raise `BadRequest` for a setting of the structured model that is none of the allowed
        words."""
        flags = (True, False, AUTO)
        require_one_of(flags, "model.feedthrough", self.feedthrough)
        require_one_of(flags, "model.integrating_output", self.integrating_output)
        if self.neurons != AUTO:
            activation_codes(self.neuron_kinds)
        allowed_input_paths = ("none", "staged", "free", AUTO)
        require_one_of(allowed_input_paths, "model.input_path", self.input_path)
        allowed_output_paths = ("none", "free")
        require_one_of(allowed_output_paths, "model.output_path", self.output_path)

    def _check_numbers(self) -> None:
        """Raise `BadRequest` for numeric settings of the structured model outside their allowed
        ranges."""
        check_slope_bounds(self.slope_lower, self.slope_upper)
        inside = self.rate is None or self.rate == AUTO or 0 < float(self.rate) <= 1
        remedy = "use 0.999, or null for a free model"
        require(inside, "model.rate", self.rate, "must lie in (0, 1]", remedy)
        require_at_least(0, "model.ridge", self.ridge, "use 1e-6")
        share = self.gain_share
        problem = "must be a share of the largest gain, from 0 to below 1"
        is_share = 0 <= share < 1
        require(is_share, "model.gain_share", share, problem, "use 0.05, or 0 for none")
        steps = self.start_steps
        step_count = len(steps)
        fits = step_count == 3 and min(steps) >= 1
        problem = "needs three numbers, at least 1"
        require(fits, "model.start_steps", steps, problem, "use [15, 20, 10]")

    def _check_integrator(self) -> None:
        """Raise `BadRequest` for settings that cannot be combined with an integrator at the model's
        output."""
        if self.integrating_output is not True:
            return
        problem = "model.integrating_output=true needs neurons"
        has_neurons = self.neurons != 0
        require(
            has_neurons,
            "model.neurons",
            self.neurons,
            problem,
            "use 1 or more, or auto for model.integrating_output",
        )
        problem = "an output that integrates needs a linear output map, which has no knots"
        is_linear = not self.output_knots
        require(is_linear, "model.output_knots", self.output_knots, problem, "use 0")

    @property
    def neuron_kinds(self) -> tuple[str, ...]:
        """Name of the activation function of each neuron."""
        kinds = [self.kinds] if isinstance(self.kinds, str) else list(self.kinds)
        kind_count = len(kinds)
        require(kind_count > 0, "model.kinds", kinds, "names no kind of neuron", "use tanh")
        neuron_count = int(self.neurons)
        kinds_of_neurons = (kinds[i % len(kinds)] for i in range(neuron_count))
        return tuple(kinds_of_neurons)

    @property
    def automatic_settings(self) -> tuple[str, ...]:
        """Names of the model settings that are to be chosen from the records."""
        automatic = (name for name in AUTOMATIC if getattr(self, name) == AUTO)
        return tuple(automatic)

    @property
    def training_run_count(self) -> int:
        """Number of training runs from different initial parameters that the settings require. It
        is `starts`, one more with `among_starts`, and at least as many as `members` need."""
        has_extra_start = self.among_starts is not None
        return max(self.starts + has_extra_start, self.members)

    def settings_of_training_run(self, run: int) -> "StructuredSpec":
        """Copy of the model settings for one of several training runs, some of which use a smaller
        model. With `among_starts` each odd number and the last have half the states, the last no
        neurons.

        More can be certified of such models, where they suffice.
        """
        if self.among_starts is None:
            return self
        whole_order = int(self.order) + 1
        half = replace(self, order=whole_order // 2)
        if run == self.training_run_count - 1:
            return replace(half, neurons=0, integrating_output=False)
        return half if run % 2 else self

    def build_maps(
        self, channels: tuple[int, int], disturbances: int = 0
    ) -> tuple[TrainablePiecewiseMap, TrainablePiecewiseMap]:
        """Trainable input and output maps of the structured model for given numbers of channels.
        Measured disturbances pass through S_u unchanged."""
        lower = self.slope_lower
        upper = self.slope_upper
        knots = int(self.knots)
        lift = TrainablePiecewiseMap(channels[0], knots, lower, upper, passed=disturbances)
        read = TrainablePiecewiseMap(channels[1], self.output_knots, lower, upper)
        return lift, read

    def settings_without_neurons(self) -> SSMSpec:
        """Settings of the linear recurrence between static maps that a structured model without
        neurons is."""
        inward = Monotone() if self.knots else Linear()
        outward = Monotone() if self.output_knots else Linear()
        knots = int(self.knots)
        width = max(knots, self.output_knots, 1)  # of both maps: one number in SSMSpec
        feedthrough = self.feedthrough is True
        return SSMSpec(
            order=self.order,  # type: ignore[arg-type] # decided before
            hidden_width=width,
            slope_lower=self.slope_lower,
            slope_upper=self.slope_upper,
            feedthrough=feedthrough,
            scaffold_in=inward,
            scaffold_out=outward,
        )

    def build(self, data: Any, seed: int) -> Any:  # noqa: ARG002
        """Raise an error, because a structured model is trained without torch."""
        raise TypeError("this model has a training of its own, without torch")
