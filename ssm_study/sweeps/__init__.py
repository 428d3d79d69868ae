"""Many runs: processes that survive their jobs, groups that train together, search, Slurm, progress."""
