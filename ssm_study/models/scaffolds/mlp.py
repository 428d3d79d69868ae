"""Static map as in Zakwan et al.: a multilayer perceptron with leaky ReLU, shifted so that it is
zero at zero."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import Network, PortableMap
from ssm_study.bounds.slopes import SlopeBound, network_slope_bound
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
    """Static map given by a multilayer perceptron with leaky ReLU, shifted so that it is zero at
    zero. `S(v) = N(v) - N(0)`, N of any depth and width.

    For one input and one hidden layer the slope is constant between the break points `-b_i / w_i`.
    Source: [Z26] section IV.
    """

    network: Network

    def __call__(self, v: Float[np.ndarray, "*batch m"]) -> Float[np.ndarray, "*batch k"]:
        return self.network(v)

    def jacobian(self, v: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k m"]:
        return self.network.jacobian(v)

    def slope_bound(self) -> SlopeBound:
        return network_slope_bound(self.network)

    def jacobian_centre(self) -> Square:
        from ssm_study.bounds.lipsdp import lipsdp_ball

        return lipsdp_ball(self.network)[0]

    def compose_with_output_matrix(self, m: Square) -> "MlpScaffold":
        *inner, last = self.network.weights
        weights = (*inner, m @ last)
        network = replace(self.network, weights=weights)
        return MlpScaffold(network=network)

    def compose_with_input_matrix(self, m: Square) -> "MlpScaffold":
        first, *inner = self.network.weights
        weights = (first @ m, *inner)
        network = replace(self.network, weights=weights)
        return MlpScaffold(network=network)

    def as_portable(self) -> PortableMap:
        output_count = self.network.output_count
        input_count = self.network.input_count
        linear = np.zeros((output_count, input_count))
        return PortableMap(linear=linear, network=self.network)


@dataclass(frozen=True, kw_only=True)
class Mlp(Trainable):
    """Trainable static map: a multilayer perceptron whose slopes stay within given bounds. It has
    `depth` hidden layers of leaky ReLU, whose slopes are fixed at the sector's ends or trained
    inside the sector.

    `certified` keeps every Jacobian in the sector by construction: of one channel the slopes of the
    whole map are trained, whatever `train_slopes` says (`OneChannelMlp`); of several

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
            one_channel = OneChannelMlp(depth=self.depth)
            return one_channel.build(frame, rng)
        return super().build(frame, rng)

    def initial_values(self, frame: MapContext, rng: np.random.Generator) -> StartingValues:
        h = frame.width
        if self.certified:
            free = random_bounded_slope_layers(frame, self.depth, rng)
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
        """Weights, biases and slopes of one layer of a perceptron with bounded slopes, from its
        free parameters."""
        if not self.certified:
            bias = free[f"bias_{i}"]
            is_last = i == self.depth - 1
            after = free[f"weight_{self.depth}"] if is_last else None
            bounded_slopes = self._bounded_slopes(free, i, slopes, bias)
            return (free[f"weight_{i}"], bias, *bounded_slopes, after)
        v = free[f"direction_{i}"]
        # W = V R^{-T} has W^T W = I, and is cheap to differentiate.
        gram = v.T @ v
        root = torch.linalg.cholesky(gram)
        normalised = torch.linalg.solve_triangular(root, v.T, upper=False)
        w = normalised.T
        # A neuron bends where its unit direction meets the kink.
        kinks = -free[f"kink_{i}"]
        norms = w.norm(dim=1)
        bias = kinks * norms
        sector = layer_slope_bounds(*slopes, self.depth, 2)
        return (w, bias, *self._bounded_slopes(free, i, sector, bias), w.T)

    def _bounded_slopes(
        self, free: Free, layer: int, sector: Sector, template: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Slopes of a layer's leaky-ReLU neurons for negative and positive arguments, within the
        slope bounds. They are fixed at its two ends, or trained inside by a logistic map."""
        lower, upper = sector
        if not self.train_slopes:
            lower_slopes = torch.full_like(template, lower)
            upper_slopes = torch.full_like(template, upper)
            return lower_slopes, upper_slopes
        sides = (free[f"slope_{side}_{layer}"] for side in ("negative", "positive"))
        low, high = (lower + (upper - lower) * torch.sigmoid(side) for side in sides)
        return low, high

    def evaluate(
        self, explicit: list[Layer], v: Float[Tensor, "*batch m"]
    ) -> Float[Tensor, "*batch m"]:
        for w, b, low, high, after in explicit:
            z = v @ w.T + b
            slopes_at_z = torch.where(z >= 0, high, low)
            slopes_at_b = torch.where(b >= 0, high, low)
            v = slopes_at_z * z - slopes_at_b * b
            v = v if after is None else v @ after.T
        return v

    def affine_pieces(self, explicit: list[Layer]) -> Pieces | None:
        """Affine pieces of a one-channel perceptron between its break points. `sum_i last_i
        phi_i(first_i v + b_i)`."""
        w, b, low, high, after = explicit[0]
        if after is None or w.shape[1] > 1:  # several inputs, or several layers of free weights
            return None
        first = w[:, 0]
        last = after[0]
        break_points = -b / first
        points, order = break_points.sort()
        neuron_count = len(order)
        piece = torch.arange(neuron_count + 1, device=order.device)
        ranks = order.argsort()
        beyond = piece[:, None] > ranks[None, :]  # piece j lies right of kink i
        is_active = beyond == (first > 0)
        active = torch.where(is_active, high, low)  # slope of neuron i in piece j
        offsets = active @ (last * b)
        fixed_points = points.detach()
        zero = points.new_zeros(1)
        home = torch.searchsorted(fixed_points, zero, right=True)
        piece_slopes = active @ (last * first)
        piece_offsets = offsets - offsets[home]
        return points, piece_slopes, piece_offsets

    def to_numpy(self, explicit: list[Layer], slopes: Sector) -> MlpScaffold:  # noqa: ARG002
        weights = []
        biases = []
        negative = []
        positive = []
        before = None  # what comes after the layer before
        for w, bias, low, high, after in explicit:
            weight = tensor_to_numpy(w)
            joined_weight = weight if before is None else weight @ tensor_to_numpy(before)
            weights.append(joined_weight)
            biases.append(tensor_to_numpy(bias))
            negative.append(tensor_to_numpy(low))
            positive.append(tensor_to_numpy(high))
            before = after
        assert before is not None  # nothing but weights comes after the last layer
        last_weight = tensor_to_numpy(before)
        all_biases = tuple(biases)
        negative_slopes = tuple(negative)
        positive_slopes = tuple(positive)
        network = Network(
            weights=(*weights, last_weight),
            biases=all_biases,
            negative_slopes=negative_slopes,
            positive_slopes=positive_slopes,
        )
        return MlpScaffold(network=network)


def random_bounded_slope_layers(
    frame: MapContext, depth: int, rng: np.random.Generator
) -> StartingValues:
    """Random initial weights and break points for each layer of a perceptron with bounded
    slopes."""
    layers = [draw_initial_layer(frame.samples, frame.width, rng) for _ in range(depth)]
    directions = {f"direction_{i}": weights for i, (weights, _) in enumerate(layers)}
    kinks = {f"kink_{i}": values for i, (_, values) in enumerate(layers)}
    return directions | kinks


def unconstrained_initial_layers(
    frame: MapContext, depth: int, rng: np.random.Generator
) -> StartingValues:
    """Random initial weights and biases for each layer of a perceptron without slope bounds."""
    h = frame.width
    channels = frame.samples.shape[1]
    directions, kinks = draw_initial_layer(frame.samples, h, rng)
    free = {"weight_0": directions}
    inner_shapes = [(h, h)]
    last_shape = [(channels, h)]
    shapes = inner_shapes * (depth - 1) + last_shape
    for i, shape in enumerate(shapes, start=1):
        random_weights = rng.normal(size=shape)
        free[f"weight_{i}"] = random_weights / np.sqrt(shape[1])
    free["bias_0"] = -kinks
    for i in range(1, depth):
        random_biases = rng.normal(size=h)
        free[f"bias_{i}"] = 0.1 * random_biases
    return free


@dataclass(frozen=True, kw_only=True)
class OneChannelMlp(Trainable):
    """Trainable monotone perceptron with one input and one output, a chain of piecewise-linear
    maps. `S = S_L o ... o S_1`, piecewise-linear maps whose sectors multiply to the requested
    sector.

    `S_l(v) = int_0^v s(t) dt`, `s = lower + (upper - lower) sigmoid(base + sum of jumps passed)`:
    `width - 1` leaky ReLUs with slopes `lower, upper` and one linear neuron write every such map,
    without weights that must be positive.
    """

    depth: int

    def initial_values(self, frame: MapContext, rng: np.random.Generator) -> StartingValues:  # noqa: ARG002
        kinks = max(frame.width - 1, 1)
        neuron_numbers = np.arange(kinks)
        ranks = (neuron_numbers + 0.5) / kinks
        channel_values = frame.samples[:, 0]
        points = np.quantile(channel_values, ranks)
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
            passed_points = jumps.cumsum(-1)
            passed = torch.nn.functional.pad(passed_points, (1, 0))
            logit = free[f"base_{i}"] + JUMP_UNIT * passed
            share = torch.sigmoid(logit)
            above_lower = (upper - lower) * share
            inside = lower + above_lower
            piece_offsets = scaffold.zero_preserving_offsets(points, inside)
            piece_tables = (points, inside, piece_offsets)
            layers.append(piece_tables)
        return layers

    def evaluate(
        self, explicit: list[Pieces], v: Float[Tensor, "*batch 1"]
    ) -> Float[Tensor, "*batch 1"]:
        for points, slopes, offsets in explicit:
            pieces_of_rows = (points[None], slopes[None], offsets[None])
            v = scaffold.evaluate_piecewise_linear_map(pieces_of_rows, v)
        return v

    def affine_pieces(self, explicit: list[Pieces]) -> Pieces | None:
        is_one_layer = self.depth == 1
        return explicit[0] if is_one_layer else None

    def roughness(self, explicit: list[Pieces]) -> Float[Tensor, ""]:
        by_layer = [scaffold.relative_roughness(slopes) for _, slopes, _ in explicit]
        return torch.stack(by_layer).sum(0)

    def to_numpy(self, explicit: list[Pieces], slopes: Sector) -> MlpScaffold:
        """Rewrite the trained piecewise-linear map of each layer as a leaky-ReLU network. First
        weights are one, positive slopes `upper`; the last neuron is linear."""
        lower, upper = layer_slope_bounds(*slopes, self.depth, channels=1)
        lasts = []
        biases = []
        for pieces in explicit:
            points, inside, _ = (tensor_to_numpy(part) for part in pieces)
            slope_changes = np.diff(inside)
            bends = slope_changes / (upper - lower)
            total_bend = bends.sum()
            straight = (inside[0] - lower * total_bend) / upper
            last_row = np.append(bends, straight)
            lasts.append(last_row[None, :])
            layer_biases = np.append(-points, 0.0)
            biases.append(layer_biases)
        ones = [np.ones((len(bias), 1)) for bias in biases]
        inner_lasts = lasts[:-1]
        inner_ones = ones[1:]
        inner = [after @ last for last, after in zip(inner_lasts, inner_ones, strict=True)]
        negative = [np.append(np.full(len(bias) - 1, lower), upper) for bias in biases]
        last_weights = lasts[-1]
        all_biases = tuple(biases)
        negative_slopes = tuple(negative)
        positive_slopes = tuple(np.full(len(bias), upper) for bias in biases)
        network = Network(
            weights=(ones[0], *inner, last_weights),
            biases=all_biases,
            negative_slopes=negative_slopes,
            positive_slopes=positive_slopes,
        )
        return MlpScaffold(network=network)


def layer_slope_bounds(
    lower: float, upper: float, depth: int, channels: int
) -> tuple[float, float]:
    """Slope bounds for each layer of a perceptron, whose product over all layers gives the bounds
    of the whole perceptron.

    One channel: slopes multiply, so the depth-th roots. More: with `J_l = a (I + E_l), |E_l| <= d`,
    the product lies in the ball of centre `a^L` and radius `a^L ((1 + d)^L - 1)`, so `d =
    (upper/alpha)^(1/L) - 1`, `alpha` the middle.
    """
    if channels == 1 or depth == 1:
        layer_lower = lower ** (1 / depth)
        layer_upper = upper ** (1 / depth)
        return layer_lower, layer_upper
    middle = (lower + upper) / 2
    centre = middle ** (1 / depth)
    layer_ratio = (upper / middle) ** (1 / depth)
    relative = layer_ratio - 1
    return centre * (1 - relative), centre * (1 + relative)


def draw_initial_layer(
    inputs: Float[np.ndarray, "N m"], width: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "h m"], Float[np.ndarray, "h"]]:
    """Draw random initial weights and biases for one layer of a perceptron. Break points lie at
    evenly ranked samples of the training input, so that each can be learned.

    With one input, neighbouring kinks bend in opposite directions: any region can then be made
    steeper or flatter.
    """
    neuron = np.arange(width)
    within_rank = rng.uniform(0.2, 0.8, size=width)
    ranks = (neuron + within_rank) / width  # one of the samples for each
    if inputs.shape[1] == 1:
        first_sign = rng.integers(2)
        is_even = (neuron + first_sign) % 2 == 0
        signs = np.where(is_even, 1.0, -1.0)
        direction_column = signs[:, None]
        channel_values = inputs[:, 0]
        places = np.quantile(channel_values, ranks)
        return direction_column, signs * places
    input_count = inputs.shape[1]
    directions = rng.normal(size=(width, input_count))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    kinks = []
    shuffled_ranks = rng.permutation(ranks)
    for direction, rank in zip(directions, shuffled_ranks, strict=True):
        kink = np.quantile(inputs @ direction, rank)
        kinks.append(kink)
    return directions, np.array(kinks)
