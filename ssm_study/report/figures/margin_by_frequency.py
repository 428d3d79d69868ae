"""Stability margin by frequency, with one line for each recorded amplitude of the input. The margin
is the factor by which the measured model error could grow before the prediction of stability is
lost, at the worst constant slope. Where a line falls below one, the loop is not predicted to be
stable. A line ends where its records show no model error, for instance where the input has no
power."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best_run
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the stability margin over frequency for the best run, with one line for each recorded
    amplitude."""
    return draw_unstyled(picture_of_best_run("margin_by_frequency", study))
