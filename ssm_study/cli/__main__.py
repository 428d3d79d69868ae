"""Entry point of `python -m ssm_study.cli`, the command line without its installed script."""

import sys

from ssm_study.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
