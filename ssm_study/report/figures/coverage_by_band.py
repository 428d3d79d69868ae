"""Model error that the proof tolerates, as a multiple of the measured one, in each frequency band.
There is one line for each record. Where a line falls below one, the proof does not cover the
record. A line ends where its record shows no error beyond noise. Sums over several bands must be
covered, too. If one of them decides, as "in total" in the title says, it is not drawn."""

from matplotlib.figure import Figure

from ssm_study.api.pictures.drawing import draw_unstyled
from ssm_study.report.run_pictures import picture_of_best_run
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    """Draw the ratio of tolerated to measured model error in each frequency band for the best
    run."""
    return draw_unstyled(picture_of_best_run("coverage_by_band", study))
