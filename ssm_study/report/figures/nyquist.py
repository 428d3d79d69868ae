"""Nyquist curve of the loop broken at the plant's input, at the slopes of rest, with a disc of the
measured model error around each band: of the amplitude whose discs come nearest to -1. A disc that
holds -1 would mean that the records do not exclude an unstable loop."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the Nyquist curve of the best run's loop, with discs for the measured model error."""
    return draw_unstyled(picture_of_best("nyquist", study))
