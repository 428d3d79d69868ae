"""Entry point of `python -m ssm_study.cli`, the same command line as `ssm-study`."""

import sys

from ssm_study.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
