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
from optodrive.lab.discovery.fitting import Point, Simulation, Terms, choose_step, estimate_noise, fit, output_sizes
from optodrive.lab.discovery.forms import CURVE, CURVES, NAMELESS, Form
from optodrive.lab.discovery.held_out import choose_splits, prepare_search
from optodrive.lab.discovery.judgement import UNCOMPUTABLE, WITHIN_NOISE, Judge, Measured, Proposal, name_form
from optodrive.lab.discovery.memory import NONE
from optodrive.lab.discovery.model import Curve, Discovery, Finding, OdeModel, Record
from optodrive.lab.discovery.screening import (
    Filtered,
    Place,
    Screened,
    list_memories,
    list_places,
    rank_formulas,
    screen,
    screen_memories,
)
from optodrive.lab.inference.claim import MAX_NO_EFFECT, NOTHING_SHOWN, Claim, TermClaim, combine_claims

TIGHTNESS = (0.3, 0.03, 0.003)
"""Model errors that the filters assume, relative to the rms of each state's rate."""
LOOSER = 1.1
"""Share of squares that a term removes, relative to that with a tighter filter, from which a looser filter is used.

States of a loose one are further from the data, and the regression along them is only of first order.
"""
START_UNCERTAINTY = 0.3
"""Standard deviation of the states at the start of a record, relative to their rms."""
RATE_MEMORY = 10.0
"""Samples over which a model error persists that the filters assume."""
MAX_TERMS = 4
PLACES, PLACES_FROM_REST, PLAIN_PLACES, MEMORIES, FORMULAS = 3, 7, 2, 6, 5
"""Places whose formulas are fitted, with a filter and without one, further ones without a factor, and how many of each.

A large effect leads free runs away from where it acts, and the first-order comparison of places with them.
"""
JUDGED, JUDGED_PER_PLACE = 8, 4
"""Formulas that are judged on what is held out."""
FREE_PLACES, FREE_PER_PLACE = 2, 2
"""Places of free runs, beside those of a filter, of outputs and of memories each, and formulas judged of each."""
REFINEMENTS = 2
"""How often formulas are ranked again along the free runs with the best one."""
MIN_ERROR = 1e-3
"""Error of a model, relative to the output, that the integration and the inputs' interpolation may cause."""
MIN_REDUCTION, MIN_FURTHER_REDUCTION = 0.005, 0.03
"""Reduction of the held-out RMSE of the first term, and of further ones, below which none is reported."""
MIN_FURTHER_GAIN, MIN_FURTHER_GAIN_WHITE = 0.05, 0.1
"""Share of the first model's avoidable error that a further term removes at least, where noise is estimated and known.

Where it is known a little more than the first formula's form is seen, which is no term of its own.
"""
MIN_GAIN_WHITE = 0.5
"""Share of the avoidable error that the first term removes at least, where noise is known: one that leaves more than it
removes is not what is missing."""
MIN_SQUARES = 12.0
"""Squares in units of noise that a curve removes in cross-validation, below which no formula is fitted."""
MIN_MISSING = 1.0 - MAX_NO_EFFECT
Progress = Callable[[str, float], None]
Search = tuple[Point, list[Filtered], list[Screened]]
"""Parameters, filtered records and places in order of evidence."""


def discover(model: OdeModel, train: Sequence[Record], progress: Progress = lambda stage, fraction: None) -> Discovery:
    """Return the terms that a simulation lacks, and the model extended by them.

    progress: receives the name of each stage and the share of the work that is done. Raises InputError for records that
    do not fit the model.
    """
    if not train:
        raise InputError("train", "no record", "at least one record")
    for record in train:
        record.check(model)
    return _Search(model, train, progress).run()


@dataclass(frozen=True, eq=False)
class Found:
    """A term by which the model is extended, the claim on it, all forms that were tried, and where they were found."""

    proposal: Proposal
    term: TermClaim
    tried: Sequence[Proposal]
    filtered: Sequence[Filtered]


