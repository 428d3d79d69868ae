"""Step of the set point on the identified model, without noise: output (top) and input (bottom).
The settling band is shaded, set point and range of the recorded inputs are dashed. The step is half
the output's scale, or smaller if the recorded inputs cannot hold it. Where the title calls it known
in advance, the input moves before the step. The exported code learns of a step when it comes, and
so answers later."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best_run
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the response of the best run's loop to a step of the set point, on the identified
    model."""
    return draw_unstyled(picture_of_best_run("set_point_step", study))
