# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Your own data: a log that cannot be trusted, and one that can
#
# You have a log: a column with what you applied, a column with what you measured, a sampling time.
# A model can be fitted to any log, and a controller with a certificate can be designed for any such
# model. Whether the controller works on the machine is another question, and the log decides it.
# This notebook takes two logs of one heater: one from ordinary operation, and one that was recorded
# for the purpose. The first gets no prediction, with the reasons and what to record instead. The
# second gets one, and it turns out right.

# %%
import os
from pathlib import Path

import numpy as np
import pandas as pd
from IPython.display import display

import ssm_study as st
from ssm_study import style
from ssm_study.cli.main import main
from ssm_study.refusal import BadRequest

RESULTS = Path(os.environ.get("SSM_STUDY_RESULTS", "results"))
RESULTS.mkdir(parents=True, exist_ok=True)
STEP_S = 0.1
SETTINGS = {"model": "ssm", "order": 2, "slopes": (0.3, 1.0)}


# %% [markdown]
# ## The heater
#
# It stands in for your machine: it cools by itself, its gain is twice as large around rest as far
# from it, and its sensor is noisy. Nothing below looks inside it; replace `power` and `temperature`
# by the columns of your own file.


# %%
def warmer(temperature: float, power: float, room: float = 0.0) -> float:
    """One sample of the heater, in degrees above the usual room."""
    return 0.93 * temperature + 0.4 * (power + 0.5 * np.tanh(power)) + 0.07 * room


noise = 0.02 * np.random.default_rng(1).standard_normal((2, 20_000))  # of the sensor, in each log


# %% [markdown]
# ## The log from ordinary operation
#
# Two minutes of ordinary operation: a thermostat switches the power between two levels, and the
# room warms and cools meanwhile, which nobody recorded.

# %%
room = 0.5 * np.random.default_rng(0).standard_normal(1200).cumsum()
power = np.full(1200, 0.3)
temperature = np.zeros(1200)
for k in range(1199):
    if not 0 < temperature[k] < 1:
        power[k] = -0.3 if temperature[k] >= 1 else 0.3
    elif k:
        power[k] = power[k - 1]
    temperature[k + 1] = warmer(temperature[k], power[k], room[k])
lying_around = pd.DataFrame({"power": power, "temperature": temperature + noise[0, :1200]})

model = st.fit(
    lying_around["power"], lying_around["temperature"], STEP_S, **SETTINGS, progress=False
)
poor = st.control(model)
print(poor)

# %% [markdown]
# A model was fitted, and the controller for it is certified. Is it to be trusted? The last line
# says no, and the record of the design says why:

# %%
reasons = poor.record["evidence_reasons"]
print(reasons.replace("doubt: ", "\ndoubt: ").replace("note: ", "\nnote: "))

# %% [markdown]
# The certificate holds, for a model that has nothing to do with the heater. The prediction is
# withheld, and every reason says what to do about it: the record is short, the output moves by
# something that is not in the log, the input says nothing beyond its two levels.
#
# ## The log that was made for the purpose
#
# `ssm-study excite` writes an input to apply: random levels over the whole range at three
# amplitudes, every period twice, and rest at both ends. Here it runs on the stand-in, in a room of
# constant temperature.

# %%
asked = "--lower -3 --upper 3 --rest 0 --step-s 0.1 --settle-s 5"  # what you know of your machine
_ = main(["excite", "--to", str(RESULTS / "input.csv"), *asked.split()])
power = pd.read_csv(RESULTS / "input.csv")["input"].to_numpy()
temperature = np.zeros(len(power))
for k in range(len(power) - 1):
    temperature[k + 1] = warmer(temperature[k], power[k])
recorded = pd.DataFrame({"power": power, "temperature": temperature + noise[1, : len(power)]})

model = st.fit(recorded["power"], recorded["temperature"], STEP_S, **SETTINGS, progress=False)
good = st.control(model)
print(good)

# %% [markdown]
# The evidence is sound, so a prediction is made. The notes say what this log does not show.

# %%
print(good.record["evidence_reasons"].replace("note: ", "\nnote: "))
model.plot()

# %%
good.margin_plot()

# %% [markdown]
# ## Was the verdict right?
#
# Both controllers now run on the heater itself, in a room of constant temperature, from the same
# five temperatures, within the heater's limits of ±3. With your own machine, this step is yours.


# %%
STARTS = (-8.0, -4.0, 2.0, 5.0, 9.0)
responses = {}
for log, design in {"ordinary operation": poor, "made for the purpose": good}.items():
    controller = design.to_control()  # what the exported controller computes, sample by sample
    for start in STARTS:
        temperature = np.full(100, start)
        state = np.zeros(controller.nstates)
        for k in range(99):
            measured = temperature[k : k + 1]
            applied = np.clip(controller.output(0, state, measured), -3, 3)[0]
            temperature[k + 1] = warmer(temperature[k], applied)
            state = controller.dynamics(0, state, measured)
        responses[log, start] = temperature

table = pd.DataFrame(responses, index=pd.Index(STEP_S * np.arange(100), name="Time (s)"))
with style.paper_style():
    figure = style.new_figure(style.PAGE_IN, 2.2)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, log in zip(panels, ("ordinary operation", "made for the purpose"), strict=True):
        table[log].plot(ax=axes, color=style.BLUE, legend=False, title=f"From the log: {log}")
    panels[0].set_ylabel("Temperature above rest (K)")
    display(figure)

# %% [markdown]
# Both controllers carry a certificate, and each aims at the equilibrium of its own records. The
# verdict on the evidence told them apart before either was tried.
#
# ## Export the controller
#
# Dependency-free C; `ssm-study export` also writes an ONNX cell and a python-control system, each
# computing what the certified loop computes, and the certificate beside them.

# %%
header = good.to_c(RESULTS / "controller.h").read_text()
print("\n".join(header.splitlines()[:9]))

# %% [markdown]
# ## What a wrong request looks like
#
# One sentence with the field, the value and the remedy, before any training.

# %%
try:
    st.fit(recorded["power"], recorded["temperature"], STEP_S, "model.order=0")
except BadRequest as refusal:
    print(refusal)
