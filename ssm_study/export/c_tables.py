"""Constants of the exported C code, each written so that it is read back as the same float."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.export.device import REALS


def render_number(value: float | np.floating[Any], real: str) -> str:
    """Shortest decimal text that is read back as the same float."""
    rounded = REALS[real](value)
    digits = np.format_float_scientific(rounded, trim="0")
    return f"{digits}f" if real == "float" else digits


def render_array(name: str, values: Float[np.ndarray, "..."], real: str) -> str:
    """C definition of a constant array."""
    texts = [render_number(value, real) for value in values.ravel()]
    numbers = ", ".join(texts)
    return f"static const {real} {name}[{values.size}] = {{{numbers}}};\n"
