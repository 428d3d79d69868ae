"""What `conf/model/ssm.yaml` says, and how it becomes a trainable model."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.models.scaffold_specs import Frame, ScaffoldSpec
from ssm_study.models.start import from_data, on_ring
from ssm_study.models.torch_lru import LRU, Start
from ssm_study.models.torch_ssm import TorchModel, TorchSSM
from ssm_study.refusal import require
from ssm_study.signals import DataSet


class ModelSpec(ABC):
    """A choice of model structure; `build` returns it at its starting point, drawn from `seed`."""

    gives_ssm: ClassVar[bool] = False
    """Whether what is identified is an `SSM`, which the study goes on to certify; a baseline is scored only."""

    @abstractmethod
    def build(self, data: DataSet, seed: int) -> TorchModel: ...


@dataclass(frozen=True, kw_only=True)
class SSMSpec(ModelSpec):
    """`x+ = A x + B S_u(u), y = S_y(C x + D S_u(u))`: order n, slopes in `[slope_lower, slope_upper]`.

    `start`: "data" takes the modes of a least-squares fit, "ring" draws them with radii in `ring_radius` and angles
    (rad per sample) in `ring_frequency`, `real_modes` of them real (only then used). `slope_*` bound the scaffolding's
    own sector in scaled units; its gain lies in B and C.
    """

    gives_ssm: ClassVar[bool] = True

    order: int
    hidden_width: int
    slope_lower: float
    slope_upper: float
    feedthrough: bool
    scaffold_in: ScaffoldSpec
    scaffold_out: ScaffoldSpec
    start: str = "data"
    real_modes: int = 2
    ring_radius: tuple[float, float] | list[float] = (0.5, 0.98)
    ring_frequency: tuple[float, float] | list[float] = (0.05, 1.5)

    def __post_init__(self) -> None:
        order, real = self.order, self.real_modes
        require(_whole(order) and order >= 1, "model.order", order, "a model has at least one state", "use 8 or so")
        width = self.hidden_width
        require(_whole(width) and width >= 1, "model.hidden_width", width, "needs at least one neuron", "use 32 or so")
        lower, upper = self.slope_lower, self.slope_upper
        require(lower > 0, "model.slope_lower", lower, "certificates need slopes above zero", "use 0.01 or so")
        require(
            lower < upper < np.inf,
            "model.slope_lower, model.slope_upper",
            (lower, upper),
            "the lower slope must lie below the upper one",
            "swap or separate them",
        )
        require(self.start in ("data", "ring"), "model.start", self.start, "unknown starting point", "use data or ring")
        if self.start == "ring":
            fits = _whole(real) and 0 <= real <= order and (order - real) % 2 == 0
            remedy = "leave an even number of states for the pairs"
            require(fits, "model.real_modes", real, f"{order} states minus these must be pairs", remedy)
            _check_range("model.ring_radius", self.ring_radius, 0.0, 1.0)
            _check_range("model.ring_frequency", self.ring_frequency, 0.0, np.pi)

    def build(self, data: DataSet, seed: int) -> TorchSSM:
        rng = np.random.default_rng(seed)
        records = scaled(data)
        slopes = (self.slope_lower, self.slope_upper)
        seen = np.concatenate([u for u, _ in records]), np.concatenate([y for _, y in records])
        frames = [Frame(width=self.hidden_width, slopes=slopes, samples=samples) for samples in seen]
        scaffold_in, scaffold_out = self.scaffold_in.build(frames[0], rng), self.scaffold_out.build(frames[1], rng)
        lru = LRU(self._start(records, rng), self.feedthrough)
        return TorchSSM(scaffold_in, lru, scaffold_out)

    def draw_start(self) -> "SSMSpec":
        """The same model started from random modes: what a further start of a multistart begins with."""
        return replace(self, start="ring", real_modes=self.order - 2 * ((self.order - 1) // 2))

    def _start(self, records: list[tuple[np.ndarray, np.ndarray]], rng: np.random.Generator) -> Start:
        if self.start == "data":
            return from_data(records, self.order, rng, self.feedthrough)
        channels = (records[0][0].shape[1], records[0][1].shape[1])
        radius, frequency = self.ring_radius, self.ring_frequency
        ranges = (radius[0], radius[1]), (frequency[0], frequency[1])
        return on_ring(self.order, self.real_modes, *ranges, channels, rng)


def scaled(data: DataSet) -> list[tuple[Float[np.ndarray, "_ m"], Float[np.ndarray, "_ p"]]]:
    """Training records in scaled units: `(u - u_eq) / input_scale`, `(y - y_eq) / output_scale`."""
    return [
        (
            (record.u - data.input_equilibrium) / data.input_scale,
            (record.y - data.output_equilibrium) / data.output_scale,
        )
        for record in data.training
    ]


def _whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _check_range(field: str, values: tuple[float, float] | list[float], least: float, most: float) -> None:
    fits = len(values) == 2 and least <= values[0] < values[1] <= most
    require(fits, field, values, f"needs two increasing numbers in [{least:g}, {most:g}]", "correct the range")
