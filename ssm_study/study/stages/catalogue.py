"""All stages of a run, in their order."""

from ssm_study.study.stages.bounds import BOUNDS
from ssm_study.study.stages.dataset import DATASET
from ssm_study.study.stages.evidence import EVIDENCE
from ssm_study.study.stages.free_run import SCORE
from ssm_study.study.stages.fresh_data import FRESH_DATA
from ssm_study.study.stages.loop import LOOP
from ssm_study.study.stages.mismatch import MISMATCH
from ssm_study.study.stages.model import MODEL
from ssm_study.study.stages.sine_trials import SINE_TRIALS
from ssm_study.study.stages.synthesis import SYNTHESIS
from ssm_study.study.stages.textbook_pi import TEXTBOOK_PI

STAGES = (
    DATASET,
    MODEL,
    SCORE,
    BOUNDS,
    TEXTBOOK_PI,
    MISMATCH,
    EVIDENCE,
    SYNTHESIS,
    SINE_TRIALS,
    FRESH_DATA,
    LOOP,
)
