"""Stage that simulates a PI controller, tuned by a textbook rule from the model, on the plant."""

from pathlib import Path
from typing import Any

from ssm_study.durable import read_json
from ssm_study.engine.stages import Facts, Stage
from ssm_study.loop.regulation import LoopExperiment
from ssm_study.loop.textbook_pi import textbook_pi_columns
from ssm_study.study.stages.files import write_json
from ssm_study.study.stages.free_run import ModelRun

FILE = "textbook_pi.json"


def compute_textbook_pi(
    folder: Path, model_run: ModelRun, *, loop: LoopExperiment, loop_seed: int, plant: Any
) -> None:
    """Simulate a textbook PI controller from the same initial states as the certified design, and
    write its results."""
    facts = textbook_pi_columns(
        plant, model_run.model, loop.with_default_horizon(model_run.model), loop_seed
    )
    write_json(folder / FILE, facts)


def read_textbook_pi(folder: Path) -> Facts:
    """Read the stored results of the textbook PI controller."""
    return dict(read_json(folder / FILE))


def textbook_pi_result_columns(facts: Facts, *_: Any) -> Facts:
    """Table columns with the results of the textbook PI controller, which are stored in this
    form."""
    return facts


TEXTBOOK_PI = Stage(
    "textbook_pi", compute_textbook_pi, read_textbook_pi, textbook_pi_result_columns
)
