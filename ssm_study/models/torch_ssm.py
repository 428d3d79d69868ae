"""Trainable model in torch: a linear recurrence between two static maps."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from jaxtyping import Complex, Float, Int
from scipy.linalg import block_diag
from torch import Tensor, nn

from ssm_study.models.identified import SSM, Simulator
from ssm_study.models.torch_recurrence import ModalForm, final_state, simulate_modal_form
from ssm_study.models.torch_scaffold import TorchScaffold
from ssm_study.signals import DataSet
from ssm_study.systems import StateSpace

if TYPE_CHECKING:
    from ssm_study.models.initial_system import InitialLinearSystem

FEW_LEVELS = 8  # mean hold from which evaluating once per level beats the sorted evaluation


class InputMapping(nn.Module):
    """Torch module that applies a trainable static input map to fixed records, whose samples are
    sorted once for speed. `S_u(u)` for one fixed `u (e, T, m)`, by the cheapest of three exact
    ways, which are prepared once.

    Held inputs repeat: once per distinct input vector, copied to where it occurs. One channel and a
    piecewise-linear map with h kinks: the sorted samples fall into h + 1 runs, each an affine map,
    so the cost does not grow with h. Else directly. `sorts=False` leaves out the second, which has
    no forward-mode derivative.
    """

    values: Tensor
    where: Tensor
    order: Tensor
    back: Tensor

    def __init__(self, u: Float[Tensor, "e T m"], sorts: bool = True) -> None:
        super().__init__()
        flat_inputs = u.flatten(0, 1)
        values, where = torch.unique(flat_inputs, dim=0, return_inverse=True)
        level_count = len(values)
        sample_count = where.numel()
        self.levels = FEW_LEVELS * level_count <= sample_count  # as with multilevel signals
        self.sorts = sorts and not self.levels and u.shape[2] == 1
        buffers = {"u": u}
        if self.levels:
            sample_shape = u.shape[:2]
            buffers |= {"values": values, "where": where.view(sample_shape)}
        if self.sorts:
            flat_input = u.flatten()
            ranked, order = flat_input.sort()
            way_back = order.argsort()
            buffers |= {"values": ranked, "order": order, "back": way_back}
        for name, tensor in buffers.items():
            self.register_buffer(name, tensor, persistent=False)

    def forward(self, scaffold: TorchScaffold) -> Float[Tensor, "e T k"]:
        """Apply a trainable static input map to the fixed records of a module."""
        if self.levels:
            return scaffold(self.values)[self.where]
        pieces = scaffold.affine_pieces() if self.sorts else None
        if pieces is None:
            return scaffold(self.u)
        points, slopes, offsets = pieces
        fixed_points = points.detach()
        inner = torch.searchsorted(self.values, fixed_points)  # where the runs of a slope begin
        from_zero = torch.nn.functional.pad(inner, (1, 0))
        value_count = len(self.values)
        cuts = torch.nn.functional.pad(from_zero, (0, 1), value=value_count)
        sorting = (self.values, self.order, self.back)
        counts = cuts.diff()
        mapped = _PiecewiseEvaluation.apply(slopes, offsets, counts, *sorting)
        return mapped.view(self.u.shape)


Run = Float[Tensor, "h1"]
Sample = Float[Tensor, "N"]
Place = Int[Tensor, "N"]


class _PiecewiseEvaluation(torch.autograd.Function):
    """Differentiable torch operation that evaluates a piecewise-linear map at sorted inputs. `y =
    slope_j u + offset_j`."""

    @staticmethod
    def forward(
        ctx: Any,
        slopes: Run,
        offsets: Run,
        counts: Int[Tensor, "h1"],
        ranked: Sample,
        order: Place,
        back: Place,
    ) -> Sample:
        """Evaluate the piecewise-linear map at sorted inputs."""
        ctx.save_for_backward(counts, ranked, order)
        sample_count = len(ranked)
        slope = torch.repeat_interleave(slopes, counts, output_size=sample_count)
        offset = torch.repeat_interleave(offsets, counts, output_size=len(ranked))
        sorted_values = torch.addcmul(offset, slope, ranked)
        return sorted_values.index_select(0, back)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of the loss with respect to the slopes and offsets of a piecewise-linear
        map."""
        counts, ranked, order = ctx.saved_tensors
        by_sample = upstream[0].index_select(0, order)
        pieces = {"lengths": counts, "initial": 0.0}
        by_slopes = torch.segment_reduce(by_sample * ranked, "sum", **pieces)
        by_offsets = torch.segment_reduce(by_sample, "sum", **pieces)
        return by_slopes, by_offsets, None, None, None, None


