"""One whole training step of the paper's model: ours, the plain eager one, a public scan; and Lightning's overhead.

python benchmarks/training_step.py        # writes results/reference/training/step.csv
"""

import csv
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import lightning.pytorch as pl
import numpy as np
import torch
from models_clock import as_in_a_run, interleaved, machine
from models_peers import PublicLRU
from torch import Tensor, nn
from torch.utils.data import DataLoader

from ssm_study.models.scaffold_specs import Frame, Mlp
from ssm_study.models.start import on_ring
from ssm_study.models.torch_lift import Lift
from ssm_study.models.torch_lru import LRU
from ssm_study.models.torch_recurrence import by_convolution
from ssm_study.models.torch_scaffold import TorchIdentity
from ssm_study.models.torch_ssm import TorchSSM

BATCH, SAMPLES, ORDER, WIDTH = 16, 5000, 16, 32
TARGET = Path(__file__).resolve().parents[1] / "results" / "reference" / "training" / "step.csv"


class PlainMlp(nn.Module):
    """The scaffolding as a library would write it: two linear layers and a leaky ReLU over a samples x width table."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.last = nn.Linear(1, WIDTH), nn.Linear(WIDTH, 1)

    def forward(self, v: Tensor) -> Tensor:
        return self.last(nn.functional.leaky_relu(self.first(v), 0.01))


def ours() -> TorchSSM:
    rng = np.random.default_rng(0)
    frame = Frame(width=WIDTH, slopes=(0.01, 1.0), samples=rng.normal(size=(1000, 1)))
    scaffold = Mlp(depth=1, train_slopes=True, certified=True).build(frame, rng)
    lru = LRU(on_ring(ORDER, 0, (0.5, 0.99), (0.05, 1.5), (1, 1), rng), feedthrough=False)
    return TorchSSM(scaffold, lru, TorchIdentity(1)).float()


def stepper(parameters: list[nn.Parameter], forward: Callable[[], Tensor], y: Tensor) -> Callable[[], None]:
    trained = [p for p in parameters if p.requires_grad]
    optimiser = torch.optim.Adam(trained, fused=not any(p.is_complex() for p in trained))

    def step() -> None:
        optimiser.zero_grad(set_to_none=True)
        (forward() - y).square().mean().backward()
        optimiser.step()

    return step


def contenders() -> dict[str, Callable[[], None]]:
    torch.manual_seed(0)
    u, y = torch.randn(BATCH, SAMPLES, 1), torch.randn(BATCH, SAMPLES, 1)
    held = torch.randn(BATCH, SAMPLES // 20, 1).repeat_interleave(20, dim=1)
    fast, fft, public, plain, plain_fft = ours(), ours(), PublicLRU(ORDER // 2), PlainMlp(), PlainMlp()
    lifted, levels = Lift(u), Lift(held)
    return {
        "ours": stepper(list(fast.parameters()), lambda: fast.respond(lifted(fast.scaffold_in)), y),
        "ours, input held for 20 samples": stepper(
            list(fast.parameters()), lambda: fast.respond(levels(fast.scaffold_in)), y
        ),
        "plain eager FFT": stepper(
            [*fft.lru.parameters(), *plain_fft.parameters()], lambda: by_convolution(fft.lru.modes(), plain_fft(u)), y
        ),
        "public scan": stepper([*public.parameters(), *plain.parameters()], lambda: public(plain(u)), y),
    }


class Bare(pl.LightningModule):
    """Our step inside Lightning's trainer with nothing attached."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.net, self.automatic_optimization = ours(), True
        self.y, self.lift = torch.randn(BATCH, SAMPLES, 1), Lift(torch.randn(BATCH, SAMPLES, 1))

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:  # noqa: ARG002
        return (self.net.respond(self.lift(self.net.scaffold_in)) - self.y).square().mean()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam([p for p in self.net.parameters() if p.requires_grad], fused=True)


class Loop:
    """The same module stepped by four lines of our own: what Lightning's overhead is measured against."""

    def __init__(self) -> None:
        self.module = Bare()
        self.optimiser = self.module.configure_optimizers()

    def __call__(self) -> None:
        self.optimiser.zero_grad()
        self.module.training_step(torch.zeros(()), 0).backward()
        self.optimiser.step()


def overhead_ms(pairs: int = 5, steps: int = 60) -> float:
    """Median over alternating stretches of steps, Lightning's minus our own loop's, start-up left out of both."""
    loop, excess = Loop(), []
    for _ in range(pairs):
        short, long = lightning_step_ms(20), lightning_step_ms(20 + steps)
        inside = ((20 + steps) * long - 20 * short) / steps
        began = time.process_time()
        for _ in range(steps):
            loop()
        excess.append(inside - 1e3 * (time.process_time() - began) / steps)
    return statistics.median(excess)


def lightning_step_ms(steps: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        trainer = pl.Trainer(
            max_steps=steps, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
            enable_model_summary=False, default_root_dir=folder, max_epochs=1,
        )  # fmt: skip
        batches: DataLoader = DataLoader(range(steps), batch_size=1)  # type: ignore[arg-type]
        module = Bare()
        began = time.process_time()
        trainer.fit(module, batches)
        return 1e3 * (time.process_time() - began) / steps


def main() -> None:
    runs = contenders()
    times = interleaved(runs, seconds=8.0)
    times["Lightning's overhead"] = overhead_ms()
    rows = [
        {"contender": name, "cpu_ms": f"{ms:.3g}", "ratio": f"{ms / times['ours']:.3g}"} for name, ms in times.items()
    ]
    TARGET.parent.mkdir(parents=True, exist_ok=True)
    with TARGET.open("w", newline="") as file:
        file.write(f"# {machine()}; batch {BATCH}, T {SAMPLES}, order {ORDER}, width {WIDTH}, float32, fused Adam\n")
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    print(TARGET.read_text())


if __name__ == "__main__":
    as_in_a_run()
    main()
