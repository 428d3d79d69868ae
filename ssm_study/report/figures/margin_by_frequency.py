"""How much larger the measured model error could be at each frequency before the prediction of
stability is lost: one line for each recorded amplitude, at the worst of the constant slopes. The
dot is where the design's margin is decided; below the line at one nothing is predicted."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the stability margin over frequency for the best run, with one line for each recorded
    amplitude."""
    return draw_unstyled(picture_of_best("margin_by_frequency", study))
