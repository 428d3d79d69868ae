"""From input-output data of a nonlinear system to a certified output-feedback controller.

    import ssm_study as st

    model = st.fit(u, y, step_s)       # arrays, series or frames, one per record
    print(model)                       # fit on the test record, states, slopes, evidence
    st.compare([model, st.fit(u, y, step_s, model="arx")], u, y).plot()   # beside a baseline
    design = st.control(model)         # controller, observer; design.certified is True or False
    design.to_c("controller.h")        # C99; design.save(folder), model.save(folder)
    st.load(folder)                    # the saved design or model

    st.certify(A, B, C, K=K, L=L, slopes=(0.8, 1.2))   # the largest provable rate of your gains
    st.simulate(model, u)              # or a loop from initial outputs: st.simulate(design, y0)
    st.look("log.csv")                 # what is in a log
    st.study("experiment=paper")       # the table of a study, as `ssm-study run` makes it
    st.Estimator(step_s=step_s)        # for scikit-learn's searches

The model is `x+ = A x + B S_u(u)`, `y = S_y(C x)` with `model="ssm"`, which takes seconds: S_u and
S_y are learned maps of each input and output. With `model="structured"` neurons w stand inside the
recurrence: `x+ = A x + B v + E w`, `w = phi(F x + G v + bias) - phi(bias)`, `y = S_y(C x + D v +
H w)`, `v = S_u(u)`, every slope of phi from 0 to 1. By default `fit` compares a dozen or more such
models on folds of the records, which takes minutes; `help(st.fit)` lists all kinds, what each takes
and what its result answers. Pictures are Matplotlib figures: `model.plot()`, `bode()`,
`residuals()`, `poles()`, `input_map()`; `design.plot()`, `step()`, `margin_plot()`,
`coverage_plot()`, `nyquist()`, `poles()`.

A certified rate `rho` is proved for the model: distances, in the metric of the certificate, are
multiplied by at most `sqrt(1 - rho)` each sample, between two trajectories of the state feedback
`u = K x` and from the observer's estimate to the state (Theorems 1 and 2 of Zakwan et al., arXiv
2604.07069, called [Z26]; `help(st.GainCertificate)` has the inequalities). The proof supposes that
every slope of S_u and S_y lies in the stated range, at any amplitude, that the observer computes
the plant's own S_u and S_y, and that no limit clamps the input. Gains come from Riccati equations
or a solver of matrix inequalities, verdicts from rational arithmetic on the stored numbers.

Of the loop of both, `u = K xh`, it follows that the model comes to rest: the error of the observer
shrinks by itself and enters the state feedback with a bounded gain. `certified`, of `st.control`
and `st.certify` alike, says whether controller, observer and this loop are proved; `verdicts` has
them by name. The loop is not proved where the observer cannot compute the plant's own S_u and S_y.

Two entries are about the plant: `design.record["predicted_stable"]`, a prediction near the recorded
amplitudes (None where the records allow none), and `design.record["coverage"]`, the model error
that the proof covers over the error that the records show (below one nothing is covered). That
error, plant minus model, is compared by frequency with the output and the input of the model, at
each recorded amplitude; from one on the loop comes to rest on every plant whose error stays within.
Amplitudes, frequencies and starts that no record visits stay unproved.
`coverage_needed` is the error that the test record shows over the error that the other records
show; the test record is covered too where `coverage` is at least as large. A fit of 100 % is a
perfect free run. A wrong request raises `st.BadRequest` in one sentence, before any long
work.
"""

import os
from importlib import import_module
from typing import Any

from ssm_study import renamed

__version__ = "0.2.0"
# Where each public name is defined; importing the package itself loads nothing.
_PUBLIC = {
    "BadRequest": "refusal",
    "Certification": "api.certifying",
    "Design": "api.design",
    "Estimator": "api.estimator",
    "GainCertificate": "api.certifying",
    "Model": "api.model",
    "ModelComparison": "api.comparing",
    "RestDesign": "api.rest_design",
    "certify": "api.certifying",
    "compare": "api.comparing",
    "control": "api.controlling",
    "fit": "api.fitting",
    "load": "api.loading",
    "look": "api.looking",
    "simulate": "api.simulation",
}
__all__ = [*_PUBLIC, "study"]

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def __getattr__(name: str) -> Any:
    """Import a public name from the module that defines it."""
    if name in _PUBLIC:
        limit_threads()
        return getattr(import_module(f"{__name__}.{_PUBLIC[name]}"), name)
    if name == "study":  # both the room and, called, the function
        limit_threads()
        return import_module(f"{__name__}.study")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)


def limit_threads() -> None:
    """Set torch and BLAS to one thread each, unless environment variables already set the number of
    threads.

    Before torch is imported: several processes with as many threads as cores are 20 times slower.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # idle threads sleep instead of spinning
    for variable in THREADS:
        os.environ.setdefault(variable, "1")


def save_as_run(design: Any, folder: Any) -> Any:
    """Save a controller design as the run folder that `ssm-study run` would write for the same
    settings.

    The package knows both its Python functions and its command; neither imports the other.
    """
    return import_module(f"{__name__}.cli.from_python").save_design_as_run(design, folder)


renamed.install_import_hook()
