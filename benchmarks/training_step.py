"""One whole training step of the paper's model: ours, the plain eager one, a public scan; and
Lightning's overhead.

python benchmarks/training_step.py [step] [overhead]     # writes
results/reference/training/step.csv
Batch 16, 5000 samples, order 16, width 32, float32, fused Adam; every row says what the machine was
doing.
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from common import REFERENCE, keep
from models_clock import as_in_a_run, interleaved, machine
from models_peers import PublicLRU
from torch import Tensor, nn
from torch.utils.data import DataLoader

from ssm_study.models.initial_system import draw_stable_system
from ssm_study.models.scaffolds.linear import Linear
from ssm_study.models.scaffolds.mlp import Mlp
from ssm_study.models.scaffolds.trainable import MapContext
from ssm_study.models.torch_recurrence import simulate_by_convolution
from ssm_study.models.torch_ssm import LRU, InputMapping, TorchSSM

BATCH = 16
SAMPLES = 5000
ORDER = 16
WIDTH = 32
TARGET = REFERENCE / "training" / "step.csv"


class PlainMlp(nn.Module):
    """The scaffolding as a library would write it: two linear layers and a leaky ReLU over a
    samples x width table."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Linear(1, WIDTH)
        self.last = nn.Linear(WIDTH, 1)

    def forward(self, v: Tensor) -> Tensor:
        return self.last(nn.functional.leaky_relu(self.first(v), 0.01))


def ours() -> TorchSSM:
    rng = np.random.default_rng(0)
    frame = MapContext(width=WIDTH, slopes=(0.01, 1.0), samples=rng.normal(size=(1000, 1)))
    scaffold = Mlp(depth=1, train_slopes=True, certified=True).build(frame, rng)
    lru = LRU(
        draw_stable_system(ORDER, 0, (0.5, 0.99), (0.05, 1.5), (1, 1), rng), feedthrough=False
    )
    return TorchSSM(scaffold, lru, Linear().build(frame, rng)).float()


def stepper(
    parameters: list[nn.Parameter], forward: Callable[[], Tensor], y: Tensor
) -> Callable[[], None]:
    trained = [p for p in parameters if p.requires_grad]
    optimiser = torch.optim.Adam(trained, fused=not any(p.is_complex() for p in trained))

    def step() -> None:
        optimiser.zero_grad(set_to_none=True)
        (forward() - y).square().mean().backward()
        optimiser.step()

    return step


def contenders() -> dict[str, Callable[[], None]]:
    torch.manual_seed(0)
    u = torch.randn(BATCH, SAMPLES, 1)
    y = torch.randn(BATCH, SAMPLES, 1)
    held = torch.randn(BATCH, SAMPLES // 20, 1).repeat_interleave(20, dim=1)
    fast = ours()
    fft = ours()
    public = PublicLRU(ORDER // 2)
    plain = PlainMlp()
    plain_fft = PlainMlp()
    lifted = InputMapping(u)
    levels = InputMapping(held)
    return {
        "ours": stepper(
            list(fast.parameters()), lambda: fast(u, lifted=lifted(fast.scaffold_in)), y
        ),
        "ours, input held for 20 samples": stepper(
            list(fast.parameters()), lambda: fast(held, lifted=levels(fast.scaffold_in)), y
        ),
        "plain eager FFT": stepper(
            [*fft.lru.parameters(), *plain_fft.parameters()],
            lambda: simulate_by_convolution(fft.lru.modal_form(), plain_fft(u)),
            y,
        ),
        "public scan": stepper(
            [*public.parameters(), *plain.parameters()], lambda: public(plain(u)), y
        ),
    }


class Bare(pl.LightningModule):
    """Steps of three numbers, `steps` in each call as in `Fit`: nearly all of their cost in a
    trainer is overhead."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.numbers = nn.Parameter(torch.zeros(3))
        self.steps = steps
        self.automatic_optimization = False

    def evaluate(self) -> Tensor:
        self.zero_grad()
        loss = self.numbers.square().sum()
        loss.backward()
        return loss

    def training_step(self, batch: Tensor, batch_idx: int) -> None:  # noqa: ARG002
        optimiser: Any = self.optimizers()
        for _ in range(self.steps):
            optimiser.step(self.evaluate)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.parameters(), fused=True)


def overhead_ms(steps_per_call: int, pairs: int = 7, steps: int = 400) -> float:
    """Lightning's step minus one of our own loop, start-up left out of both; median over
    alternating stretches."""
    module = Bare(steps_per_call)
    excess = []
    optimiser = module.configure_optimizers()
    for _ in range(pairs):
        inside = lightning_ms(steps_per_call, 50 + steps) - lightning_ms(steps_per_call, 50)
        began = time.process_time()
        for _ in range(steps):
            optimiser.step(module.evaluate)
        excess.append((inside - 1e3 * (time.process_time() - began)) / steps)
    return statistics.median(excess)


def lightning_ms(steps_per_call: int, steps: int) -> float:
    """CPU milliseconds of a whole training of so many steps; each call is an epoch, as in
    `Training`."""
    with tempfile.TemporaryDirectory() as folder:
        trainer = pl.Trainer(
            max_epochs=steps // steps_per_call, accelerator="cpu", logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False, enable_model_summary=False, default_root_dir=folder,
        )  # fmt: skip
        one: DataLoader = DataLoader(range(1), batch_size=1)  # type: ignore[arg-type]
        module = Bare(steps_per_call)
        began = time.process_time()
        trainer.fit(module, one)
        return 1e3 * (time.process_time() - began)


def main(parts: list[str]) -> None:
    """Measures `step`, `overhead` or both, and keeps what the table says of the other."""
    times = interleaved(contenders(), seconds=8.0) if "step" in parts else {}
    if "overhead" in parts:  # Adam's yaml has 50 steps per epoch
        times |= {f"Lightning's overhead, {k} steps per epoch": overhead_ms(k) for k in (10, 50)}
    rows = [
        {"contender": name, "cpu_ms": f"{ms:.3g}", "machine": machine()}
        for name, ms in times.items()
    ]
    keep(TARGET, rows, ["contender"], lambda row: str(row["contender"]).startswith("Lightning's"))
    print(TARGET.read_text())


if __name__ == "__main__":
    as_in_a_run()
    main(sys.argv[1:] or ["step", "overhead"])
