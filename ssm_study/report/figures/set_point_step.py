"""Step of the set point on the identified model, without noise: output, settling band and input,
the range of the recorded inputs dashed. The step is half the output's scale, or less where the
recorded inputs cannot hold so much. It is known in advance here; the exported code, which hears of
a step when it comes, answers later."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the response of the best run's loop to a step of the set point, on the identified
    model."""
    return draw_unstyled(picture_of_best("set_point_step", study))
