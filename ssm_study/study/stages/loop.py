"""Stage that simulates the closed loop of the certified gains, on the plant or on the identified
model."""

from pathlib import Path
from typing import Any

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.engine.stages import Facts, Stage
from ssm_study.loop.metrics import behaviour_columns, certified_bound_columns
from ssm_study.loop.peers.peer import IdentificationResult
from ssm_study.loop.regulation import (
    IdentifiedPlant,
    LoopExperiment,
    LoopRuns,
    has_direct_feedthrough,
)
from ssm_study.signals import DataSet
from ssm_study.study.loop_recordings import (
    NOISE_FREE,
    ON_MODEL,
    ON_PLANT,
    loop_place_label,
    read_loop_recordings,
    write_loop_recordings,
)
from ssm_study.study.stages.free_run import ModelRun

Experiment = tuple[LoopRuns, str]  # and the word for what it was done on
LOOPS = (ON_PLANT, ON_MODEL, NOISE_FREE, "comparison.csv")


def compute_loop(
    folder: Path,
    data: DataSet,
    model_run: ModelRun,
    design: Design,
    *,
    loop: LoopExperiment,
    loop_seed: int,
    plant: Any = None,
) -> Experiment | None:
    """Simulate the closed loop with the certified gains on the true plant, or on the identified
    model if there is no plant.

    None without gains, and where the model, in the place of a plant, answers its input at once: it
    is scored and certified.
    """
    import pandas as pd

    model = model_run.model
    if not design.feasible or (plant is None and has_direct_feedthrough(model)):
        return None
    twin = IdentifiedPlant.from_model(model, data.inputs, data.outputs)
    on = plant or twin
    loop_on = loop_place_label(plant)
    limited = loop.with_default_limits(data.training_inputs) if plant is None else loop
    experiment = limited.with_default_horizon(model)
    closed = experiment.run_design(on, model, design, loop_seed)
    about = {"loop_on": loop_on, "loop_seed": str(loop_seed)}
    write_loop_recordings(folder, closed, on, twin, about)
    if experiment.comparison is not None:
        identified = IdentificationResult.from_data_set(model, certified_balls(model), data)
        rows = experiment.comparison.rows(on, identified, experiment, loop_seed)
        # As objects: else whole numbers beside an empty field become fractions.
        table = pd.DataFrame(rows, dtype=object)
        table.to_csv(folder / "comparison.csv", index=False, lineterminator="\n")
    return closed, loop_on  # as `read_loop` reads it back, to the last bit


def read_loop(folder: Path) -> Experiment | None:
    """Read the stored closed-loop simulations of a run; None if no loop was closed, since the run
    has no controller or no observer."""
    return read_loop_recordings(folder) if (folder / ON_PLANT).is_file() else None


def loop_result_columns(
    experiment: Experiment | None, _data: DataSet, _model_run: ModelRun, design: Design
) -> Facts:
    """Table columns that describe a run's closed loop; empty if no loop was closed."""
    if experiment is None:
        return {}
    closed, loop_on = experiment
    return (
        {"loop_on": loop_on} | behaviour_columns(closed) | certified_bound_columns(closed, design)
    )


LOOP = Stage("loop", compute_loop, read_loop, loop_result_columns, LOOPS)
