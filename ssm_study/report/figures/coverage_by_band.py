"""Model error that the proof tolerates in each frequency band, as a multiple of the measured one.
There is one line for each record. Below the line at one the proof does not cover the record; the
dot marks the band that decides, crosses are bands in which the input has no power, so that noise
counts as error."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw, for the best run, how many times the measured model error the proof tolerates in each
    frequency band."""
    return draw_unstyled(picture_of_best("coverage_by_band", study))
