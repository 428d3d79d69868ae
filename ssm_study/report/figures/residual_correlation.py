"""Correlation of the free run's error on the test record with itself and with each input. White
noise would stay in the grey band at 95 % of the lags. Outside it the error still contains structure
that the model could explain. A free run of a nonlinear plant rarely stays inside."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best_run
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the correlations of the best run's simulation error with itself and with the inputs."""
    return draw_unstyled(picture_of_best_run("residual_correlation", study))
