"""Columns of the coverage: how many times the measured model error the proof tolerates."""

from ssm_study.columns import ITERATED, Column

COLUMNS = (
    Column(
        "coverage",
        "Float64",
        "high",
        "",
        "Model error covered by the proof, over what records show",
        "–",
        ITERATED,
    ),
    Column("coverage_reason", "string", word="Why nothing is covered"),
    Column("coverage_needed", "Float64", "low", "", "Coverage that fresh data need", "–", ITERATED),
    Column("coverage_reference", "string", word="Record that decides the coverage"),
)
