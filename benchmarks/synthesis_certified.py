"""Share certified exactly, by method and distance from the frontier: `python
benchmarks/synthesis_certified.py`.

Writes `results/reference/certificates/certified.csv`, one row per (set, method, gap): how many of
how many were certified, in how much time. A gap below zero lies beyond the frontier: nothing may be
certified there. Options: `--count N` per gap, `--gaps g ...`, `--orders low high`, `--set
random|mixed|trained`, `--methods a,b`; rows of other runs are kept.
"""

import argparse
import json
import time
import warnings

import numpy as np
from common import REFERENCE, keep
from synthesis_instances import Instance, random_instance

from ssm_study.certificates.frontier import contraction_frontier
from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.lmi import LmiSynthesis, certificate_from_paper_lmi
from ssm_study.synthesis.minimum_energy import ClosedFormSynthesis
from ssm_study.systems import JacobianBall, StateSpace

FOLDER = REFERENCE / "certificates"
METHODS: dict[str, type[Synthesis]] = {
    "closed_form": ClosedFormSynthesis,
    "riccati": RiccatiSynthesis,
    "lmi": LmiSynthesis,
}
GAPS = (0.001, 0.0001, 0.01, 0.1, 0.5, -0.01)
KEY = ("set", "method", "gap")
COLUMNS = (*KEY, "instances", "certified", "share_percent", "seconds_median", "orders", "misses")
AGREEMENT = ("agrees", "cannot_tell", "contradicts")  # with the frontier: `synthesis_agreement.py`


def instances(kind: str, gap: float, count: int, orders: tuple[int, int]) -> list[Instance]:
    if kind == "trained":
        return trained(gap, count)
    rng = np.random.default_rng(20261121)
    found: list[Instance] = []
    while len(found) < count:
        case = random_instance(rng, orders, gap, mixed=kind == "mixed")
        if case is not None:
            found.append(case)
    return found


def trained(gap: float, count: int) -> list[Instance]:
    """The identified models of `trained_models.json`, each with its own Jacobian ball."""
    found = []
    for model in json.loads((FOLDER / "trained_models.json").read_text())[:count]:
        a, b, c = (np.array(model[name]) for name in ("a", "b", "c"))
        linear = StateSpace(a=a, b=b, c=c, d=np.zeros((c.shape[0], b.shape[1])))
        ball = JacobianBall(alpha=model["alpha"], beta=model["beta"])
        wider = JacobianBall(alpha=ball.alpha, beta=ball.beta / (1 - gap))
        if wider.relative_radius < 1:
            contraction = contraction_frontier(linear.a, linear.b, wider).contraction_limit
            found.append(
                Instance(linear=linear, ball=ball, rate=1 - contraction**2, kind=model["origin"])
            )
    return found


def certified(method: str, case: Instance) -> bool:
    if method == "paper_lmi":
        return certificate_from_paper_lmi(case.linear, case.ball, case.rate).certified
    options = {"objective": "feasibility"} if method == "lmi" else {}
    specification = METHODS[method](rate_controller=case.rate, rate_observer=0.5, **options)
    return specification.state_feedback(case.linear, case.ball).certified


def row(kind: str, method: str, gap: float, cases: list[Instance]) -> dict[str, object]:
    verdicts = []
    seconds = []
    for case in cases:
        started = time.perf_counter()
        verdicts.append(certified(method, case))
        seconds.append(time.perf_counter() - started)
    return told(
        (kind, method, gap), [(case.linear.order, case.kind) for case in cases], verdicts, seconds
    )


def told(
    key: tuple[str, str, float],
    models: list[tuple[int, str]],
    held: list[bool],
    seconds: list[float],
) -> dict[str, object]:
    """The line of one (set, method, gap): of which models, by order and kind, how many were
    certified, how fast."""
    orders = [order for order, _ in models]
    missed = [model for model, ok in zip(models, held, strict=True) if not ok]
    return dict(zip(KEY, key, strict=True)) | {
        "instances": len(models),
        "certified": sum(held),
        "share_percent": 100 * sum(held) / len(models),
        "seconds_median": f"{np.median(seconds):.6f}",
        "orders": f"{min(orders)}-{max(orders)}",
        "misses": named(missed) if key[2] > 0 else "",
    }


def named(missed: list[tuple[int, str]]) -> str:
    """The first few."""
    return "; ".join(f"n={order} {kind}" for order, kind in missed[:8])


def kept(new: dict[str, object]) -> None:
    """In place of the row of the same set, method and gap."""
    path = FOLDER / "certified.csv"
    columns = COLUMNS + AGREEMENT
    keep(
        path, [new], KEY, lambda row: (row["set"], row["method"], -float(str(row["gap"]))), columns
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--set", choices=("random", "mixed", "trained"), default="random")
    parser.add_argument("--methods", default="closed_form,riccati")
    parser.add_argument("--gaps", type=float, nargs="+", default=GAPS)
    parser.add_argument("--orders", type=int, nargs=2, default=(1, 32))
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    for gap in arguments.gaps:
        cases = instances(arguments.set, gap, arguments.count, tuple(arguments.orders))
        for method in arguments.methods.split(","):
            new = row(arguments.set, method, gap, cases)
            kept(new)
            print(*new.values(), flush=True)


if __name__ == "__main__":
    main()
