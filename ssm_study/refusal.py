"""How this project says no: one sentence naming the field, the value and the remedy."""

from typing import Any


class BadRequest(ValueError):
    """`<field> = <value>: <problem>; <remedy>.`

    Raised while specifications are built, before any long work; the command line prints it and exits with status 2.
    """

    def __init__(self, field: str, value: Any, problem: str, remedy: str) -> None:
        self.field, self.value, self.problem, self.remedy = field, value, problem, remedy
        reason = " ".join(problem.split())  # a library that is quoted may answer in several lines
        end = "" if remedy.endswith("?") else "."
        super().__init__(f"{field} = {_shown(value)}: {reason}; {remedy}{end}")

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (self.field, self.value, self.problem, self.remedy))


def _shown(value: Any) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 80 else text[:77] + "..."


def require(condition: bool, field: str, value: Any, problem: str, remedy: str) -> None:
    """Raise `BadRequest(field, value, problem, remedy)` unless the condition holds."""
    if not condition:
        raise BadRequest(field, value, problem, remedy)
