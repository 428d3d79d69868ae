"""Sentences of several runs that differ only in their numbers, merged into one."""

import re
from collections.abc import Sequence

NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.]*\w)")  # not the 2 of S_u2


def hide_numbers(sentence: str) -> str:
    """Replace each number in a sentence by `#`, so that sentences that differ only in numbers are
    equal."""
    return NUMBER.sub("#", sentence)


def merge_number_ranges(sentences: Sequence[str]) -> str:
    """Merge sentences that differ only in numbers into one sentence, in which each number that
    varies is replaced by its range, such as `rate 0.4 to 0.9`."""
    numbers = [NUMBER.findall(sentence) for sentence in sentences]
    ranges = []
    for column in zip(*numbers, strict=True):
        low = min(column, key=float)
        high = max(column, key=float)
        is_constant = float(low) == float(high)
        ranges.append(low if is_constant else f"{low} to {high}")
    remaining = iter(ranges)
    return NUMBER.sub(lambda _: next(remaining), sentences[0])
