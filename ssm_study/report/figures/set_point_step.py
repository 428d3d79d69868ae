"""Response of the identified model's loop to a step of the set point, without noise: output with
settling band, and input. Dashed: the range of the recorded inputs. The step is half the output's
scale, or smaller if the recorded inputs cannot hold it. The loop knows the step in advance here;
the exported code does not, and responds later."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the response of the best run's loop to a step of the set point, on the identified
    model."""
    return draw_unstyled(picture_of_best("set_point_step", study))
