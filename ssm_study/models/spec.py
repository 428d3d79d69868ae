"""Settings of the linear recurrence between static maps, and the scaled records that it is trained
on."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.models.initial_system import (
    InitialLinearSystem,
    Pairs,
    Range,
    draw_stable_system,
    estimate_initial_system,
)
from ssm_study.models.scaffolds.trainable import MapContext, Trainable
from ssm_study.refusal import require, require_at_least, require_one_of, require_positive
from ssm_study.signals import DataSet

if TYPE_CHECKING:
    from ssm_study.models.torch_ssm import TorchModel, TorchSSM


class ModelSpec(ABC):
    """Base class of settings of a model structure, which build a trainable model. `build` draws
    initial parameters from `seed`."""

    # Whether what is identified is an `SSM`, which the study goes on to certify; a baseline is
    # scored only.
    gives_ssm: ClassVar[bool] = False
    sizes: ClassVar[tuple[str, ...]] = ()  # the fields that are at least 1

    def __post_init__(self) -> None:
        for name in self.sizes:
            number = getattr(self, name)
            require_at_least(1, f"model.{name}", number, "use a positive whole number")

    @abstractmethod
    def build(self, data: DataSet, seed: int) -> "TorchModel":
        """Build a trainable model with random initial parameters."""

    def settings_of_training_run(self, run: int) -> "ModelSpec":  # noqa: ARG002
        """Copy of the model settings for one of several training runs from different initial
        parameters. By default they are the same for all; each has its own seed."""
        return self


@dataclass(frozen=True, kw_only=True)
class SSMSpec(ModelSpec):
    """Settings of a model with a linear recurrence between a static input map and a static output
    map. `x+ = A x + B S_u(u), y = S_y(C x + D S_u(u))`: order n, slopes in `[slope_lower,
    slope_upper]`.

    `start` "ring" draws modes with radii in `ring_radius` and angles (rad per sample) in
    `ring_frequency`, `real_modes` of them real. `slope_*` bound the scaffolding's own sector in
    scaled units; its gain lies in B and C. The states of `dead_time` (samples) come on top of the
    order.
    """

    gives_ssm: ClassVar[bool] = True

    order: int
    hidden_width: int
    slope_lower: float
    slope_upper: float
    feedthrough: bool
    scaffold_in: Trainable
    scaffold_out: Trainable
    start: str = "data"
    real_modes: int = 2
    ring_radius: Range = (0.5, 0.98)
    ring_frequency: Range = (0.05, 1.5)
    dead_time: int = 0

    def __post_init__(self) -> None:
        require_whole_number(0, "dead_time", self.dead_time, "use 0 for none")
        require_whole_number(1, "order", self.order, "a model has at least one state, use 8 or so")
        require_whole_number(1, "hidden_width", self.hidden_width, "use 32 or so")
        check_slope_bounds(self.slope_lower, self.slope_upper)
        starts = ("data", "ring")
        require_one_of(starts, "model.start", self.start)
        if self.start == "ring":
            self._check_pole_ring()

    def _check_pole_ring(self) -> None:
        """Raise `BadRequest` for an impossible range of random poles or number of real poles."""
        require_whole_number(0, "real_modes", self.real_modes, "use 2")
        pairs = self.order - self.real_modes
        remedy = "change it by one, or model.order"
        fits = pairs >= 0 and pairs % 2 == 0
        problem = f"the other states of the {self.order} form pairs, so their number must be even"
        require(fits, "model.real_modes", self.real_modes, problem, remedy)
        radius_limit = ("ring_radius", 1.0)
        frequency_limit = ("ring_frequency", np.pi)
        for name, most in (radius_limit, frequency_limit):
            ends = getattr(self, name)
            end_count = len(ends)
            default = list(getattr(type(self), name))
            fits = end_count == 2 and 0 <= ends[0] < ends[1] <= most
            problem = f"needs two increasing numbers in [0, {most:g}]"
            require(fits, f"model.{name}", ends, problem, f"use the default, {default}")

    def settings_of_training_run(self, run: int) -> "SSMSpec":
        """Copy of the model settings for one of several training runs: the first starts from an
        estimated system, others with random modes."""
        if not run:
            return self
        pairs = (self.order - 1) // 2
        real_modes = self.order - 2 * pairs
        return replace(self, start="ring", real_modes=real_modes)

    def build(self, data: DataSet, seed: int) -> "TorchSSM":
        """Build the trainable model of a linear recurrence between static maps."""
        from ssm_study.models.torch_ssm import LRU, TorchSSM

        rng = np.random.default_rng(seed)
        scaled_records = scale_records(data)
        inputs, outputs = (np.concatenate(part) for part in zip(*scaled_records, strict=True))
        input_context = self._map_context(inputs)
        scaffold_in = self.scaffold_in.build(input_context, rng)
        output_context = self._map_context(outputs)
        scaffold_out = self.scaffold_out.build(output_context, rng)
        records = scale_records_with_disturbances(data)
        start = self._initial_system(records, rng)
        disturbances = data.scale.disturbances
        lru = LRU(start, self.feedthrough, disturbances)
        return TorchSSM(scaffold_in, lru, scaffold_out)

    def _map_context(self, samples: Float[np.ndarray, "N c"]) -> MapContext:
        """Width of the hidden layers, slope bounds and input samples for one of the model's static
        maps."""
        slopes = (self.slope_lower, self.slope_upper)
        return MapContext(width=self.hidden_width, slopes=slopes, samples=samples)

    def _initial_system(self, records: Pairs, rng: np.random.Generator) -> InitialLinearSystem:
        """Linear system with which the training begins, estimated or drawn at random."""
        if self.start == "data":
            return estimate_initial_system(records, self.order, rng, self.feedthrough)
        u, y = records[0]
        input_count = u.shape[1]
        output_count = y.shape[1]
        channels = (input_count, output_count)
        sizes = (self.order, self.real_modes)
        return draw_stable_system(*sizes, self.ring_radius, self.ring_frequency, channels, rng)


def scale_records(data: DataSet) -> Pairs:
    """Convert the training records to scaled units. `(u - u_eq) / input_scale`, `(y - y_eq) /
    output_scale`."""
    scale = data.scale
    inputs = [scale.scaled_input(record.u) for record in data.training]
    outputs = [scale.scaled_output(record.y) for record in data.training]
    pairs = zip(inputs, outputs, strict=True)
    return list(pairs)


def scale_records_with_disturbances(data: DataSet) -> Pairs:
    """Convert the training records to scaled units, with measured disturbances as further
    inputs."""
    return scale_records(data.with_disturbances_as_inputs())


def require_whole_number(minimum: int, name: str, value: object, remedy: str) -> None:
    """Raise `BadRequest` for a model setting that is no whole number or is below its minimum."""
    fits = isinstance(value, int) and not isinstance(value, bool) and value >= minimum
    require(fits, f"model.{name}", value, f"must be a whole number, at least {minimum}", remedy)


def check_slope_bounds(lower: float, upper: float) -> None:
    """Raise `BadRequest` for slope bounds whose interval is empty or includes zero."""
    require_positive("model.slope_lower", lower, "use 0.01 or so")
    fits = lower < upper < np.inf
    names = "model.slope_lower, model.slope_upper"
    problem = "the lower slope must lie below the upper one"
    bounds = (lower, upper)
    require(fits, names, bounds, problem, "give lower < upper")
