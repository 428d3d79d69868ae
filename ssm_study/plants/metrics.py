"""The column that names the plant."""

from ssm_study.columns import Column

COLUMNS = (Column("plant", "string", word="Plant", setting="plant"),)
