"""Poles of the model, the controlled model and the observer error, linearised at the equilibrium.
The solid circle is the unit circle. The dashed circle is the contraction per sample that is proved
under control, for every certified slope."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best_run
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the poles of the best run's model, of the model under control, and of the observer's
    error."""
    return draw_unstyled(picture_of_best_run("loop_poles", study))
