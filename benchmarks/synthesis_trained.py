"""Collect identified models for the synthesis benchmark: `python benchmarks/synthesis_trained.py FOLDER...`.

Reads every `model.json` below the folders, keeps up to a hundred distinct ones whose input scaffolding is one-channel
with slopes that exclude zero, and writes their linear parts and Jacobian balls to
`results/reference/certificates/trained_models.json`.
"""

import json
import sys
from pathlib import Path

from ssm_study.bounds.scaffolds import jacobian_ball
from ssm_study.models.identified import SSM
from ssm_study.refusal import BadRequest

FOLDER = Path(__file__).resolve().parents[1] / "results" / "reference" / "certificates"
MOST = 100


def main() -> None:
    kept: dict[str, dict[str, object]] = {}
    for path in sorted(p for folder in sys.argv[1:] for p in Path(folder).rglob("model.json")):
        try:
            model = SSM.from_json(json.loads(path.read_text()))
        except (BadRequest, ValueError):
            continue
        ball = jacobian_ball(model.scaffold_in).ball if model.scaffold_in.inputs == 1 else None
        if ball is None or ball.relative_radius >= 1 or model.order < 2:
            continue
        parts = {name: getattr(model.linear, name).tolist() for name in ("a", "b", "c")}
        origin = f"{path.parent.parent.name}, order {model.order}"
        kept.setdefault(json.dumps(parts), {**parts, "alpha": ball.alpha, "beta": ball.beta, "origin": origin})
    FOLDER.mkdir(parents=True, exist_ok=True)
    chosen = list(kept.values())[:MOST]
    lines = ",\n".join(json.dumps(model) for model in chosen)
    (FOLDER / "trained_models.json").write_text(f"[\n{lines}\n]\n")
    print(f"{len(chosen)} of {len(kept)} models kept")


if __name__ == "__main__":
    main()
