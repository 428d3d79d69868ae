"""Settings of `conf/model/structured.yaml`, and the trainable maps S_u and S_y with their
derivatives."""

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
class TrainablePieces:
    """Trainable piecewise-linear static map whose derivatives are explicit formulas. `S_c(v) =
    int_0^v s_c`, slopes `s = lower + (upper - lower) / (1 + exp(-free))` between the sorted
    `points`.

    Its parameters in order: `free (c, h + 1)`, then `points (c, h)`; without break points (`knots`)
    the identity, which has none. Behind the channels come `passed` ones that pass as they are:
    measured disturbances.
    """

    channels: int
    knots: int
    lower: float
    upper: float
    passed: int = 0

    @property
    def parameter_channels(self) -> Int[np.ndarray, "P"]:
        """Index of the channel to which each parameter of the map belongs."""
        each = np.arange(self.channels)
        knots = self.knots
        return (
            np.concatenate([np.repeat(each, knots + 1), np.repeat(each, knots)])
            if knots
            else each[:0]
        )

    def initial_parameters(self, samples: Float[np.ndarray, "N c"]) -> Free:
        """Initial parameters of the map, with equal slopes and evenly spaced break points. None of
        them is near the ends, which are rarely visited."""
        if not self.knots:
            return np.zeros(0)
        low = samples[:, : self.channels].min(axis=0)
        high = samples[:, : self.channels].max(axis=0)
        points = low + (high - low) * (np.arange(self.knots) + 0.5)[:, None] / self.knots
        return np.concatenate([np.zeros(self.channels * (self.knots + 1)), points.T.ravel()])

    def _slopes_and_points(self, theta: Free) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Slopes, their derivatives with respect to the free parameters, and the sorted break
        points. Each has one row per channel."""
        split = self.channels * (self.knots + 1)
        share = 1.0 / (
            1.0 + np.exp(-theta[:split].reshape(self.channels, -1))
        )  # the logistic function
        width = self.upper - self.lower
        return (
            self.lower + width * share,
            width * share * (1.0 - share),
            theta[split:].reshape(self.channels, -1),
        )

    def derivatives(
        self, theta: Free, v: Signals
    ) -> tuple[Signals, Signals, Float[np.ndarray, "*batch P"]]:
        """Values of the map, its slopes, and its derivatives with respect to the parameters. A
        parameter changes only the channel to which it belongs.

        `dS/ds_j` is the signed length of `[0, v]` within piece j; `dS/dt_j = s_j - s_{j+1}` where
        t_j lies between 0 and v, negative where v < 0.
        """
        if not self.knots:
            return v, np.ones_like(v), np.zeros((*v.shape[:-1], 0))
        values = v.copy()
        at = np.ones_like(v)
        frees = []
        moves = []
        for c, (slopes, by_free, points) in enumerate(
            zip(*self._slopes_and_points(theta), strict=True)
        ):
            order = np.argsort(points, kind="stable")
            ends = np.concatenate([[-np.inf], points[order], [np.inf]])
            x = v[..., c, None]
            inside = np.clip(x, ends[:-1], ends[1:]) - np.clip(0.0, ends[:-1], ends[1:])
            values[..., c] = inside @ slopes
            at[..., c] = slopes[np.searchsorted(ends[1:-1], v[..., c], side="right")]
            frees.append(inside * by_free)
            passed = (x > ends[1:-1]).astype(float) - (
                ends[1:-1] < 0.0
            )  # which break points lie between 0 and v
            moves.append(
                (passed * -np.diff(slopes))[..., np.argsort(order)]
            )  # back in the order of the parameters
        return values, at, np.concatenate([*frees, *moves], axis=-1)

    def values(self, theta: Free, v: Signals) -> Signals:
        """Values of the map, followed by the channels that it leaves unchanged."""
        mapped = self.freeze(theta)(v[..., : self.channels])
        return np.concatenate([mapped, v[..., self.channels :]], axis=-1) if self.passed else mapped

    def freeze(self, theta: Free) -> Scaffold:
        """Trained map as explicit numbers, without the channels that it leaves unchanged."""
        if not self.knots:
            return LinearScaffold.identity(self.channels)
        slopes, _, points = self._slopes_and_points(theta)
        return MonotoneScaffold(breakpoints=np.sort(points, axis=1), slopes=slopes)


@dataclass(frozen=True, kw_only=True)
class StructuredSpec(ModelSpec):
    """Settings of the structured model. `x+ = A x + B v + E w, w = phi(F x + G v + b) - phi(b), y =
    S_y(C x + D v + H w), v = S_u(u)`.

    What each setting does: conf/model/structured.yaml and docs/models.md. `among_starts` takes one
    of the results of several trainings (`for_training_run`), null that of the best validation fit.
    Source: docs/theory.md, "With neurons".
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
        for name, least in LEAST.items():
            if name in AUTOMATIC and getattr(self, name) == AUTO:
                continue
            alternative = f", or {AUTO}" if name in AUTOMATIC else ""
            require_whole_number(least, name, getattr(self, name), f"use 4 or so{alternative}")
        require_one_of((True, False, AUTO), "model.feedthrough", self.feedthrough)
        require_one_of((True, False, AUTO), "model.integrating_output", self.integrating_output)
        if self.neurons != AUTO:
            activation_codes(self.neuron_kinds)
        require_one_of(("none", "staged", "free", AUTO), "model.input_path", self.input_path)
        require_one_of(("none", "free"), "model.output_path", self.output_path)
        check_slope_bounds(self.slope_lower, self.slope_upper)
        inside = self.rate is None or self.rate == AUTO or 0 < float(self.rate) <= 1
        require(
            inside,
            "model.rate",
            self.rate,
            "must lie in (0, 1]",
            "use 0.999, or null for a free model",
        )
        require_at_least(0, "model.ridge", self.ridge, "use 1e-6")
        require(
            0 <= self.gain_share < 1,
            "model.gain_share",
            self.gain_share,
            "is a share of the largest gain",
            "use 0.05, or 0 for none",
        )
        three = len(self.start_steps) == 3 and min(self.start_steps) >= 1
        require(
            three,
            "model.start_steps",
            self.start_steps,
            "needs three numbers, at least 1",
            "use [15, 20, 10]",
        )
        integrates = self.integrating_output is True
        problem = "without neurons no integrator is set apart: a mode comes near one by itself"
        require(
            not (integrates and self.neurons == 0),
            "model.neurons",
            self.neurons,
            problem,
            "use 1 or more",
        )
        plain = not (integrates and self.output_knots)
        require(
            plain,
            "model.output_knots",
            self.output_knots,
            "an integrating output has a linear S_y",
            "use 0",
        )

    @property
    def neuron_kinds(self) -> tuple[str, ...]:
        """Kind of activation of each neuron."""
        kinds = [self.kinds] if isinstance(self.kinds, str) else list(self.kinds)
        require(len(kinds) > 0, "model.kinds", kinds, "names no kind of neuron", "use tanh")
        return tuple(kinds[i % len(kinds)] for i in range(int(self.neurons)))

    @property
    def automatic_settings(self) -> tuple[str, ...]:
        """Names of the settings that are chosen from the records."""
        return tuple(name for name in AUTOMATIC if getattr(self, name) == AUTO)

    @property
    def training_count(self) -> int:
        """Number of training runs from different initial parameters. It is `starts`, one more with
        `among_starts`, and at least as many as `members` need."""
        return max(self.starts + (self.among_starts is not None), self.members)

    def for_training_run(self, start: int) -> "StructuredSpec":
        """Settings for one of several training runs, given by its number. With `among_starts` each
        odd number and the last have half the states, the last no neurons.

        More can be certified of such models, where they suffice.
        """
        if self.among_starts is None:
            return self
        last = start == self.training_count - 1
        smaller = replace(self, order=(int(self.order) + 1) // 2) if start % 2 or last else self
        return replace(smaller, neurons=0, integrating_output=False) if last else smaller

    def build_maps(
        self, channels: tuple[int, int], disturbances: int = 0
    ) -> tuple[TrainablePieces, TrainablePieces]:
        """Trainable input and output maps for given numbers of channels. Measured disturbances pass
        through S_u unchanged."""
        lower = self.slope_lower
        upper = self.slope_upper
        lift = TrainablePieces(channels[0], int(self.knots), lower, upper, passed=disturbances)
        read = TrainablePieces(channels[1], self.output_knots, lower, upper)
        return lift, read

    def without_neurons(self) -> SSMSpec:
        """Settings of the same model without neurons, which is trained as `model=ssm` is."""
        inward, outward = (
            Monotone() if knots else Linear() for knots in (self.knots, self.output_knots)
        )
        shared = {name: getattr(self, name) for name in ("order", "slope_lower", "slope_upper")}
        shared["feedthrough"] = self.feedthrough is True  # `auto` is decided before
        width = max(int(self.knots), self.output_knots, 1)  # of both maps: one number in SSMSpec
        return SSMSpec(hidden_width=width, scaffold_in=inward, scaffold_out=outward, **shared)

    def build(self, data: Any, seed: int) -> Any:  # noqa: ARG002
        """Raise an error, since a structured model is trained without torch
        (`training.structured_fit`)."""
        raise TypeError("it has a training of its own")
