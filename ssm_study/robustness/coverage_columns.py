"""Result-table columns of the coverage, the ratio of the model error that the proof tolerates to
the measured model error."""

from ssm_study.columns import Column, iterative_result_column

WITHHELD = "withheld"  # how the reason begins where a coverage is proved and says nothing
COLUMNS = (
    iterative_result_column(
        "coverage", "high", "Model error covered by the proof, over what records show", "–"
    ),
    Column("coverage_reason", "string", word="Why nothing is covered"),
    iterative_result_column("coverage_needed", "low", "Coverage that fresh data need", "–"),
    iterative_result_column("sine_coverage", "high", "Model error of single sines covered", "–"),
    Column("coverage_reference", "string", word="Record that decides the coverage"),
)
