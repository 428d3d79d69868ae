"""Rehearsals of the servo benchmark's test: what serves one table of docs/data.md, added by
`--with`."""