Signals = Float[Tensor, "e T _"]
States = Float[Tensor, "e n"]
Modal = Complex[Tensor, "e modes"]
LEAST_DAMPING = 1e-8  # per sample: below it the radius rounds to one, and is stored as unstable


class LRU(nn.Module):
    """Trainable linear recurrence in modal coordinates (linear recurrent unit). `lambda =
    +-exp(-exp(nu))` for real modes, `exp(-exp(nu) +- i theta)` for pairs.

    `B` is scaled by `sqrt(1 - |lambda|^2)`, which keeps the gain of a mode when its radius moves.
    With one input `B` is all ones and only `C` is trained: the modal form has exactly that much
    freedom. The last `disturbances` of the inputs reach no output at once: D has no column for
    them. Source: Orvieto et al. (2023), section 3.
    """

    flip: Tensor
    pairs: Tensor

    def __init__(
        self, start: "InitialLinearSystem", feedthrough: bool, disturbances: int = 0
    ) -> None:
        super().__init__()
        modes = torch.from_numpy(start.modes)
        moduli = modes.abs()
        radius = moduli.clamp(1e-3, 1 - 1e-6)
        is_real = modes.imag == 0
        self.reals = int(is_real.sum())
        log_radius = torch.log(radius)
        nu = torch.log(-log_radius)
        self.nu = nn.Parameter(nu)  # inverse of |lambda| = exp(-exp(nu))
        angles = modes[self.reals :].angle()
        self.theta = nn.Parameter(angles)  # one of each pair
        real_modes = modes[: self.reals]
        is_negative = real_modes.real < 0
        flip = torch.where(is_negative, torch.pi, 0.0)
        is_real_mode = modes.imag == 0
        pairs = torch.where(is_real_mode, 1.0, 2.0)
        exact_flip = flip.to(torch.float64)
        self.register_buffer("flip", exact_flip)
        exact_pairs = pairs.to(torch.float64)
        self.register_buffer("pairs", exact_pairs, persistent=False)
        single = start.b.shape[1] == 1
        self.single = single
        b = torch.from_numpy(start.b)
        c = torch.from_numpy(start.c)
        remaining = 1 - radius**2
        gain = torch.sqrt(remaining)[:, None]
        if single:  # y = C diag(b) x: the input column moves into C
            row_scales = (b / gain)[:, 0]
            c = c * row_scales
            b = torch.ones_like(b)
        else:
            b = b / gain
        self.b_real, self.b_imag = _split_complex_parameters(b, self.reals, trained=not single)
        self.c_real, self.c_imag = _split_complex_parameters(c.mT, self.reals, trained=True)
        self.disturbances = disturbances
        all_inputs = start.d.shape[1]
        d = torch.from_numpy(start.d[:, : all_inputs - disturbances])
        start_d = d if feedthrough else torch.zeros_like(d)
        self.d = nn.Parameter(start_d, requires_grad=feedthrough)

    @property
    def order(self) -> int:
        """Number of real states of a modal recurrence: one for each real eigenvalue, two for each
        complex pair."""
        mode_count = len(self.nu)
        return 2 * mode_count - self.reals

    def forward(self, u: Signals, x0: States | None = None) -> Signals:
        """Simulate the output of the linear recurrence for an input. The order of states is that of
        `to_state_space`."""
        modal = None if x0 is None else self.to_modal_state(x0)
        modes = self.modal_form()
        return simulate_modal_form(modes, u, modal)

    def modal_form(self) -> ModalForm:
        """Modal form of the recurrence with stable eigenvalues, computed from unconstrained
        parameters."""
        free_damping = torch.exp(self.nu)
        damping = free_damping.clamp(min=LEAST_DAMPING)
        angles = [self.flip, self.theta]
        angle = torch.cat(angles)  # 0 or pi for real modes
        # sqrt(1 - |lambda|^2), without cancellation near one
        remaining_share = -torch.expm1(-2 * damping)
        gain = torch.sqrt(remaining_share)[:, None]
        if self.single:
            no_imaginary = torch.zeros_like(gain)
            b = torch.complex(gain, no_imaginary)
        else:
            b_real = gain * self.b_real
            gain_of_pairs = gain[self.reals :]
            b_imag = gain_of_pairs * self.b_imag
            b = _join_complex_parameters(b_real, b_imag)
        c_real = self.pairs[:, None] * self.c_real
        c_imag = 2.0 * self.c_imag
        c = _join_complex_parameters(c_real, c_imag)
        d = torch.nn.functional.pad(self.d, (0, self.disturbances)) if self.disturbances else self.d
        decay = torch.complex(-damping, angle)
        return ModalForm(decay=decay, b=b, c=c.mT, d=d)  # y = Re(c_r x_r) + 2 Re(c_c x_c)

    def to_state_space(self) -> StateSpace:
        """Convert a recurrence in modal form to real state-space matrices. A has a number on the
        diagonal for each real mode, a 2 x 2 rotation block for each pair.

        `x = Re z` for real modes, `(Re z, Im z)` for pairs; `Re(c z) = Re c Re z - Im c Im z`.
        """
        with torch.no_grad():
            modes = self.modal_form()
        c_rows_of_modes = modes.c.mT
        parts = (modes.decay, modes.b, c_rows_of_modes)
        decay, b, c = (part.cpu().numpy().astype(np.complex128) for part in parts)
        reals = self.reals
        turn = np.exp(decay)
        turn_of_pairs = turn[reals:]
        rotations = [np.array([[z.real, -z.imag], [z.imag, z.real]]) for z in turn_of_pairs]
        real_turns = turn[:reals]
        a = block_diag(np.diag(real_turns.real), *rotations)
        c_rows = _real_rows(c.conj(), reals)
        d_on_host = modes.d.detach().cpu()
        d = d_on_host.numpy().astype(np.float64)
        real_b = _real_rows(b, reals)
        c_columns = c_rows.T.copy()
        return StateSpace(a=a, b=real_b, c=c_columns, d=d)

    def to_modal_state(self, states: States) -> Modal:
        """Convert real states of a linear recurrence to complex modal states."""
        real = states[:, : self.reals]
        pair_states = states[:, self.reals :]
        pairs = pair_states.unflatten(1, (-1, 2))
        real_parts = [real, pairs[..., 0]]
        real_part = torch.cat(real_parts, 1)
        imaginary_parts = [torch.zeros_like(real), pairs[..., 1]]
        imaginary_part = torch.cat(imaginary_parts, 1)
        return torch.complex(real_part, imaginary_part)

    def to_real_state(self, modal_states: Modal) -> States:
        """Convert complex modal states of a linear recurrence to real states."""
        real_modes = modal_states[:, : self.reals]
        real = real_modes.real
        pair_modes = modal_states[:, self.reals :]
        pairs = torch.view_as_real(pair_modes)
        flat_pairs = pairs.flatten(1)
        return torch.cat([real, flat_pairs], 1)


