"""Static map of the paper: a multilayer perceptron with leaky ReLU, shifted so that it is zero at
zero."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import Network, PortableMap
from ssm_study.bounds.slopes import SlopeBound, network_bound
from ssm_study.models.lazy_torch import Tensor, torch
from ssm_study.models.scaffolds import scaffold
from ssm_study.models.scaffolds.scaffold import Free, Pieces, Scaffold, Square, tensor_to_numpy
from ssm_study.models.scaffolds.trainable import MapContext, Trainable
from ssm_study.refusal import require_at_least

# how far a unit of a free jump moves the logit of the slopes beyond it; small keeps training smooth
JUMP_UNIT = 0.3
# `(W (h, m), b (h,), negative slopes (h,), positive slopes (h,), what comes after (k, h) or None)`.
Layer = tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]
Sector = tuple[float, float]
StartingValues = dict[str, Float[np.ndarray, "..."]]


@dataclass(frozen=True, kw_only=True)
class MlpScaffold(Scaffold, names=("mlp",)):
    """Static map that is a multilayer perceptron with leaky ReLU and is zero at zero. `S(v) = N(v)
    - N(0)`, N of any depth and width.

    For one input and one hidden layer the slope is constant between the break points `-b_i / w_i`.
    Source: [Z26] section IV.
    """

    network: Network

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        return self.network(v)

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k m"]:
        return self.network.jacobian(v)

    def bound(self) -> SlopeBound:
        return network_bound(self.network)

    def jacobian_centre(self) -> Square:
        from ssm_study.bounds.lipsdp import lipsdp_ball

        return lipsdp_ball(self.network)[0]

    def compose_with_output_matrix(self, m: Square) -> "MlpScaffold":
        *inner, last = self.network.weights
        return MlpScaffold(network=replace(self.network, weights=(*inner, m @ last)))

    def compose_with_input_matrix(self, m: Square) -> "MlpScaffold":
        first, *inner = self.network.weights
        return MlpScaffold(network=replace(self.network, weights=(first @ m, *inner)))

    def as_portable(self) -> PortableMap:
        linear = np.zeros((self.network.outputs, self.network.inputs))
        return PortableMap(linear=linear, network=self.network)


@dataclass(frozen=True, kw_only=True)
class Mlp(Trainable):
    """Trainable multilayer perceptron of the paper. It has `depth` hidden layers of leaky ReLU,
    whose slopes are fixed at the sector's ends or trained inside the sector.

    `certified` keeps every Jacobian in the sector by construction: of one channel the slopes of the
    whole map are trained, whatever `train_slopes` says (`OneChannel`); of several

        S = S_L o ... o S_1,  S_l(v) = W^T (phi(W v + b) - phi(b)),  W^T W = I,  phi' in [lower_l,
        upper_l]

    Each Jacobian `W^T diag(phi') W` is symmetric with eigenvalues in `[lower_l, upper_l]`;
    `layer_slope_bounds` splits the sector so that the composition of all layers stays inside.
    """

    depth: int
    train_slopes: bool
    certified: bool

    def __post_init__(self) -> None:
        require_at_least(1, "scaffold.depth", self.depth, "use 1 (the paper's)")

    def build(self, frame: MapContext, rng: np.random.Generator) -> Any:
        if self.certified and frame.samples.shape[1] == 1:
            return OneChannel(depth=self.depth).build(frame, rng)
        return super().build(frame, rng)

    def initial_values(self, frame: MapContext, rng: np.random.Generator) -> StartingValues:
        h = frame.width
        if self.certified:
            free = certified_initial_layers(frame, self.depth, rng)
        else:
            free = unconstrained_initial_layers(frame, self.depth, rng)
        if self.train_slopes:  # they begin near the two ends of the sector
            for i in range(self.depth):
                free[f"slope_negative_{i}"] = np.full(h, -2.0)
                free[f"slope_positive_{i}"] = np.full(h, 2.0)
        return free

    def explicit_parameters(self, free: Free, slopes: Sector) -> list[Layer]:
        return [self._layer_weights(free, i, slopes) for i in range(self.depth)]

    def _layer_weights(self, free: Free, i: int, slopes: Sector) -> Layer:
        """Weights, biases and slopes of one layer of the perceptron."""
        if not self.certified:
            bias = free[f"bias_{i}"]
            is_last = i == self.depth - 1
            after = free[f"weight_{self.depth}"] if is_last else None
            return (free[f"weight_{i}"], bias, *self._bounded_slopes(free, i, slopes, bias), after)
        v = free[f"direction_{i}"]
        # W = V R^{-T} has W^T W = I, and is cheap to differentiate.
        root = torch.linalg.cholesky(v.T @ v)
        w = torch.linalg.solve_triangular(root, v.T, upper=False).T
        # A neuron bends where its unit direction meets the kink.
        bias = -free[f"kink_{i}"] * w.norm(dim=1)
        sector = layer_slope_bounds(*slopes, self.depth, 2)
        return (w, bias, *self._bounded_slopes(free, i, sector, bias), w.T)

    def _bounded_slopes(
        self, free: Free, layer: int, sector: Sector, like: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Slopes of the neurons for negative and for positive arguments, within the sector. They
        are fixed at its two ends, or trained inside by a logistic map."""
        lower, upper = sector
        if not self.train_slopes:
            return torch.full_like(like, lower), torch.full_like(like, upper)
        sides = (free[f"slope_{side}_{layer}"] for side in ("negative", "positive"))
        low, high = (lower + (upper - lower) * torch.sigmoid(side) for side in sides)
        return low, high

    def evaluate(
        self, explicit: list[Layer], v: Float[Tensor, "*batch m"]
    ) -> Float[Tensor, "*batch m"]:
        for w, b, low, high, after in explicit:
            z = v @ w.T + b
            v = torch.where(z >= 0, high, low) * z - torch.where(b >= 0, high, low) * b
            v = v if after is None else v @ after.T
        return v

    def pieces(self, explicit: list[Layer]) -> Pieces | None:
        """Affine pieces of a one-channel perceptron between its break points. `sum_i last_i
        phi_i(first_i v + b_i)`."""
        w, b, low, high, after = explicit[0]
        if after is None or w.shape[1] > 1:  # several inputs, or several layers of free weights
            return None
        first = w[:, 0]
        last = after[0]
        points, order = (-b / first).sort()
        piece = torch.arange(len(order) + 1, device=order.device)
        beyond = piece[:, None] > order.argsort()[None, :]  # piece j lies right of kink i
        active = torch.where(beyond == (first > 0), high, low)  # slope of neuron i in piece j
        offsets = active @ (last * b)
        home = torch.searchsorted(points.detach(), points.new_zeros(1), right=True)
        return points, active @ (last * first), offsets - offsets[home]

    def freeze(self, explicit: list[Layer], slopes: Sector) -> MlpScaffold:  # noqa: ARG002
        weights = []
        biases = []
        negative = []
        positive = []
        before = None  # what comes after the layer before
        for w, bias, low, high, after in explicit:
            weight = tensor_to_numpy(w)
            weights.append(weight if before is None else weight @ tensor_to_numpy(before))
            biases.append(tensor_to_numpy(bias))
            negative.append(tensor_to_numpy(low))
            positive.append(tensor_to_numpy(high))
            before = after
        assert before is not None  # nothing but weights comes after the last layer
        network = Network(
            weights=(*weights, tensor_to_numpy(before)),
            biases=tuple(biases),
            negative_slopes=tuple(negative),
            positive_slopes=tuple(positive),
        )
        return MlpScaffold(network=network)


