"""How tight the slope bounds are: `OMP_NUM_THREADS=1 python benchmarks/synthesis_bounds.py` (a
minute).

Random leaky networks; of each bound the certified radius around its centre, the farthest Jacobian
that sampling and gradient search find from that centre, and their ratio (found over certified: one
is exact, above one would be unsound); beside it the norm product of the paper over the upper end of
the ball. Writes `certificates/bounds.csv`.
"""

import sys
import time
from itertools import pairwise
from statistics import median

import numpy as np
from common import REFERENCE, ROOT, write

from ssm_study.bounds.network import Network
from ssm_study.bounds.slopes import (
    interval_bound,
    lipsdp_bound,
    network_slope_bound,
    spectral_norm_bound,
)
from ssm_study.models.scaffolds.mlp import MlpScaffold

sys.path.insert(0, str(ROOT / "tests"))  # where oracles are
from worst_case import worst_jacobian

SHAPES = ((1, (8,)), (1, (32,)), (1, (8, 8)), (2, (8,)), (2, (32,)), (2, (8, 8)), (3, (16,)))
COUNT = 20
STARTS = 6
LEAK = 0.1
BOUNDS = {"exact": network_slope_bound, "lipsdp": lipsdp_bound, "interval": interval_bound}


def scaffold(rng: np.random.Generator, channels: int, widths: tuple[int, ...]) -> MlpScaffold:
    sizes = (channels, *widths, channels)
    weights = tuple(
        rng.normal(size=(after, before)) / np.sqrt(before) for before, after in pairwise(sizes)
    )
    return MlpScaffold(
        network=Network(
            weights=weights,
            biases=tuple(rng.normal(size=width) for width in widths),
            negative_slopes=tuple(np.full(width, LEAK) for width in widths),
            positive_slopes=tuple(np.ones(width) for width in widths),
        )
    )


def row(channels: int, widths: tuple[int, ...], method: str) -> dict[str, object]:
    rng = np.random.default_rng(0)
    ratios = []
    against_norms = []
    spent = []
    for seed in range(COUNT):
        network = scaffold(rng, channels, widths)
        started = time.process_time()
        ball = BOUNDS[method](network.network).ball
        spent.append(1e3 * (time.process_time() - started))
        ratios.append(worst_jacobian(network, ball, seed=seed, starts=STARTS).tightness(ball))
        against_norms.append(
            spectral_norm_bound(network.network)[1] / max(abs(ball.lower), abs(ball.upper))
        )
    return {
        "channels": channels,
        "hidden": "x".join(map(str, widths)),
        "method": method,
        "networks": COUNT,
        "tightness_median": f"{median(ratios):.4f}",
        "tightness_smallest": f"{min(ratios):.4f}",
        "tightness_largest": f"{max(ratios):.9f}",
        "norm_product_over_bound_median": f"{median(against_norms):.3f}",
        "milliseconds_median": f"{median(spent):.3f}",
    }


def main() -> None:
    rows = []
    for channels, widths in SHAPES:
        for method in ("exact", "lipsdp", "interval") if channels == 1 else ("lipsdp", "interval"):
            rows.append(row(channels, widths, method))
            print(rows[-1], flush=True)
    write(REFERENCE / "certificates" / "bounds.csv", rows)


if __name__ == "__main__":
    main()
