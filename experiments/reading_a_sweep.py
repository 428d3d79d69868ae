# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Reading a sweep
#
# One run says little. This notebook sweeps the slope floor (`model.slope_lower`, the least slope
# that the input map may have) and the controller rate. Then it asks the table which run is best, up
# to which rate a certificate exists, and whether the prediction holds (words: `docs/glossary.md`).

# %%
import os
from pathlib import Path

from IPython.display import Markdown, display

from ssm_study.cli.main import main
from ssm_study.report import figures
from ssm_study.report.answers import question_answers
from ssm_study.report.page.writing import write_page
from ssm_study.report.study_folder import StudyFolder
from ssm_study.report.words import INFEASIBLE, printed_column_name, verdict_words
from ssm_study.table.rank import sort_best_first

EXPERIMENT = os.environ.get(
    "SSM_STUDY_EXPERIMENT", "paper"
)  # CI runs `smoke`: the same steps, tiny
RESULTS = Path(os.environ.get("SSM_STUDY_RESULTS", "results"))
STUDY = "reading_a_sweep"

SWEEP = [
    "model.slope_lower=0.01,0.2",
    "synthesis=riccati",
    "synthesis.rate_controller=0.1,0.365",
    "synthesis.rate_observer=0.2",
]
WHERE = [f"study={STUDY}", f"results_dir={RESULTS}", "progress=false"]
_ = main(["run", "-m", f"experiment={EXPERIMENT}", *WHERE, *SWEEP])

# %% [markdown]
# There are four runs, but only two trainings: both rates use the same model. The table has a row
# for each run, **failed and infeasible ones included**. A number that a run does not have is
# missing, never zero.

# %%
study = StudyFolder(folder=RESULTS / STUDY)
table = sort_best_first(study.table).assign(verdict=verdict_words(study.table))
seen = ["verdict", "slope_lower", "rate_controller", "controller_rate_limit"]
seen += ["resolved_margin", "stable_count", "settling_time_mean_s"]
shown = table[seen].round(4).set_index(table.run.str.rsplit("-", n=1).str[-1].rename("run"))
shown.rename(columns={name: printed_column_name(name) for name in seen})

# %% [markdown]
# ## The questions, answered from the table

# %%
for answer in question_answers(study.table):
    display(Markdown(f"**{answer.question}** {' '.join(answer.sentences)}"))

# %% [markdown]
# ## Where feasibility ends
#
# Each model has its own exact limit of the rate (the bar), which follows from the eigenvalues of A
# and from the ratio of the smallest to the largest slope of its input map. A larger slope floor
# raises it. A rate above the bar is infeasible, whatever the solver.

# %%
figures.captioned_figure("feasibility_map", study)

# %% [markdown]
# ## Why is a run infeasible?
#
# The record of the run gives the reason, the number that decides, and what to change.

# %%
infeasible = table[table.verdict == INFEASIBLE.word]
for _, row in infeasible.iterrows():
    print(row.run, "-", row.get("infeasible_reason"))

# %% [markdown]
# ## The same, with a mouse
#
# The report page is one file, which opens from disk. Select runs in one plot with the mouse, and
# the other plots follow; click a point to see its run.

# %%
page = write_page(study.folder)
print(f"open {page} ({page.stat().st_size / 1e6:.1f} MB) in a browser")
