"""Judgement of the forms of a term: each is fitted anew without every split's held-out data, and compared on that.

Theory of operation. Errors are those of free runs, in units of each output's size, or whitened. In parts of what is
held out, the logarithm of an error's square does not depend on the part's own size, so that one passage does not decide
between two forms; how far one is behind another is the sum of its differences in units of their own scatter. Which
claim follows is decided in `lab.inference`.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optodrive.core.types.arrays import BoolArray, FloatArray
from optodrive.core.types.discrepancy import Probabilities
from optodrive.lab.discovery.fitting import Point, Simulation, run_errors, weigh
from optodrive.lab.discovery.forms import CHANGE, CURVE, LINEAR, NAMELESS, Form
from optodrive.lab.discovery.held_out import WITHIN_NOISE, FreeRuns, Measured, Proposal, sum_parts
from optodrive.lab.discovery.integration import STEP
from optodrive.lab.discovery.memory import FILTERS, NONE, TEXTS, name_memory
from optodrive.lab.discovery.model import Record
from optodrive.lab.discovery.screening import Candidate, Filtered, find_twin
from optodrive.lab.inference.claim import (
    MIN_KEPT,
    MIN_LISTED,
    Alternative,
    Evidence,
    SplitGain,
    TermClaim,
    TermForm,
    claim,
    compute_no_effect,
    sum_in_sigma,
    weigh_forms,
)

EVIDENCE_PARTS = 256
"""Parts of a split's held-out samples in which the evidence for a term is summed."""
SAME = 0.01
"""Squared difference of two functions, relative to the smaller one, below which they are one."""
ALIKE_SIGMA, NEARLY = 2.0, 0.9
"""How far behind a simpler form may be, and which share of a curve's gain a formula of physics needs, to replace it."""
NO_OFFSET = 0.1
"""Value of a term where its variable is nearest to zero, relative to its largest, below which it vanishes there."""
PER_NUMBER, PER_CHANGE = 0.5, 0.1
"""Weight of a form beforehand, for each number that it has more than another, and for a change with time."""


