"""`python experiments/run.py [overrides]`: the same entry as `ssm-study run`."""

import sys

from ssm_study.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["run", *sys.argv[1:]]))
