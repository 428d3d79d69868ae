# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Your own data to a certified controller
#
# You have a log: a column with what you applied, a column with what you measured, a sampling time. This notebook goes
# from there to a controller in C with its certificate. With no simulator of your plant the loop is closed on the
# identified model, and the record says so: **trying it on the plant remains to you**.

# %%
import os
from pathlib import Path

import numpy as np
import pandas as pd
from IPython.display import Image, Markdown, display

from ssm_study.cli import main
from ssm_study.report import figures
from ssm_study.report.study_folder import Study

RESULTS = Path(os.environ.get("SSM_STUDY_RESULTS", "results"))
STUDY = "your_own_data"

# %% [markdown]
# ## A log to play with
#
# Replace this cell by your own file. The stand-in is a heater with a soft saturation: 100 ms samples, steps of random
# height, a little sensor noise.

# %%
STEP_S = 0.1
rng = np.random.default_rng(0)
power = np.repeat(rng.uniform(-3, 3, 300), 8)
temperature = np.zeros(len(power))
for k in range(len(power) - 1):
    temperature[k + 1] = 0.93 * temperature[k] + 0.4 * (power[k] + 0.5 * np.tanh(power[k]))
temperature += 0.02 * rng.standard_normal(len(power))
log = RESULTS / "heater.csv"
RESULTS.mkdir(parents=True, exist_ok=True)
pd.DataFrame({"power": power, "temperature": temperature}).to_csv(log, index=False)

# %% [markdown]
# ## One command
#
# The slope floor matters most: it says how flat the input map may get, and with it which rates can be certified. A log
# that reaches both ends of the actuator lets you set it high.

# %%
request = [
    f"study={STUDY}",
    f"results_dir={RESULTS}",
    "data=recorded",
    f"data.path={log}",
    "data.input=power",
    "data.output=temperature",
    f"data.step_s={STEP_S}",
    "data.input_unit=W",
    "data.output_unit=K",
    "model.order=2",
    "model.slope_lower=0.3",
    "progress=false",
]
_ = main(["run", *request])

# %%
study = Study(folder=RESULTS / STUDY)
run = study.best
assert run is not None, "no run of this study left a model"
for name in ("validation_trajectory", "excitation", "closed_loop_responses"):
    png, _ = figures.draw([name], study.folder)
    display(Image(filename=str(png), retina=True), Markdown(f"*{figures.caption(name)}*"))

# %% [markdown]
# ## Take the controller away
#
# Dependency-free C, an ONNX cell, and a python-control system, each computing what the certified loop computes; the
# certificate lies beside them.

# %%
status = main(["export", str(run.path), "--to", str(RESULTS / "heater_controller")])
header = (RESULTS / "heater_controller" / "controller.h").read_text()
print("\n".join(header.splitlines()[:12]))

# %% [markdown]
# ## What a wrong request looks like
#
# One sentence with the field, the value and the remedy; exit status 2; before any training.

# %%
try:
    main(["run", *request, "data.input=voltage"])
except SystemExit as stop:
    print("exit status", stop.code)