def _real_rows(rows: Complex[np.ndarray, "modes k"], reals: int) -> Float[np.ndarray, "n k"]:
    """Real rows of a complex modal matrix: one for each real eigenvalue, two for each complex
    pair."""
    of_pairs = rows[reals:]
    both_parts = [of_pairs.real, of_pairs.imag]
    parts = np.stack(both_parts, 1)
    real_rows = rows[:reals].real
    pair_rows = parts.reshape(-1, rows.shape[1])
    return np.vstack([real_rows, pair_rows])


def _split_complex_parameters(
    values: Complex[Tensor, "n k"], reals: int, trained: bool
) -> tuple[nn.Parameter, nn.Parameter]:
    """Split complex modal values into real and imaginary parts that can be trained."""
    real_values = values.real.contiguous()
    real = nn.Parameter(real_values.clone(), requires_grad=trained)
    pair_values = values.imag[reals:]
    imaginary = nn.Parameter(pair_values.contiguous().clone(), requires_grad=trained)
    return real, imaginary


def _join_complex_parameters(
    real: Float[Tensor, "n k"], imag: Float[Tensor, "pairs k"]
) -> Complex[Tensor, "n k"]:
    """Join separately trained real and imaginary parts to complex modal values."""
    reals = len(real) - len(imag)
    padded_imag = torch.nn.functional.pad(imag, (0, 0, reals, 0)) if reals else imag
    return torch.complex(real, padded_imag)


