"""The answer made up of what was found."""

from optodrive.core.types.stimuli import FrameSequence
from optodrive.planning.feasibility.bulk_reduction import Left
from optodrive.planning.feasibility.messages import sentence, source_name, suggestion
from optodrive.planning.feasibility.report import Admission, Fit, LeftOut, Nearest, Proof, Thinned
from optodrive.planning.feasibility.violation import Breach
from optodrive.planning.pipeline import Prepared


def fitting(plan: Prepared, proof: Proof, fit: Fit) -> Admission:
    """The answer for a plan that fits."""
    there_s = [timing.due_s for timing in plan.frames]
    if len(plan.plan):
        there_s.append(
            float(
                (plan.plan.nominal_s + plan.plan.width_s)[plan.plan.source >= len(plan.sequence.frames)].max(
                    initial=0.0
                )
            )
        )
    return Admission(
        fits=True,
        proof=proof,
        sentence="all of it fits" if proof == "planned" else "all of it fits, in another order than the planner's own",
        beam_needed_s=float(plan.plan.width_s.sum() + plan.plan.settle_s[1:].sum()),
        beam_there_s=max(0.0, max(there_s, default=0.0) - plan.lead_s),
        fit=fit,
    )


def missing(
    sequence: FrameSequence,
    plan: Prepared | None,
    breach: Breach,
    proof: Proof,
    least_s: float | None,
    nearest: Nearest,
) -> Admission:
    """The answer for a sequence that does not fit; plan: None where a target is out of reach."""
    needed_s, there_s = (None, None) if plan is None else _beam_s(plan, breach)
    parts = [sentence(sequence, plan, breach), _PROOFS[proof], suggestion(nearest, sequence, breach.source)]
    if proof == "bound" and least_s is not None:
        parts[1] = f"in any order it takes {least_s:.4f} s at the least"
    return Admission(
        fits=False,
        proof=proof,
        sentence="; ".join(part for part in parts if part),
        reason=breach.reason,
        name=source_name(sequence, breach.source),
        pixel=breach.pixel,
        beam_needed_s=needed_s,
        beam_there_s=there_s,
        beam_least_s=least_s,
        nearest=nearest,
    )


_PROOFS: dict[Proof, str] = {
    "planned": "",
    "searched": "no other order fits",
    "bound": "no order mends that",
    "not found": "no order that fits is known, which does not prove that there is none",
}


def _beam_s(plan: Prepared, breach: Breach) -> tuple[float, float]:
    """Beam time needed and there of the frame that breaks, or of a train's pulse from its nominal time."""
    for timing in plan.frames:
        if timing.source == breach.source:
            return timing.finished_s - timing.show_at_s, timing.due_s - timing.show_at_s
    pulses = plan.plan
    own = pulses.source == breach.source
    late_s = (pulses.start_s - pulses.nominal_s - pulses.settle_s)[own]
    row = own.nonzero()[0][int((late_s > 0).argmax())]
    width_s = float(pulses.width_s[row])
    return width_s + float(pulses.start_s[row] - pulses.nominal_s[row]), width_s + float(pulses.settle_s[row])


def thinned_set(sequence: FrameSequence, left: Left, source: int) -> Thinned:
    """What is left out of a sequence, and how much is kept of a source."""

    def asked(index: int) -> int:
        frames = sequence.frames
        return int((frames[index].target_m > 0).sum()) if index < len(frames) else 1

    left_out = tuple(
        LeftOut(source_name(sequence, index), index, tuple(sorted(pixels)))
        for index, pixels in sorted(left.items())
        if pixels
    )
    return Thinned(asked(source) - len(left.get(source, ())), asked(source), left_out)
