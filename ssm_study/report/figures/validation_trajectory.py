"""Test and validation record: measured output, and the identified model's free-run simulation from
the same input."""

from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.report.study_folder import StudyFolder

LONGEST = 1200  # samples; a longer record would be a solid block of ink in a column


def draw(study: StudyFolder) -> Figure:
    *parts, record = study.of_best(
        "test", "validation", "record", otherwise="No run left a validation record."
    )
    fig = style.canvas(style.COLUMN_IN, 4.4)
    panels = fig.subplots(3, 1, height_ratios=[1.6, 1.6, 1.2])
    for panel, name, part in zip(panels, ("test", "validation"), parts, strict=False):
        time_s, fit = part.time_s("measured")[:LONGEST], record.get(f"fit_{name}_percent")
        y, simulated = (part[signal][0, :LONGEST, 0] for signal in ("measured", "simulated"))
        panel.plot(time_s, y, color=style.GREY, lw=0.7, label=f"{name} record")
        told = "model" if fit is None else f"model (fit {fit:.1f} % on the whole record)"
        panel.plot(time_s, simulated, color=style.BLUE, lw=1.2, label=told)
        style.above(panel, columns=2)
        panel.set(xlabel="Time (s)", ylabel=part.label("measured"), xlim=(time_s[0], time_s[-1]))
    panels[-1].step(time_s, part["input"][0, :LONGEST, 0], where="post", color=style.INK, lw=0.7)
    panels[-1].set(xlabel="Time (s)", ylabel=part.label("input"), xlim=(time_s[0], time_s[-1]))
    fig.align_ylabels()
    return fig
