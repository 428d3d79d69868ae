"""`ssm-study refine RUN`: every iteration in a line, then the last run's outcome."""

import argparse

from ssm_study.cli.endings import conclude_run
from ssm_study.refusal import at_least
from ssm_study.study.refine import refine


def told(options: argparse.Namespace) -> bool:
    """Do it; True if a run failed. Refuses what `study.refine` refuses."""
    at_least(1, "--times", options.times, "use 4 or so")
    steps = []
    for step in refine(options.run, options.record, options.times):
        print(step.said, flush=True)
        steps.append(step)
    last = next((step.config for step in reversed(steps) if step.config is not None), None)
    return last is not None and conclude_run(last)
