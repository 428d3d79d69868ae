"""Numbers of a row that do not depend on how many rows there are: so that models trained together equal each alone.

Vector instructions and the loop over what they leave at the end round some operations differently (products of complex
numbers, the logistic function). Which numbers are left over depends on where a tensor ends.
"""

import torch
from jaxtyping import Complex, Num
from torch import Tensor

LANES = 8  # complex numbers, or pairs of real ones, that one turn of a vector loop takes


def apart(rows: Num[Tensor, "*rows n"]) -> Num[Tensor, "*rows n"]:
    """The same numbers with a gap after each row: no row is then computed in one go with its neighbours."""
    return torch.nn.functional.pad(rows, (0, 1))[..., :-1]


def conjugate_apart(rows: Complex[Tensor, "*rows n"]) -> Complex[Tensor, "*rows n"]:
    """Their conjugates, with such gaps: in one pass, since a conjugate of rows with gaps would lose them."""
    out = rows.new_empty(*rows.shape[:-1], rows.shape[-1] + 1)[..., :-1]
    return torch.conj_physical(rows, out=out)


def product(a: Complex[Tensor, "*a n"], b: Complex[Tensor, "*b n"]) -> Complex[Tensor, "*c n"]:
    """`a b` in real operations, which round alike everywhere, their derivatives too: for a few numbers."""
    (ar, ai), (br, bi) = torch.view_as_real(a).unbind(-1), torch.view_as_real(b).unbind(-1)
    return torch.complex(ar * br - ai * bi, ar * bi + ai * br)


def whole_lanes(count: int) -> int:
    """The next multiple of the lanes: tables with so many rows leave nothing over."""
    return -(-count // LANES) * LANES
