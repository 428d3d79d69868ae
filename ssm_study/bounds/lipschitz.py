"""Exact test of whether stored multipliers prove that a network is 1-Lipschitz, `|N(v) - N(w)| <=
|v - w|`.

Neurons of slopes `lo <= hi`, diagonal `T_l > 0`: the network is 1-Lipschitz if

    |v|^2 - |W d|^2 - 2 sum_l (d_l - lo q_l)^T T_l (hi q_l - d_l) > 0     for all (v, d) != 0
    (q_l = W_l d_{l-1})

Source: Fazlyab et al. 2019, eq. (10). It is decided in rational arithmetic on the stored floats, so
neither rounding nor a statement in a file is trusted.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import Network
from ssm_study.exact import ExactMatrix, is_positive_definite


def is_proved_nonexpansive(network: Network, multipliers: Sequence[Float[np.ndarray, "_"]]) -> bool:
    """Whether given multipliers prove in exact arithmetic that a network is 1-Lipschitz.

    False says that they prove nothing, not that the network expands.
    """
    if not all((t > 0).all() for t in multipliers):
        return False
    selections = _selection_matrices(network)
    input_selection = selections[0]
    form = input_selection.T @ input_selection
    for layer, (weight, _, negative, positive) in enumerate(network.hidden_layers()):
        pre_activation = ExactMatrix.from_floats(weight) @ selections[layer]
        output = selections[layer + 1]
        least_slopes = _exact_diagonal_matrix(np.minimum(negative, positive))
        largest_slopes = _exact_diagonal_matrix(np.maximum(negative, positive))
        multiplier = _exact_diagonal_matrix(multipliers[layer])
        above_least = output - least_slopes @ pre_activation
        below_largest = largest_slopes @ pre_activation - output
        sector = above_least.T @ (multiplier @ below_largest)
        form = form - sector - sector.T
    last_weight = ExactMatrix.from_floats(network.weights[-1])
    response = last_weight @ selections[-1]
    return is_positive_definite(form - response.T @ response)


def _selection_matrices(network: Network) -> list[ExactMatrix]:
    """Matrices that select each layer's input and output from the vector of all signals of a
    network. The stack is `(v, d_1, ..., d_L)`."""
    sizes = [network.input_count, *(len(bias) for bias in network.biases)]
    ends = np.cumsum(sizes)
    identity = np.eye(ends[-1])
    selections = []
    for size, end in zip(sizes, ends, strict=True):
        rows = identity[end - size : end]
        selections.append(ExactMatrix.from_floats(rows))
    return selections


def _exact_diagonal_matrix(entries: Float[np.ndarray, "_"]) -> ExactMatrix:
    """Diagonal matrix with given diagonal elements in exact rational arithmetic."""
    return ExactMatrix.from_floats(entries).diagonal_matrix()