class _Search:
    """One discovery."""

    def __init__(self, model: OdeModel, records: Sequence[Record], progress: Progress) -> None:
        self.model, self.records, self.progress = model, records, progress
        self.splits = choose_splits(records)
        self.few = prepare_search(records, self.splits[0])
        progress("compiling", 0.0)
        self.simulation = Simulation(model, hold=0 if model.from_rest else 1)
        self.is_white = all(record.whiten is not None for record in records)
        self.noise = np.ones(len(model.outputs))  # in its own units where records whiten their errors
        if not self.is_white:
            self.noise = np.maximum(estimate_noise(records), 1e-4 * output_sizes(records))
        self.judge = Judge(self.simulation, records, self.splits, self.noise)
        self.state_sizes = np.ones(len(model.states))
        self.rate_sizes = np.ones(len(model.states))

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
                break
            if (
                not self._is_enough(base, current, further.proposal, bool(found), is_final=False)
                or further.term.missing < MIN_MISSING
            ):
                claims += [] if found else [further.term.claim]
                break
            current = further.proposal.measured or current
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
        everything = [np.full(len(record.t_s), True) for record in self.records]
        final_base = self.judge.fit([base.points[0]], everything, 15)
        final = self.judge.fit([current.points[0]], everything, 15) if found else final_base
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
        self._measure_sizes(start)
        if self.model.from_rest:
            return self.judge.fit([start], self.splits[0].fitted, 15)
        point = self._choose_hold(start)
        simulation.h_max = choose_step(simulation, self.records, point)
        return self.judge.fit([point, start], self.splits[0].fitted, 15)

    def _choose_hold(self, start: Point) -> Point:
        """Take inputs between samples as fits best, and return the fitted parameters."""
        fits = list[tuple[float, int, Point]]()
        for hold in (0, 1, 2) if self.model.inputs else (0,):
            self.simulation.hold, point, loss = hold, start, np.inf
            for tightness in TIGHTNESS[:2]:
                point, loss = self._fit_filtered(point, self._filter(point, tightness))
                self._measure_sizes(point)
            fits.append((loss, hold, point))
        _, self.simulation.hold, point = min(fits, key=lambda each: each[0])
        return point

    def _measure_sizes(self, point: Point) -> None:
        """Note rms of states and of their rates along the filtered records."""
        filtered = self._filter(point, 0.0 if self.model.from_rest else TIGHTNESS[0])
        states = [each.line.states for each in filtered]
        rates = [np.diff(x, axis=0) / np.diff(e.record.t_s)[:, None] for x, e in zip(states, filtered, strict=True)]
        for name, values in (("state_sizes", states), ("rate_sizes", rates)):
            joined = np.concatenate(values)
            joined = joined[np.isfinite(joined).all(axis=1)]
            if len(joined):
                sizes = np.sqrt(np.mean(joined**2, axis=0))
                setattr(self, name, np.where(sizes > 0.0, sizes, 1.0))

    def _filter(self, point: Point, tightness: float) -> list[Filtered]:
        """Return the search records, filtered under model errors of this relative size, and linearised."""
        simulation, filtered = self.simulation, []
        for record, fold in self.few:
            dt_s = float(np.median(np.diff(record.t_s)))
            noise_rate = (tightness * self.rate_sizes) ** 2 * RATE_MEMORY * dt_s
            start_sigma = (0.0 if self.model.from_rest else START_UNCERTAINTY) * self.state_sizes
            line, start = simulation.linearise(record, point, self.state_sizes, noise_rate, self.noise**2, start_sigma)
            measured = np.isfinite(record.outputs) & np.isfinite(line.predicted) & (line.variance > 0.0)
            if self.is_white and tightness == 0.0:
                weights = measured.astype(np.float64)
            else:
                record = replace(record, whiten=None)  # the filter's errors are white by themselves
                weights = np.where(measured, 1.0 / np.sqrt(np.where(measured, line.variance, 1.0)), 0.0)
            columns = line.propagate(line.forcing, line.direct, start)
            variables = simulation.list_variables(record, point, line.states)
            filtered.append(Filtered(record, line, columns, fold, weights, *variables))
        return filtered

    def _fit_filtered(self, point: Point, filtered: Sequence[Filtered], evaluations: int = 15) -> tuple[Point, float]:
        """Return the point that minimises the prediction errors where fitted, with the filters' gains kept."""
        weights = [each.weights * (each.fold >= 0)[:, None] for each in filtered]
        gains, records = [each.line.gains for each in filtered], [each.record for each in filtered]
        return fit(self.simulation, records, point, weights, gains, evaluations)

    # One further term

    def _extend(self, base: Measured, current: Measured) -> Found | None:
        """Return the best further term, None if there is no form of one."""
        point = current.points[0]
        searches = self._screen(point)
        time = len(self.model.states) + len(self.model.inputs)
        # The curve of a term shows what its formula lacks at its own place; a curve without one lacks one.
        found = {tuple(row[[0, 2, 3, 4]].tolist()) for row in point.terms.table if row[1] not in CURVES}
        judged, starts = list[Proposal](), list[Point]()
        for number, (start, filtered, ranked) in enumerate(searches):
            changes = [each for each in ranked if time in (each.at.variable, each.at.factor)]
            ranked = [each for each in ranked if each not in changes and each.at.key not in found]
            places, evaluations = (PLACES_FROM_REST, 3) if self.model.from_rest else (PLACES, 5)
            past = [each for each in ranked if each.at.memory != NONE]
            present = [each for each in ranked if each.at.memory == NONE]
            plain = [each for each in present[places:] if each.at.factor < 0]
            shown = present[:places] + plain[:PLAIN_PLACES] + past + changes[:1]
            if number > 0:
                # Beside a filter, free runs show what acts on outputs, or too slowly for one step.
                outputs = [each for each in present if each.at.place >= len(self.model.states)]
                shown = outputs[:FREE_PLACES] + past[:FREE_PLACES] + present[:1]
            if self.is_white:
                shown = [each for each in shown if (1.0 - each.loss) * each.total >= MIN_SQUARES]
            starts.append(self._fit_filtered(start, filtered, 5)[0])
            proposals = list[Proposal]()
            for screened in shown:
                proposals += self._propose(screened, starts[-1], point.terms, filtered, evaluations)
            if self.model.from_rest:
                for _ in range(REFINEMENTS if proposals else 0):
                    with suppress(*UNCOMPUTABLE):
                        proposals += self._refine(point, min(proposals, key=lambda p: p.loss))
            known = {_identify(each) for each in judged}
            room = JUDGED_PER_PLACE if number == 0 else FREE_PER_PLACE
            best = self._choose_judged(proposals, {id(screened) for screened in changes}, room)
            judged += [each for each in best if _identify(each) not in known]
        measured = self._measure(base, current, judged)
        if not measured:
            return None
        filtered = searches[0][1]
        chosen, term = self.judge.judge(base, current, measured, filtered, starts[0])
        return Found(chosen, term, judged, filtered)

    def _propose(
        self, screened: Screened, start: Point, terms: Terms, filtered: Sequence[Filtered], evaluations: int
    ) -> list[Proposal]:
        """Return the best formulas of a place, fitted by their prediction errors."""
        proposals = list[Proposal]()
        with suppress(*UNCOMPUTABLE):
            for candidate in rank_formulas(screened, FORMULAS):
                with suppress(*UNCOMPUTABLE):
                    longer = start.with_terms(terms.extend(candidate.build_terms()))
                    proposals.append(Proposal(candidate, *self._fit_filtered(longer, filtered, evaluations)))
        return proposals

    def _refine(self, point: Point, best: Proposal) -> list[Proposal]:
        """Return formulas at the place of the best one, ranked along its own free runs, nearer to the data."""
        frozen = best.point.terms.freeze()
        filtered = self._filter(best.point.with_terms(frozen), 0.0)
        rest = screen(filtered, best.candidate.screened.at, len(self.model.states))
        if rest is None:
            return []
        return self._propose(rest.add_curve(best.evaluate(rest.nodes)), best.point, point.terms, filtered, 20)

    @staticmethod
    def _choose_judged(proposals: Sequence[Proposal], changes: set[int], per_place: int) -> list[Proposal]:
        """Return the best formulas, few of each place, and of each one curve, and two that change with time.

        One with memory does at least as well as the best one without.
        """
        chosen, counts, physical = list[Proposal](), dict[tuple[object, ...], int](), 0
        for each in sorted(proposals, key=lambda p: p.loss):
            at, is_curve = each.candidate.screened.at, each.candidate.form.kind == CURVE
            is_change, has_memory = id(each.candidate.screened) in changes, at.memory != NONE
            key: tuple[object, ...] = (at.key, is_curve and not is_change)
            room = 2 if is_change else 1 if is_curve else per_place
            if each.candidate.is_constant:
                key, room = ("constant", at.place), 1
            is_plain = not (is_change or is_curve or has_memory)
            if counts.get(key, 0) < room and not (has_memory and physical) and (not is_plain or physical < JUDGED):
                chosen.append(each)
                counts[key] = counts.get(key, 0) + 1
                physical += is_plain and not each.candidate.is_constant
        return chosen

    def _measure(
        self, base: Measured, current: Measured, proposals: Sequence[Proposal], best: float = 0.0
    ) -> list[Proposal]:
        """Return the proposals as measured in free runs, fitted in every split from the model without their term."""
        rivals = []
        for each in proposals:
            term = each.point.terms[-1:]
            starts = [[point.with_terms(point.terms.extend(term))] for point in current.points]
            starts[0].insert(0, each.point)
            rivals.append((each, starts))
        return self.judge.measure_rivals(base, current, rivals, best)

    def _reconsider(self, base: Measured, current: Measured, found: Sequence[Found]) -> tuple[Measured, list[Found]]:
        """Return the model and its terms, each judged again beside all others, which may have stood in for it."""
        kept = list(found)
        for number in range(len(found)):
            self.progress(f"term {number + 1} beside the others", 0.8)
            each = kept.pop(0)  # the first row of the table, and then the last
            turned = [[point.with_terms(point.terms[1:].extend(point.terms[:1]))] for point in current.points]
            others = self.judge.measure([[point.with_terms(point.terms[1:])] for point in current.points])
            first = turned[0][0]
            trials = [
                replace(trial, point=first.with_terms(first.terms[:-1].extend(trial.point.terms[-1:])))
                for trial in each.tried
                if trial.candidate is not each.proposal.candidate
            ]
            own = self.judge.measure(turned)
            best = self.judge.measure_min_gain(base, others, own)
            judged = [replace(each.proposal, point=first, measured=own), *self._measure(base, others, trials, best)]
            chosen, term = self.judge.judge(base, others, judged, each.filtered, None)
            if self._is_enough(base, others, chosen, True, is_final=True):
                current = chosen.measured or current
                kept.append(replace(each, proposal=chosen, term=term))
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
        shares = [each.held_out for each in gains if is_final or each.split == self.splits[0].name]
        if is_further and proposal.candidate.form.kind == CURVE:
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

    def _screen(self, point: Point) -> list[Search]:
        """Return the search with the filter that shows a term most clearly, and that along free runs beside it.

        Each has its fitted parameters and the places in order of evidence, and at least one that improves anything.
        """
        best, free = list[Search](), list[Search]()
        for tightness in (0.0,) if self.model.from_rest else (*TIGHTNESS, 0.0):
            with suppress(*UNCOMPUTABLE):
                refitted, _ = self._fit_filtered(point, self._filter(point, tightness), 5)
                filtered, found = self._screen_filtered(refitted, tightness)
                if not found or found[0].loss >= 1.0:
                    continue
                if not best or 1.0 - found[0].loss > LOOSER * (1.0 - best[0][2][0].loss):
                    best = [(refitted, filtered, found)]
                if tightness == 0.0:
                    free = [(refitted, filtered, found)]
        return best if free and best[0][1] is free[0][1] else best + free

    def _screen_filtered(self, point: Point, tightness: float) -> tuple[list[Filtered], list[Screened]]:
        """Return the filtered records, and the places in order of evidence, none where the model diverges."""
        filtered, found = self._filter(point, tightness), list[Screened]()
        if not all(np.isfinite(each.line.predicted).all() for each in filtered):
            return filtered, []
        n = len(self.model.states)
        # A term in an output also changes how strongly a filter follows the data: only free runs judge it.
        places = [each for each in list_places(self.simulation, filtered, point) if each.place < n or tightness == 0.0]
        past = screen_memories(filtered, list_memories(self.simulation, filtered, places), n)
        for place in places + past[:MEMORIES]:
            with suppress(*UNCOMPUTABLE):
                screened = screen(filtered, place, n)
                found += [] if screened is None or not np.isfinite(screened.loss) else [screened]
        return filtered, sorted(found, key=lambda each: each.loss)

    # The answer

    def _describe(self, final: Point, found: Sequence[Found]) -> tuple[Finding, ...]:
        """Return the findings with the numbers of the final fit, that of the largest gain first.

        The curve is the formula plus what the data still ask for there; its band is that of a curve without a formula.
        """
        if not found:
            return ()
        filtered, findings = self._filter(final, 0.0 if self.model.from_rest else TIGHTNESS[1]), list[Finding]()
        for row, each in enumerate(found):
            candidate, term, values = each.proposal.candidate, each.term, final.terms.values[row]
            screened = candidate.screened
            with suppress(*UNCOMPUTABLE):
                screened = screen(filtered, screened.at, len(self.model.states)) or screened
            evaluate = partial(_evaluate, candidate.form, values)
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


def _identify(proposal: Proposal) -> tuple[object, ...]:
    """Return the place and the form of a proposal."""
    return proposal.candidate.screened.at.key, proposal.candidate.form.text


def _evaluate(form: Form, values: FloatArray, z: FloatArray) -> FloatArray:
    """Return a formula with its numbers [3] at z [n]."""
    return np.asarray(values[0] * form.evaluate(z, values[1], values[2]))
