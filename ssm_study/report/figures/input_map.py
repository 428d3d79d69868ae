"""Learned input map S_u around rest (left) and its local slope (right). The shaded interval of
slopes is the one that the certificate assumes."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best_run
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the learned input map of the best run and its slope."""
    return draw_unstyled(picture_of_best_run("input_map", study))