def certified_initial_layers(
    frame: MapContext, depth: int, rng: np.random.Generator
) -> StartingValues:
    """Initial weights and break points for each layer of a perceptron whose slopes are
    certified."""
    layers = [draw_layer(frame.samples, frame.width, rng) for _ in range(depth)]
    directions = {f"direction_{i}": weights for i, (weights, _) in enumerate(layers)}
    kinks = {f"kink_{i}": values for i, (_, values) in enumerate(layers)}
    return directions | kinks


def unconstrained_initial_layers(
    frame: MapContext, depth: int, rng: np.random.Generator
) -> StartingValues:
    """Initial weights and biases of a perceptron without slope constraints."""
    h = frame.width
    channels = frame.samples.shape[1]
    directions, kinks = draw_layer(frame.samples, h, rng)
    free = {"weight_0": directions}
    shapes = [(h, h)] * (depth - 1) + [(channels, h)]
    for i, shape in enumerate(shapes, start=1):
        free[f"weight_{i}"] = rng.normal(size=shape) / np.sqrt(shape[1])
    free["bias_0"] = -kinks
    for i in range(1, depth):
        free[f"bias_{i}"] = 0.1 * rng.normal(size=h)
    return free


@dataclass(frozen=True, kw_only=True)
class OneChannel(Trainable):
    """Trainable monotone perceptron with one channel. `S = S_L o ... o S_1`, piecewise-linear maps
    whose sectors multiply to the requested sector.

    `S_l(v) = int_0^v s(t) dt`, `s = lower + (upper - lower) sigmoid(base + sum of jumps passed)`:
    `width - 1` leaky ReLUs with slopes `lower, upper` and one linear neuron write every such map,
    without weights that must be positive.
    """

    depth: int

    def initial_values(self, frame: MapContext, rng: np.random.Generator) -> StartingValues:  # noqa: ARG002
        kinks = max(frame.width - 1, 1)
        ranks = (np.arange(kinks) + 0.5) / kinks
        points = np.quantile(frame.samples[:, 0], ranks)
        free = {}
        for i in range(self.depth):
            free[f"points_{i}"] = points
            free[f"jumps_{i}"] = np.zeros(kinks)
            free[f"base_{i}"] = np.zeros(1)
        return free

    def explicit_parameters(self, free: Free, slopes: Sector) -> list[Pieces]:
        lower, upper = layer_slope_bounds(*slopes, self.depth, channels=1)
        layers = []
        for i in range(self.depth):
            points, order = free[f"points_{i}"].sort(-1)
            jumps = free[f"jumps_{i}"].gather(-1, order)
            passed = torch.nn.functional.pad(jumps.cumsum(-1), (1, 0))
            logit = free[f"base_{i}"] + JUMP_UNIT * passed
            inside = lower + (upper - lower) * torch.sigmoid(logit)
            layers.append((points, inside, scaffold.zero_preserving_offsets(points, inside)))
        return layers

    def evaluate(
        self, explicit: list[Pieces], v: Float[Tensor, "*batch 1"]
    ) -> Float[Tensor, "*batch 1"]:
        for points, slopes, offsets in explicit:
            v = scaffold.evaluate_pieces((points[None], slopes[None], offsets[None]), v)
        return v

    def pieces(self, explicit: list[Pieces]) -> Pieces | None:
        return explicit[0] if self.depth == 1 else None

    def roughness(self, explicit: list[Pieces]) -> Float[Tensor, ""]:
        by_layer = [scaffold.relative_roughness(slopes) for _, slopes, _ in explicit]
        return torch.stack(by_layer).sum(0)

    def freeze(self, explicit: list[Pieces], slopes: Sector) -> MlpScaffold:
        """Rewrite the trained piecewise-linear map of each layer as a leaky-ReLU network. First
        weights are one, positive slopes `upper`; the last neuron is linear."""
        lower, upper = layer_slope_bounds(*slopes, self.depth, channels=1)
        lasts = []
        biases = []
        for pieces in explicit:
            points, inside, _ = (tensor_to_numpy(part) for part in pieces)
            bends = np.diff(inside) / (upper - lower)
            straight = (inside[0] - lower * bends.sum()) / upper
            lasts.append(np.append(bends, straight)[None, :])
            biases.append(np.append(-points, 0.0))
        ones = [np.ones((len(bias), 1)) for bias in biases]
        inner = [after @ last for last, after in zip(lasts[:-1], ones[1:], strict=True)]
        negative = [np.append(np.full(len(bias) - 1, lower), upper) for bias in biases]
        network = Network(
            weights=(ones[0], *inner, lasts[-1]),
            biases=tuple(biases),
            negative_slopes=tuple(negative),
            positive_slopes=tuple(np.full(len(bias), upper) for bias in biases),
        )
        return MlpScaffold(network=network)


