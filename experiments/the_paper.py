# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # The paper in one notebook
#
# *Controller Design for Structured State-space Models via Contraction Theory* (Zakwan, Gupta,
# Karimi, Balta, Ferrari-Trecate; arXiv 2604.07069): a nonlinear motor is identified from data as a
# structured state-space model `x⁺ = A x + B S_u(u)`, `y = S_y(C x)`; a state feedback and an
# observer are designed for the model with a certificate of contraction; both are then put on the
# *simulated* motor.
#
# Everything below is the command `ssm-study run experiment=paper` and a look at what it leaves.

# %%
import json
import os
from pathlib import Path

from ssm_study.cli.main import main
from ssm_study.report import figures
from ssm_study.report.study_folder import StudyFolder

EXPERIMENT = os.environ.get(
    "SSM_STUDY_EXPERIMENT", "paper"
)  # CI runs `smoke`: the same steps, tiny
RESULTS = Path(os.environ.get("SSM_STUDY_RESULTS", "results"))

_ = main(["run", f"experiment={EXPERIMENT}", f"results_dir={RESULTS}", "progress=false"])

# %% [markdown]
# ## What the run left
#
# A table with one row, and a folder whose files are enough to rebuild every claim.

# %%
study = StudyFolder(folder=RESULTS / EXPERIMENT)
run = study.best_run
assert run is not None, "no run of this study left a model"
print("\n".join(sorted(path.name for path in run.path.iterdir())))

# %% [markdown]
# ## Identification
#
# Training did not see the validation record. The model simulates it freely: it sees the input,
# never a measured output.

# %%
print(f"fit on the noise-free test record: {run.record['fit_test_percent']:.1f} %")
figures.captioned_figure("validation_trajectory", study)

# %% [markdown]
# What did the network learn of the motor? Its input map, scaled to volts, over the true dead-zone.
# The certificate needs its slopes away from zero, so it cannot follow the flat part to the end: the
# **slope floor** is the price of being able to certify anything.

# %%
figures.captioned_figure("learned_dead_zone", study)

# %% [markdown]
# ## Certificate
#
# Three rates for each side. The first is proved for the gains in use, and the picture shows it as
# `r = sqrt(1 - rate)`. The second is the rate for which `synthesis=auto` designed these gains, and
# the third the largest that *any* gains can have, from eigenvalues and slopes.
# `certified` is the verdict of exact rational arithmetic on the stored matrices, not a solver's
# status.

# %%
certificate = run.certificate
assert certificate is not None
for side in ("state_feedback", "observer"):
    part = certificate[side]
    rates = f"rate {part['certified_rate']:.3f}, designed for {part['rate']:.3f}"
    rates = f"{rates}, at most {part['rate_limit']:.3f}"
    print(f"{side:15} {rates}, certified: {part['certified']}")
figures.captioned_figure("certified_decay", study)

# %% [markdown]
# ## The simulated motor
#
# Ten initial speeds, measured with noise, controlled through the observer; beside them the same
# starts without control.

# %%
controlled, alone = (run.record[f"settling_time_{name}_s"] for name in ("mean", "open_loop"))
print(f"settled: {run.record['stable_count']} of {run.record['initial_conditions']}")
print(f"mean settling time: {controlled:.3f} s, uncontrolled {alone:.3f} s")
figures.captioned_figure("closed_loop_responses", study)

# %% [markdown]
# ## Check it
#
# `verify` recomputes every number of the run from its files. The exit status is 0 only if all of
# them agree.

# %%
status = main(["verify", str(run.path)])
print("exit status", status)

# %%
print(json.dumps({k: run.record[k] for k in ("git_commit", "version_torch", "seconds")}, indent=1))
