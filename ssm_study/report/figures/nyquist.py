"""Nyquist curve of the loop broken at the plant's input, with discs of the measured model error.
The slopes are those at rest. Each disc holds the error in one frequency band, at the amplitude
whose discs come nearest to -1. Its centre lies off the curve where a part of the error has a steady
phase. If a disc contains -1, the records do not exclude an unstable loop."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best_run
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the Nyquist curve of the best run's loop, with discs for the measured model error."""
    return draw_unstyled(picture_of_best_run("nyquist", study))
