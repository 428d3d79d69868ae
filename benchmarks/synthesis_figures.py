"""Draw the tables of `synthesis_maps.py`: `python benchmarks/synthesis_figures.py` (seconds).

Writes feasibility_map, gain_norm and contraction as PNG and PDF beside their tables.
"""

import pandas as pd
from synthesis_certified import FOLDER

from ssm_study.report import certificate_figures, style

FIGURES = {
    "feasibility_map": certificate_figures.feasibility_map,
    "gain_norm": certificate_figures.gain_norm,
    "contraction": certificate_figures.contraction,
}


def main() -> None:
    for name, draw in FIGURES.items():
        with style.paper():
            paths = style.save(draw(pd.read_csv(FOLDER / f"{name}.csv")), FOLDER, name)
        print(*paths, sep="\n")


if __name__ == "__main__":
    main()
