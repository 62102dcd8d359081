"""Discovery: find the terms that a simulation lacks, from measured records.

Theory of operation. 1. The parameters are fitted, first with filters that keep the states near the data, then in free
run. 2. Filters of several tightness give the states; `screening` compares all places, variables and factors on what no
parameter can do. 3. The best formulas of the best places are fitted, together with all parameters, by their prediction
errors. 4. The best of these are fitted in free run, once without each part that is held out (`held_out`), and compared
there (`judgement`), where nothing interpolates. 5. The model is extended by a term that gains in every such part, and
steps 2 to 4 are repeated. What is claimed of it is decided in `lab.inference`.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.discovery.fitting import Point, Simulation, Terms, choose_step, output_sizes
from optodrive.lab.discovery.forms import NAMELESS
from optodrive.lab.discovery.held_out import (
    UNCOMPUTABLE,
    WITHIN_NOISE,
    Measured,
    Proposal,
    choose_splits,
    prepare_search,
)
from optodrive.lab.discovery.judgement import Judge, name_form
from optodrive.lab.discovery.model import Curve, Discovery, Finding, OdeModel, Record
from optodrive.lab.discovery.screening import (
    Filtered,
    Place,
    screen,
)
from optodrive.lab.discovery.search import TIGHTNESS, TermSearch
from optodrive.lab.inference.claim import MAX_NO_EFFECT, NOTHING_SHOWN, Claim, TermClaim, claim_nothing, combine_claims
from optodrive.lab.inference.noise import estimate_noise

DIFFERENCES, MIN_DIFFERENCES = (4, 8, 12), 32
"""Orders of differences by which noise is estimated, and how many of one order are needed beside a gap."""
MAX_TERMS = 4
MIN_ERROR = 1e-3
"""Error of a model, relative to the output, that the integration and the inputs' interpolation may cause."""
MIN_REDUCTION, MIN_FURTHER_REDUCTION = 0.005, 0.03
"""Reduction of the held-out RMSE of the first term, and of further ones, below which none is reported."""
MIN_FURTHER_GAIN, MIN_FURTHER_GAIN_WHITE = 0.05, 0.1
"""Share of the first model's avoidable error that a further term removes at least, where noise is estimated and known.

Where it is known a little more than the first formula's form is seen, which is no term of its own.
"""
MIN_REST = 0.5
"""Share of what is avoidable beside the other terms that is enough as well where the search does not see: there the
first model's error may be so large that a share of it says nothing."""
MIN_GAIN_WHITE = 0.5
"""Share of the avoidable error that the first term removes at least, where noise is known: one that leaves more than it
removes is not what is missing."""
MIN_MISSING = 1.0 - MAX_NO_EFFECT
Progress = Callable[[str, float], None]


def discover(model: OdeModel, train: Sequence[Record], progress: Progress = lambda stage, fraction: None) -> Discovery:
    """Return the terms that a simulation lacks, and the model extended by them.

    progress: receives the name of each stage and the share of the work that is done. Raises InputError for records that
    do not fit the model.
    """
    if not train:
        raise InputError("train", "no record", "at least one record")
    for record in train:
        record.check(model)
    return _Discovery(model, train, progress).run()


@dataclass(frozen=True, eq=False)
class Found:
    """A term by which the model is extended, and the claim on it."""

    proposal: Proposal
    term: TermClaim


