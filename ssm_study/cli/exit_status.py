"""Exit status of a command, and the message for an error that ended the command."""

import errno

from ssm_study.refusal import BadRequest

DONE = 0
SOME_FAILED = 1
WRONG_REQUEST = 2
REMEDIES = {
    errno.EACCES: "ask its owner for access, or choose a folder of your own",
    errno.EROFS: "choose a folder that you may write to",
    errno.ENAMETOOLONG: "choose shorter names",
}


def storage_error(field: str, error: OSError, default_path: str) -> BadRequest:
    """Error message about a full disk or a folder without write permission. `field` names the
    setting that requested the file; `default_path` is the path where the error names none."""
    problem = error.strerror or type(error).__name__
    remedy = REMEDIES.get(error.errno or 0, "make room, or choose a folder that you may write to")
    return BadRequest(field, error.filename or default_path, problem, remedy)


def error_as_bad_request(error: Exception, arguments: list[str]) -> BadRequest:
    """Request error that describes, in one sentence, the error by which a command ended."""
    command = " ".join(arguments)
    if isinstance(error, BadRequest):
        return error
    if isinstance(error, OSError) and error.filename is not None:
        return storage_error("file", error, "unknown")
    if isinstance(error, OSError):  # the error of a write does not know its file
        return storage_error("command", error, command)
    cause = f"{type(error).__name__}: {str(error)[:300]}"
    problem = f"Unexpected error (a bug in ssm-study, please report it): {cause}"
    rerun = "if files of the study were changed, run it again"
    remedy = f"{rerun}; SSM_STUDY_TRACEBACK=1 shows the traceback"
    return BadRequest("command", command, problem, remedy)
