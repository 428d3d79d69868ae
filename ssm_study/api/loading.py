"""Load a saved design or a saved model from a folder."""

from pathlib import Path

from ssm_study.api.design import Design
from ssm_study.api.model import Model
from ssm_study.api.model_files import holds_saved_model
from ssm_study.api.rest_design import RestDesign, holds_rest_design
from ssm_study.api.systems import read_path


def load(folder: str | Path) -> Design | RestDesign | Model:
    """Load a saved design, a saved model, or the controller of a study's run from its folder.

    What `design.save(folder)` or a run wrote becomes a `Design`, what `model.save(folder)` wrote a
    `Model` with its records, ready for `st.simulate` and `st.control`. Raises `BadRequest` where
    there is neither.
    """
    folder = read_path("folder", folder)
    if holds_saved_model(folder):
        return Model.load(folder)
    if holds_rest_design(folder):
        return RestDesign.load(folder)
    return Design.load(folder)
