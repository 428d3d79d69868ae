"""Columns that the engine records for every run: identity, time, machine, code and failure."""

from ssm_study.columns import Column

WHEN = "depends on when it ran"
WHERE = "depends on where it ran"
WHY = "describes a failure"
CODE = "depends on the code that ran"

IDENTITY = tuple(Column(name, "string", word=name.title()) for name in ("study", "run", "status"))
CIRCUMSTANCES = (
    Column("error_message", "string", word="Error", unchecked=WHY),
    Column("error_type", "string", unchecked=WHY),
    Column("failure_transient", "boolean", unchecked=WHY),
    Column("record_version", "Int64", unchecked=CODE),
    Column("attempt", "Int64", unchecked=WHEN),
    Column("started_utc", "string", unchecked=WHEN),
    Column("ended_utc", "string", unchecked=WHEN),
    Column("seconds", "Float64", "low", unchecked=WHEN),
    Column("pid", "Int64", unchecked=WHERE),
    Column("host", "string", unchecked=WHERE),
    Column("threads", "Int64", unchecked=WHERE),
    Column("machine", "string", unchecked=WHERE),
    Column("machine_*", "string", unchecked=WHERE),
    Column("git_commit", "string", unchecked=CODE),
    Column("git_dirty", "boolean", unchecked=CODE),
    Column("version_*", "string", unchecked=CODE),
    Column("stage_*_key", "string", unchecked=CODE),
    Column("stage_*_seconds", "Float64", "low", unchecked=WHEN),
    Column("stage_*_reused", "boolean", unchecked=WHEN),
    Column("inputs_sha256", "string", unchecked="the next run of the command compares the files"),
    Column("sha256", "string", unchecked="the seal of the record itself"),
)
