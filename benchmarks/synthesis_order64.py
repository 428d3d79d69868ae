"""What a certified design of order 64 takes, exact verdict included: processor seconds of five
random models.

python benchmarks/synthesis_order64.py --table results/reference/engine/order64.csv
"""

import argparse
import os
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from ssm_study.certificates.frontier import controller_frontier
from ssm_study.certificates.problem import dual_system
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace

ORDER = 64
# Largest modulus of a mode, share of the way from the model's own rate to the limit, slope floor of
# the input map.
CASES = (
    (0.97, 0.5, 0.5),
    (0.999, 0.5, 0.5),
    (0.999, 0.9, 0.5),
    (0.97, 0.9, 0.12),
    (0.9, 0.99, 0.5),
)


def drawn(seed: int, radius: float) -> StateSpace:
    """Modes in pairs, one input and one output."""
    rng = np.random.default_rng(seed)
    a = np.zeros((ORDER, ORDER))
    modes = rng.uniform(0.3, radius, ORDER // 2) * np.exp(1j * rng.uniform(0, 3, ORDER // 2))
    for i, z in enumerate(modes):
        a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[z.real, z.imag], [-z.imag, z.real]]
    b = rng.standard_normal((ORDER, 1))
    c = rng.standard_normal((1, ORDER))
    return StateSpace(a=a, b=b, c=c, d=np.zeros((1, 1)))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    rows = [
        "radius,share_of_limit,slope_lower,rate_controller,rate_observer,processor_seconds,certified,load"
    ]
    for seed, (radius, share, slope) in enumerate(CASES):
        system = drawn(seed, radius)
        output = JacobianBall.from_slopes(0.5, 1.0)
        balls = JacobianBalls(input=JacobianBall.from_slopes(slope, 1.0), output=output)
        own = 1 - system.spectral_radius**2
        limits = (
            controller_frontier(system, balls.input),
            controller_frontier(dual_system(system), balls.output),
        )
        rates = [own + share * (limit.rate_limit - own) for limit in limits]
        spec = RiccatiSynthesis(rate_controller=rates[0], rate_observer=rates[1])
        begun = time.process_time()
        design = spec.design(SimpleNamespace(linear=system), balls)
        took = time.process_time() - begun
        values = (
            radius,
            share,
            slope,
            f"{rates[0]:.4f}",
            f"{rates[1]:.4f}",
            f"{took:.2f}",
            design.certified,
        )
        rows.append(",".join(map(str, (*values, os.getloadavg()[0]))))
    print("\n".join(rows))
    if options.table:
        options.table.write_text("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
