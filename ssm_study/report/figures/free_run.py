"""Free run of the identified model on the test record, with its error below. Dots are measured, the
line is the model, which sees only the input. The fit is that of the whole record."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best_run
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the free run of the best run's model on the test record, beside the measured output."""
    return draw_unstyled(picture_of_best_run("free_run", study))
