"""Speed of the recurrence, forward and backward, batch 16, against its peers.

python benchmarks/models_recurrence.py [CASE ...]    # their numbers; writes
results/reference/training/recurrence.csv
float32; ratio: to the automatic choice of ours in the same run.
dynonet and jax are left out where they are not installed, and the table says so.
"""

import sys
from collections.abc import Callable

import numpy as np
import torch
from common import REFERENCE, keep
from models_bounds import jax_fft, numba_loop
from models_clock import as_in_a_run, interleaved, machine
from models_peers import BareFFT, DynoNetFilter, PublicLRU, Recurrent, StepLoop
from torch import nn

from ssm_study.models import torch_recurrence as recurrence
from ssm_study.models.initial_system import draw_stable_system
from ssm_study.models.torch_ssm import LRU

CASES = [
    (1_000, 8, 16),
    (10_000, 8, 16),
    (10_000, 64, 16),
    (10_000, 256, 16),
    (10_000, 256, 4),
    (100_000, 8, 16),
]
"""Samples, modes, batch. The public scan holds several tables of batch x T x n complex numbers: 4.6
GB at most."""
TARGET = REFERENCE / "training" / "recurrence.csv"


def step(
    model: nn.Module, evaluate: Callable[[torch.Tensor], torch.Tensor], u: torch.Tensor
) -> Callable[[], None]:
    def run() -> None:
        model.zero_grad(set_to_none=True)
        evaluate(u).square().mean().backward()

    return run


def contenders(samples: int, modes: int, batch: int = 16) -> dict[str, Callable[[], object]]:
    """All that finish one pass in reasonable time; u needs a gradient, since S_u stands before the
    recurrence."""
    torch.manual_seed(0)
    u = torch.randn(batch, samples, 1, requires_grad=True)
    start = draw_stable_system(
        2 * modes, 0, (0.5, 0.99), (0.05, 1.5), (1, 1), np.random.default_rng(0)
    )
    ours = LRU(start, feedthrough=False).float()
    evaluations = {
        "convolution": recurrence.simulate_by_convolution,
        "chunks": recurrence.simulate_in_blocks,
    }
    runs = {
        name: step(ours, lambda v, law=law: law(ours.modal_form(), v), u)
        for name, law in evaluations.items()
    }
    runs["automatic"] = step(ours, ours, u)
    bare = BareFFT(samples)
    public = PublicLRU(modes)
    runs |= {"bare FFT": step(bare, bare, u), "public scan": step(public, public, u)}
    runs["numba loop"] = numba_loop(u.detach().numpy(), modes)
    runs |= _optional(u, modes)
    if samples <= 10_000 and modes <= 64:
        loop = StepLoop(modes)
        runs["python loop"] = step(loop, loop, u)
        for name, kind in (("LSTM", nn.LSTM), ("GRU", nn.GRU)):
            peer = Recurrent(kind, modes)
            runs[name] = step(peer, peer, u)
    if batch * samples * modes > 41_000_000:
        del runs["public scan"]
    return runs


def _optional(u: torch.Tensor, modes: int) -> dict[str, Callable[[], object]]:
    """Contenders whose packages are extras."""
    runs: dict[str, Callable[[], object]] = {}
    try:
        runs["JAX FFT"] = jax_fft(u.detach().numpy(), modes)
    except ImportError:
        print("JAX FFT left out: pip install jax")
    if modes > 64:
        return runs  # a transfer function of order 512 is beyond its arithmetic
    try:
        peer = DynoNetFilter(2 * modes)
    except ImportError:
        print("dynoNet left out: pip install dynonet")
    else:
        runs["dynoNet filter"] = step(peer, peer, u)
    return runs


def measured(samples: int, modes: int, batch: int) -> list[dict[str, object]]:
    times = interleaved(contenders(samples, modes, batch), seconds=6.0, least=3)
    ours = times["automatic"]
    print(
        samples,
        modes,
        batch,
        {name: f"{ms:.3g} ms ({ms / ours:.2f}x)" for name, ms in times.items()},
        flush=True,
    )
    case = {"samples": samples, "modes": modes, "batch": batch}
    return [
        case
        | {
            "contender": name,
            "cpu_ms": f"{ms:.3g}",
            "ratio": f"{ms / ours:.3g}",
            "machine": machine(),
        }
        for name, ms in times.items()
    ]


def main(cases: list[int]) -> None:
    """Measures the cases of these numbers, and keeps what the table says of the others."""
    chosen = [CASES[number] for number in cases or range(len(CASES))]
    rows = [row for case in chosen for row in measured(*case)]
    key = ("samples", "modes", "batch")
    order = {tuple(map(str, case)): at for at, case in enumerate(CASES)}
    keep(TARGET, rows, key, lambda row: order[tuple(str(row[name]) for name in key)])


if __name__ == "__main__":
    as_in_a_run()
    main([int(number) for number in sys.argv[1:]])
