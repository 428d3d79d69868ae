"""Frequency response of the model at its equilibrium, beside an estimate from the validation
record. Dots are that estimate, made without any model: they stand where the input has power and the
output follows it. The shaded gains are those that the slopes of the input map allow. The dashed
line is the model at the mean gain of its input map over the record, and should meet the dots. Shown
is the first input to the first output, in physical units."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best_run
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the frequency response of the best run's model at its equilibrium, beside an estimate
    from the validation record."""
    return draw_unstyled(picture_of_best_run("frequency_response", study))
