"""Frequency response of the model at its equilibrium (line) and as estimated from the validation
record alone (dots). Dots are averaged cross spectra, where the input has power and output and input
are coherent. Shaded: gains that the slopes of the input map allow. First input to first output, in
physical units."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the frequency response of the best run's model at its equilibrium, beside an estimate
    from the validation record."""
    return draw_unstyled(picture_of_best("frequency_response", study))
