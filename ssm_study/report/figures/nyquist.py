"""Nyquist curve of the loop gain at the equilibrium, with a disc of the measured model error around
each frequency band. The loop is broken at the plant's input. The discs are those of the amplitude
that comes nearest to -1; if a disc contains -1, the records do not exclude an unstable loop."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the Nyquist curve of the best run's loop, with discs for the measured model error."""
    return draw_unstyled(picture_of_best("nyquist", study))
