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
# A model can be
# fitted to any log, and a controller with a certificate can be designed for any such model. Whether
# the controller
# works on the machine is another question, and the log decides it. This notebook takes two logs of
# one heater: one
# from ordinary operation, and one that was recorded for the purpose. The first gets no prediction,
# with the reasons
# and what to record instead. The second gets one, and it turns out right.

# %%
import os
import re
from pathlib import Path

import numpy as np
import pandas as pd
from IPython.display import Image, display

import ssm_study as st
from ssm_study import style
from ssm_study.cli.main import main
from ssm_study.refusal import BadRequest

RESULTS = Path(os.environ.get("SSM_STUDY_RESULTS", "results"))
RESULTS.mkdir(parents=True, exist_ok=True)
STEP_S = 0.1
SETTINGS = ("model.order=2", "model.slope_lower=0.3", "training.max_epochs=60")


# %% [markdown]
# ## The heater
#
# It stands in for your machine: it cools by itself, its gain is twice as large around rest as far
# from it, and its
# sensor is noisy. Nothing below looks inside it; replace `power` and `temperature` by the columns
# of your own file.


# %%
def warmer(temperature: float, power: float, room: float = 0.0) -> float:
    """One sample of the heater, in degrees above the usual room."""
    return 0.93 * temperature + 0.4 * (power + 0.5 * np.tanh(power)) + 0.07 * room


def sensor(temperature: np.ndarray, seed: int) -> np.ndarray:
    return temperature + 0.02 * np.random.default_rng(seed).standard_normal(len(temperature))


# %% [markdown]
# ## The log from ordinary operation
#
# Two minutes of ordinary operation: a thermostat switches the power between two levels, and the
# room warms and cools
# meanwhile, which nobody recorded.

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
lying_around = pd.DataFrame({"power": power, "temperature": sensor(temperature, seed=1)})

model = st.fit(
    lying_around["power"], lying_around["temperature"], STEP_S, *SETTINGS, progress=False
)
poor = st.control(model)


# %% [markdown]
# A model was fitted, and the controller for it is certified. Is it to be trusted?


# %%
def verdict(design: st.Design) -> None:
    """What is proved, what is predicted, and why."""
    record = design.record
    prediction = {True: "stays stable", False: "not predicted to be stable", None: "withheld"}
    print(f"certified for its model   {design.certificate.certified}")
    print(f"fit on the test record    {record['fit_test_percent']:.1f} %")
    print(f"evidence                  {record['evidence']}")
    print(f"prediction for the plant  {prediction[record['predicted_stable']]}")
    print(re.sub(r"(cannot judge|doubt|note): ", r"\n  \1: ", record["evidence_reasons"]))


verdict(poor)

# %% [markdown]
# No. The certificate holds, for a model that has nothing to do with the heater. The prediction is
# withheld, and every
# reason says what to do about it: the record is short, the output moves by something that is not in
# the log, the
# input says nothing beyond its two levels.
#
# ## The log that was made for the purpose
#
# `ssm-study excite` writes an input to apply: random levels over the whole range at three
# amplitudes, every period
# twice, and rest at both ends. Here it runs on the stand-in, in a room of constant temperature.

# %%
asked = "--lower -3 --upper 3 --rest 0 --step-s 0.1 --settle-s 5"  # what you know of your machine
_ = main(["excite", "--to", str(RESULTS / "input.csv"), *asked.split()])
power = pd.read_csv(RESULTS / "input.csv")["input"].to_numpy()
temperature = np.zeros(len(power))
for k in range(len(power) - 1):
    temperature[k + 1] = warmer(temperature[k], power[k])
recorded = pd.DataFrame({"power": power, "temperature": sensor(temperature, seed=2)})

model = st.fit(recorded["power"], recorded["temperature"], STEP_S, *SETTINGS, progress=False)
good = st.control(model)
verdict(good)

# %% [markdown]
# The evidence is sound, so a prediction is made. The notes remain: they say what this log does not
# show.

# %%
model.plot()

# %%
good.margin_plot()

# %% [markdown]
# ## Was the verdict right?
#
# Both controllers now run on the heater itself, in a room of constant temperature, from the same
# five temperatures,
# within the heater's limits of ±3. With your own machine, this step is yours.


# %%
def on_the_heater(design: st.Design, start: float, samples: int = 100) -> np.ndarray:
    """The temperature under control, sample by sample, as the exported controller computes it."""
    controller = design.to_control()
    temperature = np.full(samples, start)
    state = np.zeros(controller.nstates)
    for k in range(samples - 1):
        applied = float(np.clip(controller.output(0, state, temperature[k : k + 1])[0], -3, 3))
        temperature[k + 1] = warmer(temperature[k], applied)
        state = controller.dynamics(0, state, temperature[k : k + 1])
    return temperature


with style.paper_style():
    figure = style.new_figure(style.PAGE_IN, 2.2)
    first, second = figure.subplots(1, 2, sharey=True)
    for axes, design, title in (
        (first, poor, "From the log of ordinary operation"),
        (second, good, "From the log made for the purpose"),
    ):
        for start in (-8.0, -4.0, 2.0, 5.0, 9.0):
            axes.plot(STEP_S * np.arange(100), on_the_heater(design, start), color=style.BLUE)
        axes.set(title=title, xlabel="Time (s)")
    first.set_ylabel("Temperature above rest (K)")
    png, _ = style.save_figure(figure, RESULTS / "figures", "two_logs")
display(Image(filename=str(png), retina=True))

# %% [markdown]
# Both controllers carry a certificate, and each aims at the equilibrium of its own records. The
# verdict on the evidence
# told them apart before either was tried.
#
# ## Export the controller
#
# Dependency-free C; `ssm-study export` also writes an ONNX cell and a python-control system, each
# computing what the
# certified loop computes, and the certificate beside them.

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
