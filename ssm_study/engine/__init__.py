"""Many runs of one task: stages computed once, records that survive, processes, launchers; it knows
no science."""
