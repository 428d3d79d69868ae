"""Numbers and arrays of the exported C code, each written so that it is read back as the same
float, and its templates."""

from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.export.set_point_maps import REALS


def read_template(name: str) -> Template:
    """Read a template of C code from its file in the export package."""
    return Template(Path(__file__).with_name(name).read_text(encoding="utf-8"))


def render_number(value: float | np.floating[Any], c_type: str) -> str:
    """Shortest decimal text of a number that C reads back as the same float."""
    rounded = REALS[c_type](value)
    digits = np.format_float_scientific(rounded, trim="0")
    return f"{digits}f" if c_type == "float" else digits


def render_array(array_name: str, values: Float[np.ndarray, "..."], c_type: str) -> str:
    """C definition of a constant array."""
    texts = [render_number(value, c_type) for value in values.ravel()]
    numbers = ", ".join(texts)
    return f"static const {c_type} {array_name}[{values.size}] = {{{numbers}}};\n"
