"""Results that the tests of `verify` compute once: they verify a hundred copies of one run, each
with one file changed."""

import hashlib
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

# What `verify` makes again of a run: pure functions of their parts.
MADE_AGAIN = (
    "ssm_study.data.metrics.persistency_order",
    "ssm_study.data.simulated.SimulatedData.build",
    "ssm_study.data.simulated.SimulatedData.simulate_held_out_records",
    "ssm_study.loop.regulation.LoopExperiment.run_on_model",
    "ssm_study.loop.regulation.LoopExperiment.run_on_plant",
    "ssm_study.loop.regulation.LoopExperiment.run_design",
    "ssm_study.study.claims.model_bound_columns",
    "ssm_study.study.claims.textbook_pi_columns",
    "ssm_study.study.design_claims.coverage_columns",
    "ssm_study.study.design_claims.design_columns",
    "ssm_study.study.design_claims.failed_checks",
    "ssm_study.study.design_claims.faster_response_column",
    "ssm_study.study.design_claims.measure_model_error",
    "ssm_study.study.design_claims.measure_error_spectra",
    "ssm_study.study.design_claims.measure_error_with_simulated_sines",
    "ssm_study.study.design_claims.relative_radii_for_further_data",
    "ssm_study.study.design_claims.sine_columns",
    "ssm_study.study.run_files.collect_findings",
    "ssm_study.study.run_files.measure_model_error",
    "ssm_study.synthesis.measured_discs_run.measure_error_spectra",
)

# What `verify` reads of a recording.
READERS = (
    "ssm_study.study.recording_labels.list_unread_contents",
    "ssm_study.study.recordings.read_mcap",
)


# What those functions returned, for all test files of this process.
RESULTS: dict[str, dict[bytes, Any]] = {}


def once(place: str) -> Callable[..., Any]:
    """The function there, asked once for equal arguments; what it would yield one by one comes at
    once."""
    function = resolve_name(place)
    known = RESULTS.setdefault(place, {})

    def made(*given: Any, **named: Any) -> Any:
        text = pickle.dumps((given, named))
        key = hashlib.sha256(text).digest()
        if key not in known:
            result = function(*given, **named)
            known[key] = tuple(result) if isinstance(result, Iterator) else result
        # Columns are joined in place with others.
        return dict(known[key]) if isinstance(known[key], dict) else known[key]

    return made


def once_for_content(place: str) -> Callable[[Path], Any]:
    """The reader of a file there, asked once for equal content."""
    read = resolve_name(place)
    known = RESULTS.setdefault(place, {})

    def read_once(path: Path) -> Any:
        key = hashlib.sha256(path.read_bytes()).digest() if path.is_file() else b""
        if not key:
            return read(path)
        if key not in known:
            known[key] = read(path)
        return known[key]

    return read_once
