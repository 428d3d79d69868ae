"""Free run of the identified model on the test record (top; its error below) and on the validation
record: measured output as dots, the model on top, and the input that both had."""

from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.report.study_folder import StudyFolder

LONGEST = 1200  # samples; a longer record would be a solid block of ink in a column


def draw(study: StudyFolder) -> Figure:
    *parts, record = study.of_best(
        "test", "validation", "record", otherwise="No run left a validation record."
    )
    fig = style.canvas(style.COLUMN_IN, 5.0)
    axes = fig.subplots(4, 1, height_ratios=[1.6, 0.8, 1.6, 1.1])
    for panel, name, part in zip((axes[0], axes[2]), ("test", "validation"), parts, strict=True):
        time_s = part.time_s("measured")[:LONGEST]
        y = part["measured"][0, :LONGEST, 0]
        simulated = part["simulated"][0, :LONGEST, 0]
        fit = record.get(f"fit_{name}_percent")
        label = "model" if fit is None else f"model (fit {fit:.1f} % on the whole record)"
        panel.plot(time_s, y, ".", ms=1.5, color=style.GREY, label=f"{name} record")
        panel.plot(time_s, simulated, color=style.BLUE, lw=1.0, label=label)
        style.above(panel, columns=2)
        panel.set(xlabel="Time (s)", ylabel=part.label("measured"), xlim=(time_s[0], time_s[-1]))
        if name == "test":
            axes[1].axhline(0, color=style.PALE)
            axes[1].plot(time_s, y - simulated, color=style.VERMILLION, lw=0.7)
            unit = part.label("measured").rpartition("(")[2]
            axes[1].set(xlabel="Time (s)", ylabel=f"Error ({unit}", xlim=(time_s[0], time_s[-1]))
    axes[3].step(time_s, part["input"][0, :LONGEST, 0], where="post", color=style.INK, lw=0.7)
    axes[3].set(xlabel="Time (s)", ylabel=part.label("input"), xlim=(time_s[0], time_s[-1]))
    fig.align_ylabels()
    return fig
