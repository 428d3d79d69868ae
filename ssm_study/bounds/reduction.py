"""The configured step between identification and synthesis: balanced coordinates, fewer states. Source: Moore 1981."""

from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

from ssm_study.bounds.absorb import absorbed
from ssm_study.bounds.hankel import BALANCING_FLOOR, balance, hankel_singular_values
from ssm_study.models.identified import SSM
from ssm_study.refusal import require
from ssm_study.systems import StateSpace


@runtime_checkable
@runtime_checkable
class HasLinear(Protocol):
    """Any model whose linear part can be read and replaced."""

    @property
    def linear(self) -> StateSpace: ...

    def with_linear(self, linear: StateSpace) -> Any: ...


Model = TypeVar("Model", bound=HasLinear)


@dataclass(frozen=True, kw_only=True)
class Reduction:
    """`x = T z` with equal, diagonal Gramians; then keep the states that carry something.

    `truncate_to` keeps that many states (None: all). `drop_below` drops states whose Hankel singular value is below
    this share of the largest, whatever `truncate_to` says: they would make the coordinates ill-conditioned and ask
    the controller to move modes it can hardly reach. `absorb` first moves rotations and gains of
    multi-channel scaffoldings into B and C (see `bounds.absorb`). `balanced=False` keeps the model's coordinates.
    """

    balanced: bool = True
    truncate_to: int | None = None
    drop_below: float = 1e-6
    absorb: bool = True

    def __post_init__(self) -> None:
        order = self.truncate_to
        require(order is None or order >= 1, "reduction.truncate_to", order, "at least one state must stay", "use >= 1")
        require(
            BALANCING_FLOOR <= self.drop_below < 1,
            "reduction.drop_below",
            self.drop_below,
            f"must lie in [{BALANCING_FLOOR:g}, 1)",
            "1e-6 changes the output by about one part in a million",
        )
        require(
            self.balanced or order is None,
            "reduction.balanced",
            self.balanced,
            "truncation happens in balanced coordinates",
            "set reduction.balanced=true or reduction.truncate_to=null",
        )

    def reduce(self, model: Model) -> Model:
        """The same model in balanced coordinates, with the kept states only."""
        if self.absorb and isinstance(model, SSM):
            model = absorbed(model)  # type: ignore[assignment]
        if not self.balanced:
            return model
        hankel = hankel_singular_values(model.linear)
        kept = int((hankel > self.drop_below * hankel[0]).sum())
        order = min(kept, self.truncate_to or model.linear.order)
        return model.with_linear(balance(model.linear, order).linear)
