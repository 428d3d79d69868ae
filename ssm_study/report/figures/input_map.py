"""Input map S_u that the model learned (left) and its slope at each input (right). The certificate
holds for every map whose slopes lie in the shaded interval."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best_run
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the learned input map of the best run and its slope."""
    return draw_unstyled(picture_of_best_run("input_map", study))
