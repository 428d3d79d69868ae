"""Identify a hundred models for the synthesis benchmark: `python benchmarks/synthesis_trained.py`
(minutes).

Four plants, orders 2 to 8 and several seeds; short records and few epochs (the size of
`experiment=smoke`). Each model is put into balanced coordinates as a study would, and kept once if
its order is at least two and its slopes exclude zero. Writes the linear parts and Jacobian balls to
`results/reference/certificates/trained_models.json`, after the 54 gathered from earlier studies (27
motor models, each as identified and in balanced coordinates), which name no seed.
"""

import itertools
import json
import tempfile
import time
from pathlib import Path

from common import REFERENCE, study_of

from ssm_study.bounds.slopes import jacobian_ball
from ssm_study.models.identified import SSM
from ssm_study.refusal import BadRequest

TARGET = REFERENCE / "certificates" / "trained_models.json"
PLANTS = ("dc_motor", "stribeck_drive", "cascaded_tanks", "dc_motor_limited")
ORDERS = (2, 3, 4, 6, 8)
SEEDS = range(10)
MOST = 100
SIZE = (
    "data.trajectories=3",
    "data.samples=400",
    "data.validation_samples=400",
    "data.test_samples=400",
    "model.hidden_width=8",
    "training.max_epochs=8",
)


def identified(plant: str, order: int, seed: int) -> SSM:
    part = study_of(f"plant={plant}", "model=ssm", *SIZE, f"model.order={order}")
    data = part.data.build(part.plant, part.excitation, seed)
    with tempfile.TemporaryDirectory() as folder:
        found = part.training.identify(part.model, data, seed, Path(folder))
    model: SSM = part.reduction.reduce_model(found.model)
    return model


def described(model: SSM, origin: str) -> dict[str, object] | None:
    """What the benchmark reads; None for a model that no certificate could be asked of."""
    ball = jacobian_ball(model.scaffold_in).ball
    if ball.relative_radius >= 1 or model.order < 2:
        return None
    parts = {name: getattr(model.linear, name).tolist() for name in ("a", "b", "c")}
    return {**parts, "alpha": ball.alpha, "beta": ball.beta, "origin": origin}


def write(models: list[dict[str, object]]) -> None:
    lines = ",\n".join(json.dumps(model) for model in models)
    TARGET.write_text(f"[\n{lines}\n]\n")


def main() -> None:
    earlier = [model for model in json.loads(TARGET.read_text()) if "seed" not in model["origin"]]
    kept: list[dict[str, object]] = []
    started = time.perf_counter()
    for seed, order, plant in itertools.product(SEEDS, ORDERS, PLANTS):
        if len(kept) == MOST:
            break
        origin = f"{plant}, order {order}, seed {seed}"
        try:
            model = described(identified(plant, order, seed), origin)
        except BadRequest as refusal:
            print(f"{origin}: {refusal}", flush=True)
            continue
        if model is not None:
            kept.append(model)
            print(f"{time.perf_counter() - started:6.1f} s, {len(kept)} kept: {origin}", flush=True)
    write(earlier + kept)


if __name__ == "__main__":
    main()