def layer_slope_bounds(
    lower: float, upper: float, depth: int, channels: int
) -> tuple[float, float]:
    """Slope bounds for each layer, such that the product over all layers stays within given bounds.

    One channel: slopes multiply, so the depth-th roots. More: with `J_l = a (I + E_l), |E_l| <= d`,
    the product lies in the ball of centre `a^L` and radius `a^L ((1 + d)^L - 1)`, so `d =
    (upper/alpha)^(1/L) - 1`, `alpha` the middle.
    """
    if channels == 1 or depth == 1:
        return lower ** (1 / depth), upper ** (1 / depth)
    middle = (lower + upper) / 2
    centre = middle ** (1 / depth)
    relative = (upper / middle) ** (1 / depth) - 1
    return centre * (1 - relative), centre * (1 + relative)


def draw_layer(
    inputs: Float[np.ndarray, "N m"], width: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "h m"], Float[np.ndarray, "h"]]:
    """Draw random initial weights and biases of a layer. Break points lie at evenly ranked samples
    of the training input, so that each can be learned.

    With one input, neighbouring kinks bend in opposite directions: any region can then be made
    steeper or flatter.
    """
    neuron = np.arange(width)
    ranks = (neuron + rng.uniform(0.2, 0.8, size=width)) / width  # one of the samples for each
    if inputs.shape[1] == 1:
        is_even = (neuron + rng.integers(2)) % 2 == 0
        signs = np.where(is_even, 1.0, -1.0)
        return signs[:, None], signs * np.quantile(inputs[:, 0], ranks)
    directions = rng.normal(size=(width, inputs.shape[1]))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    kinks = []
    for direction, rank in zip(directions, rng.permutation(ranks), strict=True):
        kinks.append(np.quantile(inputs @ direction, rank))
    return directions, np.array(kinks)