class Judge(FreeRuns):
    """Comparison of models on held-out data."""

    def compute_evidence(
        self, before: Sequence[FloatArray], after: Sequence[FloatArray], masks: Sequence[BoolArray], tries: int
    ) -> float:
        """Return the probability of no effect from errors [m, o] without and with a term in masked samples.

        The change of the predictions does not depend on the noise of held-out samples, so without an effect the sum of
        its products with the errors has mean zero. Their noise is that with the errors that the term leaves. tries: how
        many terms were compared, of which this one is the best
        """
        change = [a - b for a, b in zip(before, after, strict=True)]
        products = [
            sum_parts([d * e for d, e in zip(change, errors, strict=True)], masks, EVIDENCE_PARTS)
            for errors in (before, after)
        ]
        improves = sum(float(np.sum(each)) for each in products) > 0.0  # the sum of squares falls
        sigma, parts = sum_in_sigma(*products)
        return compute_no_effect(sigma if improves else 0.0, parts, tries)

    def judge(
        self,
        base: Measured,
        before: Measured,
        proposals: Sequence[Proposal],
        filtered: Sequence[Filtered],
        start: Point | None,
    ) -> tuple[Proposal, TermClaim]:
        """Return the proposal to extend the model by, and the claim on its term.

        filtered: the search's records; start: the model without the term there, None where it is known to be missing
        """
        kept = self._list_distinct(before, proposals)
        gains = [self.measure_gains(base, before, measured) for _, measured in kept]
        forms = self._weigh(kept, gains)
        is_usable = [form.gain > 0.0 and len(own) > 0 for form, own in zip(forms, gains, strict=True)]
        # Time explains any slow misfit: it is what is left where no state and no input extrapolates. A curve beside a
        # term follows what that one leaves.
        last = (CHANGE, CURVE) if len(before.points[0].terms) else (CHANGE,)
        ranked = sorted(range(len(kept)), key=lambda k: -forms[k].probability)
        chosen = min(ranked, key=lambda k: (not is_usable[k], forms[k].kind in last))
        no_effect, tries = 0.0, 2 * len(kept)  # in predictions that follow the data, and in free runs
        if start is not None:
            no_effect = self._compute_step_evidence(filtered, start, kept[chosen][0].point, tries)
        without, with_term = self._remove_nuisances(before, (before.errors, kept[chosen][1].errors))
        no_effect = min(no_effect, self.compute_evidence(without, with_term, self.splits[0].held_out, tries))
        names = {k: (f"{forms[k].name} ({forms[k].formula})",) for k in ranked}
        probabilities = Probabilities(
            no_effect, 0.0, {names[k]: (1.0 - no_effect) * forms[k].probability for k in ranked}
        )
        # A term has no other forms of its own, and is a name only beside terms that explain half of all together.
        alternatives = [
            Alternative(
                names[k],
                (self.measure_min_gain(base, base, kept[k][1]), 1.0),
                gains=gains[k],
                nameless=NAMELESS.get(forms[k].kind, ""),
            )
            for k in ranked
        ]
        twins = {names[k][0]: twin for k in ranked if (twin := self._find_twin(filtered, kept[k][0]))}
        found = TermClaim(
            claim(Evidence(probabilities, tuple(alternatives), twins)),
            1.0 - no_effect,
            tuple(forms[k] for k in ranked),
            forms[chosen],
            gains[chosen],
        )
        if found.claim.verdict not in ("cause", "none", "undecided"):
            rival = next((k for k in ranked if k != chosen and forms[k].probability >= MIN_LISTED), None)
            found = replace(found, next_record=self._propose_record(kept, forms, chosen, rival, gains[chosen]))
        return kept[chosen][0], found

    def _list_distinct(self, before: Measured, proposals: Sequence[Proposal]) -> list[tuple[Proposal, Measured]]:
        """Return the fitted proposals, of those alike the simplest, which comes first."""
        kept, named = list[tuple[Proposal, Measured]](), dict[str, tuple[Proposal, Measured]]()
        fitted = [(each, each.measured) for each in proposals if each.measured is not None]
        for each, measured in sorted(fitted, key=lambda item: -float(item[1].logs.mean())):
            named[self.name(each).name] = each, measured  # of one name the best, which is the last
        # Curves come last: one is as good as a formula of physics nearly everywhere. Before them come memories, for
        # which no function of the present may do as well. Of equally simple forms one that vanishes where its variable
        # does comes first, and then the better one: it stands for those like it.
        for each, measured in sorted(
            named.values(),
            key=lambda item: (
                item[0].candidate.form.kind == CURVE,
                item[0].candidate.screened.at.memory != NONE,
                item[0].candidate.numbers,
                _has_offset(item[0]),
                float(item[1].logs.mean()),
            ),
        ):
            if not any(_stands_for((one, other), (each, measured), before) for one, other in kept):
                kept.append((each, measured))
        return kept

    def _weigh(self, kept: Sequence[tuple[Proposal, Measured]], gains: Sequence[Sequence[SplitGain]]) -> list[TermForm]:
        """Return the forms with their probabilities among each other and their smallest gains."""
        forms = [self.name(each) for each, _ in kept]
        minimum = [min((each.held_out for each in own), default=0.0) for own in gains]
        # What gains less than half of another one where it was not fitted is no rival of it, and a curve none of a
        # formula of physics that gains nearly as much.
        physical = max((g for form, g in zip(forms, minimum, strict=True) if form.kind not in NAMELESS), default=0.0)
        prior = [
            PER_NUMBER
            ** (each.candidate.numbers + self.simulation.model.is_follower(each.candidate.screened.at.variable))
            * (PER_CHANGE if form.kind == CHANGE else 1.0)
            * (max(minimum) <= 0.0 or gain >= MIN_KEPT * max(minimum))
            * (form.kind != CURVE or physical < NEARLY * gain)
            for (each, _), form, gain in zip(kept, forms, minimum, strict=True)
        ]
        rivals = [measured for (_, measured), weight in zip(kept, prior, strict=True) if weight > 0.0]
        best = min(rivals, key=lambda each: float(each.logs.mean()))
        weights = weigh_forms([_compute_behind(measured, best) for _, measured in kept], prior)
        return [
            replace(form, probability=weight, gain=gain)
            for form, weight, gain in zip(forms, weights, minimum, strict=True)
        ]

    def _compute_step_evidence(self, filtered: Sequence[Filtered], start: Point, longer: Point, tries: int) -> float:
        """Return the probability of no effect from predictions that follow the data, where held out."""
        records, gains = [each.record for each in filtered], [each.line.gains for each in filtered]
        before, after = (
            [
                error * each.weights
                for error, each in zip(
                    run_errors(self.simulation, records, point, np.ones(len(self.noise)), gains), filtered, strict=True
                )
            ]
            for point in (start, longer)
        )
        return self.compute_evidence(before, after, [each.fold < 0 for each in filtered], tries)

    def _remove_nuisances(self, model: Measured, runs: Sequence[Sequence[FloatArray]]) -> list[list[FloatArray]]:
        """Return errors of free runs in the first held-out part, without those by another start or parameters.

        A free run starts from a noisy sample, to which the parameters were fitted elsewhere.
        """
        point, masks = model.points[0], self.splits[0].held_out
        if self.simulation.model.from_rest:
            return [list(errors) for errors in runs]
        states = np.concatenate([self.simulation.run(record, point)[1] for record in self.records])
        sizes = np.maximum(np.nan_to_num(states[:, : len(self.simulation.model.states)].std(axis=0)), 1e-12)
        moved = [(point, shift) for shift in STEP * np.diag(sizes)]
        for k, value in enumerate(point.parameters):
            parameters = point.parameters.copy()
            parameters[k] += STEP * max(abs(value), 1e-3 * (self.simulation.high - self.simulation.low)[k])
            moved.append((replace(point, parameters=parameters), 0.0 * sizes))
        trials = [run_errors(self.simulation, self.records, trial, self.sizes, start=start) for trial, start in moved]
        out = [[np.zeros_like(each) for each in errors] for errors in runs]
        for r, mask in enumerate(masks):
            columns = np.array([(trial[r] - model.errors[r])[mask].ravel() for trial in trials]).T
            columns /= np.maximum(np.abs(columns).max(axis=0, initial=0.0), 1e-300)
            for errors, cleaned in zip(runs, out, strict=True):
                own = errors[r][mask]
                rest = own.ravel() - columns @ np.linalg.lstsq(columns, own.ravel(), rcond=None)[0]
                cleaned[r][mask] = rest.reshape(own.shape)
        return out

    def _find_twin(self, filtered: Sequence[Filtered], proposal: Proposal) -> str:
        """Return another variable, or a memory elsewhere, that would predict the same, "" if there is none."""
        model, at = self.simulation.model, proposal.candidate.screened.at
        if at.memory in FILTERS or (
            model.is_follower(at.variable) and proposal.candidate.form.kind == LINEAR.kind
        ):  # with other parameters, one at another place predicts nearly the same
            return "a linear memory at another place"
        if model.from_rest:
            return ""
        return find_twin(filtered, at, proposal.evaluate, model.variable_names, len(model.states) + len(model.inputs))

    def name(self, proposal: Proposal) -> TermForm:
        """Return the form of a proposal with the numbers of the first split."""
        measured = proposal.measured
        point = proposal.point if measured is None else measured.points[0]
        return name_form(self.simulation, proposal.candidate, point.terms.values[-1])

    def _propose_record(
        self,
        kept: Sequence[tuple[Proposal, Measured]],
        forms: Sequence[TermForm],
        chosen: int,
        rival: int | None,
        gains: Sequence[SplitGain],
    ) -> str:
        """Return which record would tell the two most probable forms apart, or why one fails."""
        if rival is None:
            worst = min(gains, key=lambda each: each.held_out - each.trained, default=None)
            return "" if worst is None else f"another one like {worst.split}"
        points = [kept[k][1].points[0] for k in (chosen, rival)]
        best, text = 0.0, ""
        for number, record in enumerate(self.records):
            name = record.name or f"record {number + 1}"
            later_s = float(record.t_s[-1] - record.t_s[0])
            trials = {f"{name} once more": record}
            if not self.simulation.model.from_rest:
                trials[f"{name} with start and inputs twice as large"] = _scale(record, 2.0)
                trials[f"{name} with start and inputs half as large"] = _scale(record, 0.5)
                trials[f"{name} once more, begun {later_s:.3g} s later"] = replace(record, t_s=record.t_s + later_s)
            for words, trial in trials.items():
                first, second = (self.simulation.run(trial, point)[0] for point in points)
                apart = weigh(trial, first - second, np.ones_like(first)) / self.sizes
                size = float(np.sqrt(np.mean(apart**2))) / self.floor
                if np.isfinite(size) and size > best:
                    best, text = size, f"{words}, where {forms[chosen].kind} and {forms[rival].kind} differ by"
        return f"{text} {best:.2g} times the noise" if text else ""


