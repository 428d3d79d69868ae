"""Validation record: measured output, and the identified model's free-run simulation from the same input."""

from matplotlib.figure import Figure

from ssm_study.report import style
from ssm_study.report.study_folder import StudyFolder

LONGEST = 1200  # samples; a longer record would be a solid block of ink in a column


def draw(study: StudyFolder) -> Figure:
    validation, record = study.of_best("validation", "record", otherwise="No run left a validation record.")
    fig = style.canvas(style.COLUMN_IN, 3.0)
    output, given = fig.subplots(2, 1, sharex=True, height_ratios=[1.6, 1])
    u, y, simulated = (validation[name][0, :LONGEST, 0] for name in ("input", "measured", "simulated"))
    time_s, fit = validation.time_s("measured")[:LONGEST], record.get("fit_validation_percent")
    output.plot(time_s, y, color=style.GREY, lw=0.7, label="measured")
    name = "model" if fit is None else f"model (fit {fit:.1f} % on the whole record)"
    output.plot(time_s, simulated, color=style.BLUE, lw=1.2, label=name)
    style.above(output, columns=2)
    output.set_ylabel(validation.label("measured"))
    given.step(time_s, u, where="post", color=style.INK, lw=0.7)
    given.set(xlabel="Time (s)", ylabel=validation.label("input"), xlim=(time_s[0], time_s[-1]))
    fig.align_ylabels()
    return fig
