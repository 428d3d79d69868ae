"""From arrays to a certified loop and its C header, without a command, a run folder or Hydra.

`python examples/arrays_to_controller.py FOLDER` writes `FOLDER/controller.h` and two pictures.
"""

import sys
from pathlib import Path

import numpy as np

import ssm_study as st

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
rng = np.random.default_rng(0)
u = np.repeat(rng.uniform(-3, 3, 250), 8)  # what was applied, held for 8 samples
y = np.zeros(len(u))  # what was measured: here a tank-like plant with a saturating input
for k in range(len(u) - 1):
    y[k + 1] = 0.9 * y[k] + 0.2 * np.tanh(u[k])
y += 0.01 * rng.normal(size=len(y))

model = st.fit(u, y, 0.1, model="ssm", order=2, slopes=(0.05, 1.0), progress=False)
print(model)

design = st.control(model)
print(design)

loop = st.simulate(design, [-1.0, 1.0])
print(loop.groupby("case")["y"].last())

design.to_c(folder / "controller.h")
model.plot().savefig(folder / "free_run.png")
design.plot().savefig(folder / "loop.png")
