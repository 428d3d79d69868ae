"""The linear recurrent unit: stable for every value of its free parameters, with real modes and complex pairs."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor, nn

from ssm_study.models.torch_recurrence import Modes, fast_length, one_convolution, respond
from ssm_study.models.torch_siso import LEAST_DAMPING, SisoConvolution
from ssm_study.systems import StateSpace


class LRU(nn.Module):
    """`lambda = +-exp(-exp(nu))` for real modes, `exp(-exp(nu) +- i theta)` for pairs.

    `B` is scaled by `sqrt(1 - |lambda|^2)`, which keeps the gain of a mode when its radius moves. With one input
    `B` is all ones and only `C` is trained: the modal form has exactly that much freedom.
    Source: Orvieto et al. (2023), section 3.
    """

    flip: Tensor
    pairs: Tensor

    def __init__(self, start: "Start", feedthrough: bool) -> None:
        super().__init__()
        modes = torch.from_numpy(start.modes)
        radius = modes.abs().clamp(1e-3, 1 - 1e-6)
        self.reals = int((modes.imag == 0).sum())
        self.nu = nn.Parameter(torch.log(-torch.log(radius)))
        self.theta = nn.Parameter(modes[self.reals :].angle())
        self.register_buffer("flip", torch.where(modes[: self.reals].real < 0, torch.pi, 0.0).to(torch.float64))
        self.register_buffer("pairs", torch.where(modes.imag == 0, 1.0, 2.0).to(torch.float64), persistent=False)
        self.single = single = start.b.shape[1] == 1
        b, c = torch.from_numpy(start.b), torch.from_numpy(start.c)
        gain = torch.sqrt(1 - radius**2)[:, None]
        if single:  # y = C diag(b) x: the input column moves into C
            c, b = c * (b / gain)[:, 0], torch.ones_like(b)
        else:
            b = b / gain
        self.b_real, self.b_imag = _parts(b, self.reals, trained=not single)
        self.c_real, self.c_imag = _parts(c.mT, self.reals, trained=True)
        d = torch.from_numpy(start.d)
        self.d = nn.Parameter(d if feedthrough else torch.zeros_like(d), requires_grad=feedthrough)

    @property
    def order(self) -> int:
        """Real states: one per real mode, two per pair."""
        return 2 * len(self.nu) - self.reals

    def forward(
        self, u: Float[Tensor, "*models e T m"], x0: Float[Tensor, "e n"] | None = None
    ) -> Float[Tensor, "*models e T p"]:
        """`y` of the recurrence, from rest or from `x0`, which is ordered as in `to_state_space`."""
        siso = self.single and self.d.shape[-2] == 1
        if siso and x0 is None and one_convolution(self.nu.shape[-1], u.shape[-2]):
            free = (self.nu, self.theta, self.c_real, self.c_imag, self.d)
            return SisoConvolution.apply(*free, u, self.flip, self.pairs, fast_length(2 * u.shape[-2] - 1))
        return respond(self.modes(), u, None if x0 is None else self.initial_state(x0))

    def modes(self) -> Modes:
        """Free to explicit parameters; `SisoConvolution` begins with the same equations."""
        damping = torch.exp(self.nu).clamp(min=LEAST_DAMPING)
        angle = torch.cat([self.flip, self.theta], -1) if self.reals else self.theta
        gain = torch.sqrt(-torch.expm1(-2 * damping))[..., None]
        if self.single:
            b = torch.complex(gain, torch.zeros_like(gain))
        else:
            b = _join(gain * self.b_real, gain[..., self.reals :, :] * self.b_imag)
        c = _join(self.pairs[..., None] * self.c_real, 2.0 * self.c_imag).mT
        return Modes(decay=torch.complex(-damping, angle), b=b, c=c, d=self.d)

    def to_state_space(self) -> StateSpace:
        """Real `A, B, C, D`: a number on the diagonal per real mode, a 2 x 2 rotation block per pair."""
        with torch.no_grad():
            modes = self.modes()
        turn = np.exp(modes.decay.cpu().numpy().astype(np.complex128))
        b, c = (t.cpu().numpy().astype(np.complex128) for t in (modes.b, modes.c))
        return real_form(turn, b, c, modes.d.detach().cpu().numpy().astype(np.float64), self.reals)

    def initial_state(self, free: Float[Tensor, "e n"]) -> Complex[Tensor, "e modes"]:
        """Real states, ordered as in `to_state_space`, to modal ones."""
        real, pairs = free[:, : self.reals], free[:, self.reals :].unflatten(1, (-1, 2))
        return torch.complex(torch.cat([real, pairs[..., 0]], 1), torch.cat([torch.zeros_like(real), pairs[..., 1]], 1))

    def real_state(self, modal: Complex[Tensor, "e modes"]) -> Float[Tensor, "e n"]:
        """The inverse of `initial_state`."""
        return torch.cat([modal[:, : self.reals].real, torch.view_as_real(modal[:, self.reals :]).flatten(1)], 1)


@dataclass(frozen=True, kw_only=True)
class Start:
    """Where training starts: `modes (n,)` with the real ones first and one of each pair, `b (n, m)`, `c (p, n)`, `d`.

    `y = Re(c_r x_r) + 2 Re(c_c x_c) + d u`: the factor two of the pairs is not in `c`.
    """

    modes: Complex[np.ndarray, "n"]
    b: Complex[np.ndarray, "n m"]
    c: Complex[np.ndarray, "p n"]
    d: Float[np.ndarray, "p m"]


def real_form(
    turn: Complex[np.ndarray, "n"],
    b: Complex[np.ndarray, "n m"],
    c: Complex[np.ndarray, "p n"],
    d: Float[np.ndarray, "p m"],
    reals: int,
) -> StateSpace:
    """`x = Re z` for real modes, `(Re z, Im z)` for pairs; `Re(c z) = Re c Re z - Im c Im z`."""
    n = reals + 2 * (len(turn) - reals)
    a, br, cr = np.zeros((n, n)), np.zeros((n, b.shape[1])), np.zeros((c.shape[0], n))
    a[:reals, :reals] = np.diag(turn[:reals].real)
    br[:reals], cr[:, :reals] = b[:reals].real, c[:, :reals].real
    for i, at in enumerate(range(reals, n, 2), start=reals):
        re, im = turn[i].real, turn[i].imag
        a[at : at + 2, at : at + 2] = [[re, -im], [im, re]]
        br[at], br[at + 1] = b[i].real, b[i].imag
        cr[:, at], cr[:, at + 1] = c[:, i].real, -c[:, i].imag
    return StateSpace(a=a, b=br, c=cr, d=d)


def _parts(values: Complex[Tensor, "n k"], reals: int, trained: bool) -> tuple[nn.Parameter, nn.Parameter]:
    """Real parts of all modes and imaginary parts of the pairs, as separate parameters."""
    real = nn.Parameter(values.real.contiguous().clone(), requires_grad=trained)
    return real, nn.Parameter(values.imag[reals:].contiguous().clone(), requires_grad=trained)


def _join(real: Float[Tensor, "*c n k"], imag: Float[Tensor, "*c pairs k"]) -> Complex[Tensor, "*c n k"]:
    reals = real.shape[-2] - imag.shape[-2]
    return torch.complex(real, torch.nn.functional.pad(imag, (0, 0, reals, 0)) if reals else imag)
