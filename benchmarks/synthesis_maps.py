"""Tables behind three figures: `python benchmarks/synthesis_maps.py` (under a minute).

On the first identified model of `trained_models.json` writes, in the same folder,
`feasibility_map.csv` (rate by slope floor: the solver's verdict on the paper's inequality, and the
exact frontier), `gain_norm.csv` (norm of the gain against the asked rate, by method), and
`contraction.csv` (the certified factor per sample against the worst one measured with slopes
jumping in the ball).
"""

import warnings

import numpy as np
from common import write
from synthesis_certified import FOLDER, trained

from ssm_study.certificates.certificate import StateFeedback
from ssm_study.certificates.frontier import contraction_frontier
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.lmi import LmiSynthesis, certificate_from_paper_lmi
from ssm_study.synthesis.minimum_energy import ClosedFormSynthesis
from ssm_study.systems import JacobianBall, StateSpace

FLOORS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)
RATES = np.linspace(0.02, 0.9, 12)
LINEAR_OUTPUT = JacobianBall(alpha=1.0, beta=0.0)


def feasibility_map(linear: StateSpace) -> list[dict[str, object]]:
    rows = []
    for floor in FLOORS:
        ball = JacobianBall.from_slopes(floor, 1.0)
        limit = contraction_frontier(linear.a, linear.b, ball).rate_limit
        for rate in RATES:
            opinion = certificate_from_paper_lmi(linear, ball, float(rate))
            rows.append(
                {
                    "slope_floor": floor,
                    "rate": f"{rate:.4f}",
                    "rate_limit": f"{limit:.6f}",
                    "inside": bool(rate < limit),
                    "solver_status": opinion.solver_status,
                    "solver_certified": opinion.certified,
                }
            )
    return rows


def designs(linear: StateSpace, floor: float) -> list[tuple[str, StateFeedback]]:
    """Every method over rates from 5 to 99 percent of the limit; what is not certified is left
    out."""
    ball = JacobianBall.from_slopes(floor, 1.0)
    found = []
    limit = contraction_frontier(linear.a, linear.b, ball).rate_limit
    for share in (0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99):
        asked = {"rate_controller": share * limit, "rate_observer": 0.5}
        for name, method in (
            ("closed_form", ClosedFormSynthesis(**asked)),
            ("riccati", RiccatiSynthesis(**asked)),
            ("lmi_smallest_gain", LmiSynthesis(**asked, objective="smallest_gain")),
            ("lmi_feasibility", LmiSynthesis(**asked, objective="feasibility")),
        ):
            part = method.state_feedback(linear, ball)
            if isinstance(part, StateFeedback) and part.certified:
                found.append((name, part))
    return found


def gain_norm(found: list[tuple[str, StateFeedback]]) -> list[dict[str, object]]:
    return [
        {
            "method": name,
            "rate": f"{p.rate:.6f}",
            "rate_limit": f"{p.rate_limit:.6f}",
            "gain_norm": f"{p.gain_norm:.6g}",
        }
        for name, p in found
    ]


def contraction(found: list[tuple[str, StateFeedback]]) -> list[dict[str, object]]:
    return [
        {
            "method": name,
            "rate": f"{p.rate:.6f}",
            "certified": f"{p.contraction_factor:.6f}",
            "measured": f"{measured(p):.6f}",
        }
        for name, p in found
    ]


def measured(part: StateFeedback) -> float:
    """The largest `|A_J v| / |v|` in the certified metric over slopes at both ends, exactly: a
    matrix norm."""
    root = np.linalg.cholesky(part.p)
    ends = (part.alpha - part.beta, part.alpha + part.beta)
    closed = [np.linalg.solve(root, (part.a + slope * part.b @ part.k) @ root) for slope in ends]
    return float(max(np.linalg.norm(matrix, 2) for matrix in closed))


def main() -> None:
    warnings.simplefilter("ignore")
    linear = next(case.linear for case in trained(0.5, 100) if case.linear.order == 8)
    write(FOLDER / "feasibility_map.csv", feasibility_map(linear))
    found = designs(linear, 0.3)
    write(FOLDER / "gain_norm.csv", gain_norm(found))
    write(FOLDER / "contraction.csv", contraction(found))
    print(f"tables written to {FOLDER}")


if __name__ == "__main__":
    main()
