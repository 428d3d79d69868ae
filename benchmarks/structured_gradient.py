"""The derivatives of a structured model's squared error: compiled by hand, and by autograd through
a loop of torch.

    OMP_NUM_THREADS=1 python benchmarks/structured_gradient.py [--to FILE]

writes results/reference/training/structured_gradient.csv. Per row: samples, states (as many
neurons), and processor milliseconds of one thread: loss and gradient by the compiled adjoint
(tests/structured_adjoint.py), the whole Jacobian that a step of the training needs, loss and
gradient by torch. A batch of 16 records, one input, one output, linear S_u. Medians of five pairs;
the three gradients are compared first.
"""

import argparse
import sys
from functools import partial
from pathlib import Path

import numpy as np
import torch
from common import REFERENCE, ROOT, cpu_seconds, write

from ssm_study.models.structured_spec import TrainablePiecewiseMap
from ssm_study.training.record_batch import RecordBatch
from ssm_study.training.structured_problem import CORE, SimulationProblem, Theta

sys.path.append(str(ROOT / "tests"))
from structured_adjoint import gradient

TARGET = REFERENCE / "training" / "structured_gradient.csv"
BATCH = 16
PAIRS = 5
FREE = (*CORE, "b", "g", "bias", "c")


def problem(samples: int, size: int) -> tuple[SimulationProblem, Theta]:
    rng = np.random.default_rng(size)
    u = np.repeat(rng.uniform(-1, 1, (BATCH, samples // 10, 1)), 10, axis=1)
    y = rng.normal(size=u.shape)
    identity = TrainablePiecewiseMap(1, 0, 0.1, 1.0)
    told = {"neurons": ("tanh",) * size, "lift": identity, "read": identity}
    one = SimulationProblem(records=RecordBatch.from_pairs(list(zip(u, y, strict=True))), **told)  # type: ignore[arg-type]
    a = 0.9 * np.linalg.qr(rng.normal(size=(size, size)))[0]
    theta = {"a": a, "e": 0.05 * rng.normal(size=(size, size)), "f": rng.normal(size=(size, size))}
    theta |= {
        "b": rng.normal(size=(size, 1)),
        "g": rng.normal(size=(size, 1)),
        "bias": rng.normal(size=size),
    }
    theta |= {"c": rng.normal(size=(1, size)), "d": np.zeros((1, 1)), "h": np.zeros((1, size))}
    return one, theta | {
        "scaffold_in": np.zeros(0),
        "scaffold_out": np.zeros(0),
        "x0": np.zeros((BATCH, size)),
    }


def by_adjoint(one: SimulationProblem, theta: Theta) -> np.ndarray:
    parts = gradient(one, theta)
    return np.concatenate([parts[name].ravel() for name in FREE])


def by_jacobian(one: SimulationProblem, theta: Theta) -> np.ndarray:
    r, j, _ = one.residual_and_jacobian(theta, FREE)
    return 2.0 * (j.T @ r)


def by_autograd(one: SimulationProblem, theta: Theta) -> np.ndarray:
    parts = {name: torch.tensor(theta[name], requires_grad=True) for name in FREE}
    u, y, weight = (torch.from_numpy(np.ascontiguousarray(side)) for side in one.records)
    x = torch.zeros(BATCH, len(theta["a"]), dtype=torch.float64)
    still = torch.tanh(parts["bias"])
    out = []
    for k in range(u.shape[1]):
        w = torch.tanh(x @ parts["f"].T + u[:, k] @ parts["g"].T + parts["bias"]) - still
        out.append(x @ parts["c"].T)
        x = x @ parts["a"].T + u[:, k] @ parts["b"].T + w @ parts["e"].T
    (weight * (torch.stack(out, 1) - y)).square().sum().backward()
    return np.concatenate([part.grad.numpy().ravel() for part in parts.values()])


def row(samples: int, size: int) -> dict[str, object]:
    (one, theta), calls = problem(samples, size), (by_adjoint, by_jacobian, by_autograd)
    found = [call(one, theta) for call in calls]
    for other in found[1:]:
        np.testing.assert_allclose(found[0], other, rtol=1e-6, atol=1e-9 * np.abs(other).max())
    times = [[1e3 * cpu_seconds(partial(call, one, theta)) for call in calls] for _ in range(PAIRS)]
    names = ("adjoint_ms", "jacobian_ms", "autograd_loop_ms")
    told = dict(zip(names, np.median(times, axis=0), strict=True))
    told["loop_over_adjoint"] = float(np.median([loop / first for first, _, loop in times]))
    return {"samples": samples, "states": size} | {
        name: f"{value:.3g}" for name, value in told.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--to", type=Path, default=TARGET)
    parser.add_argument("--samples", type=int, nargs="+", default=[1000, 5000, 25000])
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = [row(samples, size) for size in (4, 8) for samples in options.samples]
    write(options.to, rows)
    print(options.to.read_text())


if __name__ == "__main__":
    main()
