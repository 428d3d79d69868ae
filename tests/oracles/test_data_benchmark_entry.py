"""Our models stand in other people's tables by the lines of docs/data.md."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal

pytestmark = pytest.mark.data

ENTRY_OVERRIDES = (
    "model=ssm",
    "model.order=1",
    "model.hidden_width=4",
    "training.max_epochs=20",
    "data.equilibrium=zero",
)


def run_blocks_of_the_page() -> dict:
    """The names that the titled code blocks of docs/data.md define."""
    root = Path(__file__).parents[2]
    page = (root / "docs" / "data.md").read_text()
    titled_block = r'^```python title="\w+\.py"\n(.*?)^```'
    names: dict = {}
    for block in re.findall(titled_block, page, re.M | re.S):
        exec(block, names)
    return names


def test_our_models_stand_in_other_people_s_tables_by_the_lines_of_the_page() -> None:
    """A lag as a record of the package's own type, and as a sequence of the other's."""
    official = pytest.importorskip("nonlinear_benchmarks.utilities", reason="extra benchmarks")
    names = run_blocks_of_the_page()
    rng = np.random.default_rng(0)
    levels = rng.uniform(-1, 1, 100)
    u = levels.repeat(8)
    y = signal.lfilter([0, 0.1], [1, -0.9], u)
    train = official.Input_output_data(u[:500], y[:500], 0.1)
    test = official.Input_output_data(u[:800], y[:800], 0.1)
    upper_limit = 0.05 * y.std()
    enter = names["entry"]
    assert enter(train, test, *ENTRY_OVERRIDES) < upper_limit
    signals = {"u": u[:500, None], "y": y[:500, None]}
    attrs = {"fs": 10.0}
    sequences = [SimpleNamespace(**signals, attrs=attrs)]
    hyperparameters = {"overrides": ENTRY_OVERRIDES}
    context = SimpleNamespace(hyperparameters=hyperparameters)
    context.get_train_sequences = lambda: iter(sequences)
    predict = names["build_model"](context)
    predicted = predict(u[:, None], None, {})
    assert predicted.shape == (800, 1)
    difference = np.abs(predicted[:, 0] - y)
    largest_difference = difference.max()
    assert largest_difference < 0.1