def name_form(simulation: Simulation, candidate: Candidate, values: FloatArray) -> TermForm:
    """Return the form of a candidate with fitted numbers [4]."""
    at, nodes, model = candidate.screened.at, candidate.screened.nodes, simulation.model
    names = model.variable_names
    involved = (names[at.variable], *((names[at.factor],) if at.factor >= 0 else ()))
    form: Form = candidate.form.settle(float(values[1]), float(np.abs(nodes).max()))
    kind = CHANGE if "t" in involved else form.kind
    formula = NAMELESS[CHANGE] if kind == CHANGE else form.describe(values, *involved)
    if at.memory != NONE:
        kind = name_memory(at.memory, at.place >= len(model.states), at.variable < len(model.states))
        formula = (
            f"{values[0]:.4g} {TEXTS[at.memory].format(z=involved[0], s=f'{values[3]:.4g}', d=f'{values[2]:.4g}')}"
        )
    return TermForm(model.place_names[at.place], involved, kind, NAMELESS.get(kind, formula), 0.0, 0.0)


def _scale(record: Record, factor: float) -> Record:
    return replace(record, inputs=record.inputs * factor, outputs=record.outputs * factor)


def _has_offset(proposal: Proposal) -> bool:
    """Return whether a term is not near zero where its variable is nearest to it, as after an offset."""
    values = np.abs(proposal.evaluate(proposal.candidate.screened.nodes))
    return bool(values[np.argmin(np.abs(proposal.candidate.screened.nodes))] > NO_OFFSET * values.max())


