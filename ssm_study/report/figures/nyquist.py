"""Nyquist curve of the loop broken at the plant's input, with discs of the measured model error.
The slopes are those at rest. The discs belong to the amplitude that comes nearest to -1. Each lies
where the record puts its frequency band, beside the curve where the error has a steady part. If a
disc contains -1, the records do not exclude an unstable loop."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best_run
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the Nyquist curve of the best run's loop, with discs for the measured model error."""
    return draw_unstyled(picture_of_best_run("nyquist", study))
