"""How much of the heater the best run's controller used: the share of samples at each duty. A bar
at an end means that
the loop ran into a limit."""

from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.report.study_folder import StudyFolder


def draw(study: StudyFolder) -> Figure:
    (loop,) = study.read_from_best("closed_loop", otherwise="No run reached the closed loop.")
    fig = style.new_figure(style.COLUMN_IN, 2.1)
    axes = fig.add_subplot()
    axes.hist(loop["input"].ravel(), bins=40, color=style.BLUE)
    axes.set(xlabel=loop.label("input"), ylabel="Samples (1)")
    return fig
