"""Result-table column that names the plant of a run."""

from ssm_study.columns import Column

COLUMNS = (Column("plant", "string", word="Plant", setting="plant"),)
