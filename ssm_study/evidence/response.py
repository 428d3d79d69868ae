"""Findings on the output's response to the input: its duration, dead time and coherence.

Coherence `gamma^2(w) = S_yu S_uu^-1 S_uy / S_yy`: the share of the output's power that a linear
filter of the inputs explains. Dead time: the first lag of the impulse response that is clearly not
zero, where those before it clearly are. Source: Ljung, System Identification, 2nd ed. (1999)
sections 6.4 and 14.3.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import scipy
from jaxtyping import Complex, Float

from ssm_study.bounds.frequency import largest_gains
from ssm_study.evidence.finding import EvidenceCase, Finding, make_doubt, make_note
from ssm_study.evidence.fit import LAGS
from ssm_study.robustness.return_to_rest import RESPONSES

AVERAGES = 16
SEGMENTS = (
    64,
    1024,
)  # pieces that a coherence is averaged over, and their samples at least and at most
USED = 0.1  # the controller's band: where the model answers with this share of its largest gain
COHERENT = 0.3
INCOHERENT = (
    0.5  # coherence below which a frequency counts, and the share of the band that is a doubt
)
CLEAR = 4.0
SMALL = (
    0.1  # standard errors of a lag, and the share of the largest lag below which it counts as none
)
SMOOTH = (
    1e-6  # of the largest singular value: an input too smooth to tell neighbouring samples apart
)
Record = tuple[Float[np.ndarray, "_ m"], Float[np.ndarray, "_ p"]]
LATE = 2  # samples of dead time that are worth a note
# share of the slowest mode left over the longest record, above which it is taken for an integrator
INTEGRATES = 0.9
COARSE = 3
FINE = 1000
ENOUGH = 200  # samples of a response: too few, more than a design gains from, what to keep


def judge_response(case: EvidenceCase) -> list[Finding]:
    """Findings on coherence, dead time and sampling time of the records."""
    return [*_coherence_findings(case), *_dead_time_findings(case), *_sampling_findings(case)]


def slowest_mode_remainder(case: EvidenceCase) -> float:
    """Fraction of the slowest mode that is left after the duration of the longest training record;
    1 for an integrator."""
    return case.model.linear.spectral_radius ** max(len(record) for record in case.data.training)


def _coherence_findings(case: EvidenceCase) -> Iterator[Finding]:
    """Finding on records with low coherence of input and output in the controller's frequency
    band."""
    parts = [case.scale_record_with_disturbances(record) for record in case.data.training]
    segment = int(np.clip(sum(len(u) for u, _ in parts) // AVERAGES, *SEGMENTS))
    parts = [(u, y) for u, y in parts if len(u) >= segment]
    linear = case.model.linear
    if not parts or segment < RESPONSES * linear.impulse_response_length():
        return  # what outlasts a piece would count as noise
    angles = np.linspace(0, np.pi, segment // 2 + 1)[1:]
    sizes = largest_gains(linear, angles)
    used = sizes >= USED * sizes.max()
    values = multiple_coherence(parts, segment)[1:][used]
    share = float((values < COHERENT).mean())
    hertz = angles[used].max() / (2 * np.pi * case.data.step_s)
    if share > INCOHERENT:
        statement = (
            f"Input and output go together (coherence above {COHERENT:g}) in "
            f"{100 * (1 - share):.0f} % of the band"
        )
        yield make_doubt(
            f"{statement} up to {hertz:.3g} Hz that a controller uses: excite it there, or "
            "measure with less noise."
        )


def multiple_coherence(records: Sequence[Record], segment_length: int) -> Float[np.ndarray, "F"]:
    """Multiple coherence between inputs and output at each frequency, for the output with the
    lowest coherence.

    Spectra are averaged over all records: where the input rests in one record, the others count. It
    is zero without power.
    """

    def cross_spectra(first_signal: int, second_signal: int) -> Complex[np.ndarray, "F r c"]:
        """Cross spectra of two signals, summed over all records and weighted by their lengths."""
        spectra = []
        for part in records:
            a = part[first_signal][:, :, None]
            b = part[second_signal][:, None, :]
            _, spectrum = scipy.signal.csd(a, b, nperseg=segment_length, axis=0)
            spectra.append(len(a) * spectrum)
        return np.sum(spectra, axis=0)

    power = cross_spectra(0, 0)
    through = cross_spectra(0, 1)
    whole = np.einsum("fpp->fp", cross_spectra(1, 1)).real
    ridge = 1e-9 * np.trace(power, axis1=1, axis2=2).real.mean()
    tiny = np.finfo(float).tiny
    power = power + max(ridge, tiny) * np.eye(power.shape[-1])
    filters = np.linalg.solve(power, through)
    explained = np.einsum("fmp,fmp->fp", through.conj(), filters).real
    shares = explained / np.maximum(whole, tiny)
    return np.asarray(shares.min(axis=1))


def _sampling_findings(case: EvidenceCase) -> Iterator[Finding]:
    """Note on a log whose sampling period is far too long or far too short for the model's
    response."""
    response = case.model.linear.impulse_response_length()
    statement = (
        f"The bulk of the model's response lasts {response} samples of {case.data.step_s:g} s"
    )
    if case.data.metadata.get("source") != "recorded":
        return
    if response <= COARSE:
        yield make_note(f"{statement}: sample more often, or the controller cannot act within it.")
    elif response >= FINE and slowest_mode_remainder(case) <= INTEGRATES:
        keep = response // ENOUGH
        yield make_note(
            f"{statement}: sampled more finely than needed; data.decimate={keep} keeps one sample "
            f"in {keep}."
        )


def _dead_time_findings(case: EvidenceCase) -> Iterator[Finding]:
    """Finding on a plant whose output responds to the input only after a dead time."""
    late = dead_time_samples(case)
    order = case.model.order
    if late < LATE:
        return
    statement = f"The output answers {late} samples late"
    if late > order:
        remedy = f"use model=delayed model.dead_time={late}, or a longer step_s"
        yield make_doubt(f"{statement}, more than model.order={order} can delay it: {remedy}.")
    else:
        yield make_note(f"{statement}, which takes as many of the {order} states.")


def dead_time_samples(case: EvidenceCase) -> int:
    """Dead time of the plant in samples, estimated from a finite-impulse-response model of the
    training records. Number of samples beyond the first after which no output has clearly responded
    to any input; 0 if that is not clear."""
    x, y = case.fir_regression_arrays(case.data.training, LAGS)
    if len(x) < 2 * x.shape[1]:
        return 0
    weights, _, rank, _ = np.linalg.lstsq(x, y, rcond=SMOOTH)
    if rank < x.shape[1]:
        return 0
    variances = np.diag(np.linalg.inv(x.T @ x))[:-1, None]
    spread = np.sqrt(variances * (y - x @ weights).var(axis=0))
    channels = case.model.scale.inputs * y.shape[1]
    size = np.abs(weights[:-1]).reshape(LAGS + 1, channels).max(axis=1)
    doubtful = spread.reshape(LAGS + 1, channels).max(axis=1)
    is_nothing = size + CLEAR * doubtful < SMALL * size.max()
    first = int(np.argmin(is_nothing))  # the first lag that may be something
    return max(first - 1, 0) if size[first] > CLEAR * doubtful[first] else 0
