"""Speed of the recurrence, forward and backward, batch 16, against its peers.

python benchmarks/models_recurrence.py            # writes results/reference/training/recurrence.csv
"""

import csv
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from models_clock import interleaved, machine
from models_peers import BareFFT, PublicLRU, Recurrent, StepLoop
from torch import nn

from ssm_study.models import torch_recurrence as recurrence
from ssm_study.models.start import on_ring
from ssm_study.models.torch_lru import LRU

BATCH = 16
CASES = [(1_000, 8), (10_000, 8), (10_000, 64), (10_000, 256), (100_000, 8)]
TARGET = Path(__file__).resolve().parents[1] / "results" / "reference" / "training" / "recurrence.csv"


def step(model: nn.Module, evaluate: Callable[[torch.Tensor], torch.Tensor], u: torch.Tensor) -> Callable[[], None]:
    def run() -> None:
        model.zero_grad(set_to_none=True)
        evaluate(u).square().mean().backward()

    return run


def contenders(samples: int, modes: int) -> dict[str, Callable[[], None]]:
    """All that finish one pass in reasonable time; u needs a gradient, since S_u stands before the recurrence."""
    torch.manual_seed(0)
    u = torch.randn(BATCH, samples, 1, requires_grad=True)
    start = on_ring(2 * modes, 0, (0.5, 0.99), (0.05, 1.5), (1, 1), np.random.default_rng(0))
    ours = LRU(start, feedthrough=False).float()
    evaluations = {
        "convolution": recurrence.by_convolution,
        "chunks": recurrence.by_chunks,
        "automatic": recurrence.respond,
    }
    runs = {name: step(ours, lambda v, law=law: law(ours.modes(), v), u) for name, law in evaluations.items()}
    bare, public = BareFFT(samples), PublicLRU(modes)
    runs |= {"bare FFT": step(bare, bare, u), "public scan": step(public, public, u)}
    if samples <= 10_000:
        loop = StepLoop(modes)
        runs["python loop"] = step(loop, loop, u)
        if modes <= 64:
            for name, kind in (("LSTM", nn.LSTM), ("GRU", nn.GRU)):
                peer = Recurrent(kind, modes)
                runs[name] = step(peer, peer, u)
    if samples * modes > 1_000_000:
        del runs["public scan"]  # two tables of 16 T n complex numbers, and their history
        runs.pop("python loop", None)
    return runs


def main() -> None:
    rows = []
    for samples, modes in CASES:
        slow = contenders(samples, modes)
        times = interleaved(slow, seconds=3.0, least=3)
        ours = times["automatic"]
        rows += [
            {"samples": samples, "modes": modes, "contender": name, "cpu_ms": f"{ms:.3g}", "ratio": f"{ms / ours:.3g}"}
            for name, ms in times.items()
        ]
        print(samples, modes, {name: f"{ms:.3g} ms ({ms / ours:.2f}x)" for name, ms in times.items()}, flush=True)
    TARGET.parent.mkdir(parents=True, exist_ok=True)
    with TARGET.open("w", newline="") as file:
        file.write(f"# {machine()}; batch {BATCH}, float32, forward and backward; ratio: to the automatic choice\n")
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    sys.exit(main())
