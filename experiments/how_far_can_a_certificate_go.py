# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # How far can a certificate go?
#
# Theorem 1 certifies a contraction rate ρ if a linear matrix inequality has a solution. How large
# can ρ be?
# No solver is needed to know. With r = √(1 − ρ), one input, and slopes of `S_u` in [μ, ν],
#
# > feasible  ⟺  (ν − μ) / (ν + μ)  <  ∏ r / |λᵢ(A)|  over all eigenvalues with |λᵢ(A)| > r.
#
# This notebook draws that frontier, puts controllers on both sides of it, and tries to cheat the
# verification.

# %%
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
from IPython.display import display

from ssm_study import style
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Infeasible
from ssm_study.certificates.frontier import controller_frontier
from ssm_study.cli.main import main
from ssm_study.report.study_folder import StudyFolder
from ssm_study.study.verify import verify
from ssm_study.synthesis.minimum_energy import ClosedFormSynthesis
from ssm_study.systems import JacobianBall

EXPERIMENT = os.environ.get(
    "SSM_STUDY_EXPERIMENT", "paper"
)  # CI runs `smoke`: the same steps, tiny
RESULTS = Path(os.environ.get("SSM_STUDY_RESULTS", "results"))

_ = main(["run", f"experiment={EXPERIMENT}", f"results_dir={RESULTS}", "progress=false"])
run = StudyFolder(folder=RESULTS / EXPERIMENT).best_run
assert run is not None
assert run.model is not None
linear = run.model.linear

# %% [markdown]
# ## The frontier, and the solver-free verdict on both sides of it
#
# For each slope ratio μ/ν the line is the exact limit. Controllers are requested 1, 10 and 20 %
# below it, and as much above it. Below, the closed-form gain is checked in exact rational
# arithmetic; above, the request is refused with the number that decides.

# %%
ratios = np.geomspace(0.02, 0.95, 12)
limits = np.array(
    [
        controller_frontier(linear, JacobianBall.from_slopes(ratio, 1.0)).rate_limit
        for ratio in ratios
    ]
)
verdicts = []
for ratio, limit in zip(ratios, limits, strict=True):
    for share in (0.8, 0.9, 0.99, 1.01, 1.1, 1.2):
        rate = limit * share
        if not 0 < rate < 1:
            continue
        synthesis = ClosedFormSynthesis(rate_controller=rate, rate_observer=0.1)
        part = synthesis.state_feedback(linear, JacobianBall.from_slopes(ratio, 1.0))
        verdicts.append((ratio, rate, not isinstance(part, Infeasible) and part.certified))

table = pd.DataFrame(verdicts, columns=["ratio", "rate", "certified"])
certified = table[table["certified"]]
refused = table[~table["certified"]]
print(f"{len(certified)} certified, {len(refused)} refused")

with style.paper_style():
    figure = style.new_figure(style.COLUMN_IN, 2.4)
    axes = figure.add_subplot()
    axes.semilogx(ratios, limits, color=style.INK, lw=0.8, label="exact frontier")
    look = {"ls": "", "ms": 3}
    axes.plot("ratio", "rate", "o", data=certified, color=style.BLUE, label="certified", **look)
    axes.plot("ratio", "rate", "x", data=refused, color=style.VERMILLION, label="refused", **look)
    style.place_legend_above(axes, columns=3)
    axes.set_xlabel("Slope ratio of S$_u$, smallest / largest (–)")
    axes.set_ylabel("Controller rate, ρ (1/sample)")
    display(figure)

# %% [markdown]
# ## What does a rate cost?
#
# The gain, on this run's own model and slopes, as the rate approaches its limit. A certificate is a
# statement about the *model*: it does not say how large a gain the plant bears.

# %%
ball = certified_balls(run.model).input
limit = controller_frontier(linear, ball).rate_limit
for share in (0.1, 0.5, 0.9, 0.99, 0.999):
    part = ClosedFormSynthesis(rate_controller=limit * share, rate_observer=0.1).state_feedback(
        linear, ball
    )
    if isinstance(part, Infeasible):
        print(f"{share:6.1%} of the limit: {part.reason}")
    else:
        print(
            f"{share:6.1%} of the limit: |K| = {part.gain_norm:10.3g}, certified {part.certified}"
        )

# %% [markdown]
# ## Trying to cheat
#
# Change one entry of the stored gain in the third digit and verify again. `verify` reads the files
# alone.

# %%
findings = verify(run.path)
print(f"as stored: {sum(finding.holds for finding in findings)} of {len(findings)} claims hold")

forged = RESULTS / "forged"
shutil.rmtree(forged, ignore_errors=True)
shutil.copytree(run.path, forged)
certificate = json.loads((forged / "certificate.json").read_text())
certificate["state_feedback"]["k"][0][0] *= 1.01
(forged / "certificate.json").write_text(json.dumps(certificate))
for finding in verify(forged):
    if not finding.holds:
        print(finding)
shutil.rmtree(forged)
