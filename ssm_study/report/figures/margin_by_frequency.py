"""How many times larger the measured model error could be at each frequency before the loop is no
longer predicted stable. There is one line for each recorded amplitude, at the worst of the constant
slopes. The dot marks the stability margin of the design; if a curve falls below one, the loop is
not predicted stable."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the stability margin over frequency for the best run, with one line for each recorded
    amplitude."""
    return draw_unstyled(picture_of_best("margin_by_frequency", study))
