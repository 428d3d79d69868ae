"""Type hints of numeric arguments, with the short names that signatures of functions show."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float
from typing_extensions import TypeAliasType

# One record: samples by channels, or the samples of one channel.
Values = TypeAliasType("Values", Float[np.ndarray, "..."] | pd.Series | pd.DataFrame | list[float])
# One record, or one per experiment.
Signals = TypeAliasType("Signals", Values | Sequence[Values])
# Smallest and largest slope of a nonlinear map.
Slopes = TypeAliasType("Slopes", tuple[float, float])
