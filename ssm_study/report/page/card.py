"""Block of the report page that shows one result of a run."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Record = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Card:
    """Block of the report page on one result of a run: a number, a sentence about it, and further
    short lines.

    `not_covered` lists what a proof says nothing about.
    """

    title: str
    number: str
    text: str
    lines: tuple[str, ...] = ()
    not_covered: tuple[str, ...] = ()
