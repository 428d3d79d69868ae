"""What a study has cost, stage by stage: each distinct one once, here or in an earlier study, and what reuse saved."""

import re
from dataclasses import dataclass
from math import fsum

import pandas as pd

from ssm_study.results.plan import duration


@dataclass(frozen=True, kw_only=True)
class StageCost:
    """`uses` runs needed the stage; the `distinct` ones among them take `spent_s` seconds altogether."""

    name: str
    uses: int
    distinct: int
    spent_s: float
    without_reuse_s: float

    @property
    def saved_s(self) -> float:
        return self.without_reuse_s - self.spent_s


def stage_costs(table: pd.DataFrame) -> list[StageCost]:
    """One entry per stage that the records name, in the order of the costliest first."""
    matches = (re.fullmatch(r"stage_(\w+)_key", str(column)) for column in table)
    names = [match[1] for match in matches if match]
    costs = [_cost_of(name, table[[f"stage_{name}_key", f"stage_{name}_seconds"]].dropna()) for name in names]
    return sorted(costs, key=lambda cost: -cost.spent_s)


def _cost_of(name: str, uses: pd.DataFrame) -> StageCost:
    key, seconds = f"stage_{name}_key", f"stage_{name}_seconds"
    once = uses.drop_duplicates(key)
    return StageCost(
        name=name,
        uses=len(uses),
        distinct=len(once),
        spent_s=float(once[seconds].sum()),
        without_reuse_s=float(uses[seconds].sum()),
    )


def cost_lines(table: pd.DataFrame) -> list[str]:
    """The costs as text: stage, uses, how many are distinct, how many reused, time of each, of all, time saved."""
    costs = stage_costs(table)
    lines = [f"{'stage':<14}{'runs':>7}{'distinct':>10}{'reused':>8}{'each':>10}{'cost':>10}{'saved':>10}"]
    for cost in costs:
        counts = f"{cost.uses:>7}{cost.distinct:>10}{cost.uses - cost.distinct:>8}"
        each = cost.spent_s / cost.distinct if cost.distinct else 0.0
        lines.append(f"{cost.name:<14}{counts}{each:>8.2f} s{duration(cost.spent_s):>10}{duration(cost.saved_s):>10}")
    spent, saved = fsum(cost.spent_s for cost in costs), fsum(cost.saved_s for cost in costs)
    return [*lines, f"{'together':<14}{'':>25}{'':>10}{duration(spent):>10}{duration(saved):>10}"]