class TorchModel(nn.Module, ABC):
    """Base class of trainable torch models on scaled signals. `states` is the length of the initial
    state that a model accepts.

    `differentiates_forward`: whether Levenberg-Marquardt can have its Jacobian.
    """

    states: int
    differentiates_forward: ClassVar[bool] = True

    def forward(self, u: Signals, x0: States | None = None) -> Signals:
        """Simulate a trainable model's output from an initial state. A subclass overrides it where
        it can be cheaper than `simulate_with_final_state`."""
        start = u.new_zeros(len(u), self.states) if x0 is None else x0
        return self.simulate_with_final_state(u, start)[0]

    @abstractmethod
    def simulate_with_final_state(self, u: Signals, x0: States) -> tuple[Signals, States]:
        """Simulate a trainable model, and return its output and its final state."""

    @abstractmethod
    def to_numpy(self, data: DataSet) -> Simulator:
        """Copy of a trained torch model with NumPy arrays as parameters and with the signal scales,
        independent of torch."""


class TorchSSM(TorchModel):
    """Trainable torch model: a linear recurrence between a static input map and a static output
    map. `x+ = A x + B S_u(u), y = S_y(C x + D S_u(u))` on scaled signals `u (e, T, m)`, `y (e, T,
    p)`.

    Measured disturbances are further columns of u; they pass S_u by and reach the states alone.
    `lifted` is `S_u(u)`, with them, where it is known already; `x0` is ordered as in
    `to_state_space`.
    """

    def __init__(self, scaffold_in: TorchScaffold, lru: LRU, scaffold_out: TorchScaffold) -> None:
        super().__init__()
        self.scaffold_in = scaffold_in
        self.lru = lru
        self.scaffold_out = scaffold_out
        self.states = lru.order

    def forward(
        self, u: Signals, x0: States | None = None, lifted: Signals | None = None
    ) -> Signals:
        lifted = self.driving_signals(u) if lifted is None else lifted
        linear_output = self.lru(lifted, x0)
        return self.scaffold_out(linear_output)

    def driving_signals(self, u: Signals, lifted: Signals | None = None) -> Signals:
        """Signals that drive the linear recurrence: inputs after the static map, and measured
        disturbances."""
        channel_count = u.shape[2]
        inputs = channel_count - self.lru.disturbances
        if lifted is None:
            plain_inputs = u[..., :inputs]
            lifted = self.scaffold_in(plain_inputs)
        disturbance_count = self.lru.disturbances
        return torch.cat([lifted, u[..., inputs:]], -1) if disturbance_count else lifted

    def simulate_with_final_state(
        self, u: Signals, x0: States, lifted: Signals | None = None
    ) -> tuple[Signals, States]:
        """Simulate the trainable model, and return its output and its final state."""
        lifted = self.driving_signals(u) if lifted is None else lifted
        modes = self.lru.modal_form()
        modal = self.lru.to_modal_state(x0)
        modal_end = final_state(modes, lifted, modal)
        end = self.lru.to_real_state(modal_end)
        linear_output = simulate_modal_form(modes, lifted, modal)
        return self.scaffold_out(linear_output), end

    def to_numpy(self, data: DataSet) -> SSM:
        system = self.lru.to_state_space()
        driven_inputs = system.b.shape[1]
        m = driven_inputs - self.lru.disturbances
        mapped_columns = system.b[:, :m]
        feedthrough_columns = system.d[:, :m]
        linear = StateSpace(a=system.a, b=mapped_columns, c=system.c, d=feedthrough_columns)
        disturbance_count = self.lru.disturbances
        paths = {"b_d": system.b[:, m:]} if disturbance_count else {}
        inward = self.scaffold_in.to_numpy()
        outward = self.scaffold_out.to_numpy()
        return SSM(
            linear=linear,
            scaffold_in=inward,
            scaffold_out=outward,
            scale=data.scale,
            step_s=data.step_s,
            **paths,
        )
