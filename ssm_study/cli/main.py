"""The command line `ssm-study`. Exit status 0: done; 1: some runs failed (the others are kept); 2:
the request was wrong."""

import os
import select
import sys
from io import TextIOWrapper

from ssm_study import limit_threads
from ssm_study.cli.commands import Command
from ssm_study.cli.exit_status import DONE, WRONG_REQUEST, error_as_bad_request
from ssm_study.cli.parser import build_parser
from ssm_study.extensions import pop_extension_option
from ssm_study.refusal import BadRequest

INTERRUPTED = (
    "interrupted; the same command again does what is missing, a training from its last checkpoint "
    "(in Python st.fit(..., keep_on_interrupt=True) returns the model so far)"
)


def main(arguments: list[str] | None = None) -> int:
    """Run one `ssm-study` command and return its exit status."""
    limit_threads()  # first: the libraries read it once, when they are imported
    _escape_unprintable_letters()
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        arguments = pop_extension_option(arguments)
        if arguments[:1] == ["run"]:
            from ssm_study.cli.run import run

            return run(arguments[1:])
        options = build_parser().parse_args(arguments or ["--help"])
        command: Command = options.command
        return command(options) or DONE
    except KeyboardInterrupt:
        print(f"ssm-study: {INTERRUPTED}", file=sys.stderr)
        # Without a traceback, yet ended by the signal: a script's loop ends with it.
        sys.excepthook = lambda *_: None
        raise
    except Exception as error:
        # The one guard: whatever a file holds, no command ends in a traceback.
        # `ssm-study show STUDY | head`.
        if isinstance(error, BrokenPipeError) and _is_output_closed():
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return DONE
        if "SSM_STUDY_TRACEBACK" in os.environ and not isinstance(error, (BadRequest, OSError)):
            raise
        print(f"ssm-study: {error_as_bad_request(error, arguments)}", file=sys.stderr)
        return WRONG_REQUEST


def _escape_unprintable_letters() -> None:
    """Replace letters that the terminal cannot print by escape codes, since column names may use
    any script."""
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def _is_output_closed() -> bool:
    """Whether the program that reads the command's output, such as `head`, has stopped reading."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return bool(poll.poll(0))