class _Discovery:
    """One discovery."""

    def __init__(self, model: OdeModel, records: Sequence[Record], progress: Progress) -> None:
        self.model, self.records, self.progress = model, records, progress
        self.splits = choose_splits(records)
        progress("compiling", 0.0)
        self.simulation = Simulation(model, hold=0 if model.from_rest else 1)
        self.is_white = all(record.whiten is not None for record in records)
        self.noise = np.ones(len(model.outputs))  # in its own units where records whiten their errors
        if not self.is_white:
            columns = ([record.outputs[:, k] for record in records] for k in range(len(model.outputs)))
            noise = [estimate_noise(parts, DIFFERENCES, few=MIN_DIFFERENCES) for parts in columns]
            self.noise = np.maximum(noise, 1e-4 * output_sizes(records))
        self.judge = Judge(self.simulation, records, self.splits, self.noise)
        few = prepare_search(records, self.splits[0])
        self.search = TermSearch(self.simulation, few, self.noise, self.is_white)

    def run(self) -> Discovery:
        """Return the answer."""
        first = self._fit_base()
        base = current = self.judge.measure([[first]] * len(self.splits))
        found, claims, is_settled = list[Found](), list[Claim](), False
        while len(found) < MAX_TERMS:
            self.progress(f"term {len(found) + 1}", 0.2 + 0.16 * len(found))
            if current.rmse[0, 1] < MIN_ERROR and not self.is_white:
                break
            if found and (current.rmse[:, 1] <= WITHIN_NOISE * self.judge.floor).all():
                break
            left, first_left = float(current.rmse[0, 1]) - 1.0, float(base.rmse[0, 1]) - 1.0
            if found and self.is_white and left < MIN_FURTHER_GAIN_WHITE * first_left:
                break
            further = self._extend(base, current)
            if further is None:
                if not found and not self.is_white:  # a pixel's diagnosis says itself what is left
                    claims.append(claim_nothing(float((current.rmse[:, 1] / self.judge.floor).max())))
                break
            if (
                not self._is_enough(base, current, further.proposal, bool(found), is_final=False)
                or further.term.missing < MIN_MISSING
            ):
                claims += [] if found else [further.term.claim]
                break
            current = self._settle(further.proposal)
            found.append(further)
            if len(found) == 1 and not self.model.from_rest and not is_settled:
                # A rule that suited the model without this term would be corrected by a further one.
                is_settled, before = True, self.simulation.hold
                self._choose_hold(current.points[0])
                if self.simulation.hold != before:
                    base = current = self.judge.measure([[point] for point in base.points])
                    found = []
        if len(found) > 1:
            current, found = self._reconsider(base, current, found)
        # Of two equal terms neither explains half of the error alone, but both do together.
        if found and all(_is_refused(each.term) for each in found):
            claims += [found[0].term.claim]
            current, found = base, []
        self.progress("final fit", 0.85)
        final_base = self.judge.fit_everything(base.points[0])
        final = self.judge.fit_everything(current.points[0]) if found else final_base
        findings = self._describe(final, found)
        self.progress("done", 1.0)
        simulation = self.simulation

        def simulate(record: Record) -> FloatArray:
            record.check(self.model)
            return simulation.run(record, final)[0]

        scale = 1.0 if self.is_white else float(np.sqrt(np.mean(self.judge.sizes**2)))
        return Discovery(
            findings,
            combine_claims([each.term.claim for each in findings] or claims or [NOTHING_SHOWN], {}, False),
            self.splits[0].name,
            scale * float(base.rmse[0, 1]),
            scale * float(current.rmse[0, 1]),
            scale * self.judge.floor,
            dict(zip(simulation.names, final.parameters.tolist(), strict=True)),
            dict(zip(simulation.names, final_base.parameters.tolist(), strict=True)),
            simulate,
        )

    # Base model

    def _fit_base(self) -> Point:
        """Return the fitted parameters, and settle the inputs' interpolation and the integration step."""
        simulation = self.simulation
        dt_s = float(np.median(np.concatenate([np.diff(r.t_s) for r in self.records])))
        simulation.h_max = dt_s
        start = Point(simulation.start, Terms.none())
        simulation.h_max = choose_step(simulation, self.records, start)
        self.search.measure_sizes(start)
        if self.model.from_rest:
            return self.judge.fit([start], self.splits[0].fitted, is_long=True)
        point = self._choose_hold(start)
        simulation.h_max = choose_step(simulation, self.records, point)
        return self.judge.fit([point, start], self.splits[0].fitted, is_long=True)

    def _choose_hold(self, start: Point) -> Point:
        """Take inputs between samples as fits best, and return the fitted parameters."""
        fits = list[tuple[float, int, Point]]()
        for hold in (0, 1, 2) if self.model.inputs else (0,):
            self.simulation.hold, point, loss = hold, start, np.inf
            for tightness in TIGHTNESS[:2]:
                point, loss = self.search.fit_filtered(point, self.search.filter(point, tightness))
                self.search.measure_sizes(point)
            fits.append((loss, hold, point))
        _, self.simulation.hold, point = min(fits, key=lambda each: each[0])
        return point

    # One further term

    def _extend(self, base: Measured, current: Measured, known: Proposal | None = None) -> Found | None:
        """Return the best further term, None if there is no form of one.

        known: the term as it was found beside other ones, which competes with all forms that are found now
        """
        judged, best = [] if known is None else [known], 0.0
        if known is not None and known.measured is not None:
            best = self.judge.measure_min_gain(base, current, known.measured)
        proposals, filtered, start = self.search.find_proposals(current.points[0], judged)
        judged += self.judge.measure_rivals(base, current, proposals, best)
        if not judged:
            return None
        return Found(*self.judge.judge(base, current, judged, filtered, None if known else start))

    def _settle(self, proposal: Proposal) -> Measured:
        """Return the model with a chosen term, fitted until it settles."""
        points = () if proposal.measured is None else proposal.measured.points
        return self.judge.measure([[point] for point in points], is_long=True)

    def _reconsider(self, base: Measured, current: Measured, found: Sequence[Found]) -> tuple[Measured, list[Found]]:
        """Return the model and its terms, each sought again beside all others, which it may have stood in for."""
        kept = list(found)
        for number in range(len(found)):
            self.progress(f"term {number + 1} beside the others", 0.8)
            each = kept.pop(0)  # the first row of the table, and then the last
            turned = [point.with_terms(point.terms[1:].extend(point.terms[:1])) for point in current.points]
            others = self.judge.measure([[point.with_terms(point.terms[1:])] for point in current.points], is_long=True)
            known = replace(each.proposal, point=turned[0], measured=replace(current, points=tuple(turned)))
            again = self._extend(base, others, known)
            if again is not None and self._is_enough(base, others, again.proposal, True, is_final=True):
                current = self._settle(again.proposal)
                kept.append(again)
            else:
                current = others
        return self._reconsider(base, current, kept) if 0 < len(kept) < len(found) else (current, kept)

    def _is_enough(
        self, base: Measured, current: Measured, proposal: Proposal, is_further: bool, *, is_final: bool
    ) -> bool:
        """Return whether a term removes enough of the error and helps in every split.

        is_final: whether a further term removes enough in every split, as the terms beside it have their final forms;
        before, these may have stood in for it, and only the search's split counts
        """
        if proposal.measured is None:
            return False
        before, after = current.rmse[0, 1], proposal.measured.rmse[0, 1]
        gains = self.judge.measure_gains(base, current, proposal.measured)
        shares = [each.held_out for each in gains if each.split == self.splits[0].name]
        if is_final:
            rest = self.judge.measure_gains(current, current, proposal.measured)
            shares += [
                np.inf if left.held_out >= MIN_REST else each.held_out
                for each, left in zip(gains, rest, strict=True)
                if each.split != self.splits[0].name
            ]
        if is_further and self.judge.name(proposal).kind in NAMELESS:
            return False  # beside a term it follows what that one leaves
        minimum = MIN_FURTHER_REDUCTION if is_further else MIN_REDUCTION
        minimum_gain = MIN_FURTHER_GAIN if is_further else 0.0
        if self.is_white:
            minimum_gain = MIN_FURTHER_GAIN_WHITE if is_further else MIN_GAIN_WHITE
        return (
            after < before * (1.0 - minimum)
            and min(shares, default=0.0) >= minimum_gain
            and min((each.held_out for each in gains), default=0.0) > 0.0
        )

    # The answer

    def _describe(self, final: Point, found: Sequence[Found]) -> tuple[Finding, ...]:
        """Return the findings with the numbers of the final fit, that of the largest gain first.

        The curve is the formula plus what the data still ask for there; its band is that of a curve without a formula.
        """
        if not found:
            return ()
        filtered, findings = self.search.filter(final, 0.0 if self.model.from_rest else TIGHTNESS[1]), list[Finding]()
        for row, each in enumerate(found):
            candidate, term, values = each.proposal.candidate, each.term, final.terms.values[row]
            screened = candidate.screened
            with suppress(*UNCOMPUTABLE):
                screened = screen(filtered, screened.at, len(self.model.states)) or screened
            evaluate = partial(candidate.form.apply, values)
            rest, own = screened.curve, evaluate(screened.nodes)
            curve = Curve(rest.x, own + rest.y, own + rest.low, own + rest.high, evaluate)
            named = name_form(self.simulation, candidate, values)
            chosen = replace(named, kind=term.chosen.kind, probability=term.chosen.probability, gain=term.chosen.gain)
            forms = tuple(chosen if form is term.chosen else form for form in term.forms)
            tested = self._find_ranges(filtered, candidate.screened.at)
            findings.append(Finding(replace(term, chosen=chosen, forms=forms), curve, tested))
        return tuple(sorted(findings, key=lambda each: -each.term.chosen.gain))

    def _find_ranges(self, filtered: Sequence[Filtered], at: Place) -> dict[str, tuple[float, float]]:
        """Return the range of the variables of a term along all records."""
        ranges, names = {}, self.model.variable_names
        for variable in [at.variable, at.factor] if at.factor >= 0 else [at.variable]:
            values = np.concatenate([each.variables[:, variable] for each in filtered])
            ranges[names[variable]] = (float(np.nanmin(values)), float(np.nanmax(values)))
        return ranges


def _is_refused(term: TermClaim) -> bool:
    """Return whether the judge of claims refuses the name of a term."""
    return term.claim.verdict == "unexplained" and term.chosen.kind not in NAMELESS