def _stands_for(simple: tuple[Proposal, Measured], other: tuple[Proposal, Measured], before: Measured) -> bool:
    """Return whether the simpler one of two terms is all that the data shows of the other one.

    before: the model without either
    """
    (one, a), (two, b) = simple, other
    at, further = one.candidate.screened.at, two.candidate.screened.at
    if at.place != further.place:
        return False
    is_constant = one.candidate.is_constant
    is_rewritten = at.variable == further.variable and one.candidate.numbers == two.candidate.numbers
    if is_constant or is_rewritten or one.candidate.numbers < two.candidate.numbers:
        # The same predictions, whichever variables they are functions of, as good as the other's.
        apart, changes = _sum_squares(a, b), (_sum_squares(a, before), _sum_squares(b, before))
        if apart <= SAME * min(changes) and (a.rmse <= WITHIN_NOISE * b.rmse).all():
            return True
    is_special = (
        # Each form of a variable becomes a constant or a line beyond the data.
        is_constant
        or (at == further and one.candidate.form.kind == LINEAR.kind)
        or (further.memory != NONE and at.memory == NONE)
        or (at.key == further.key and two.candidate.form.kind == CURVE)
        or is_same(one, two)
    )
    return is_special and _compute_behind(a, b) < ALIKE_SIGMA


def _sum_squares(one: Measured, other: Measured) -> float:
    return sum(float(np.sum((a - b) ** 2)) for a, b in zip(one.errors, other.errors, strict=True))


def is_same(one: Proposal, other: Proposal, share: float = SAME) -> bool:
    """Return whether two terms are one function along the data, neither a curve, which may be any."""
    screened = one.candidate.screened
    if screened.at.key != other.candidate.screened.at.key:
        return False
    if CURVE in (one.candidate.form.kind, other.candidate.form.kind):
        return False
    a, b = one.evaluate(screened.nodes), other.evaluate(screened.nodes)
    apart = float((a - b) @ screened.full @ (a - b))
    return apart <= share * min(float(a @ screened.full @ a), float(b @ screened.full @ b))


def _compute_behind(one: Measured, best: Measured) -> float:
    """Return by how many σ one model predicts worse than another."""
    apart = one.logs - best.logs
    return sum_in_sigma(apart, apart - apart.mean())[0] if np.abs(apart).max() > 1e-9 else 0.0
