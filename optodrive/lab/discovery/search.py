"""Search for the forms of one further term that are worth a free run.

Theory of operation. Filters of several tightness keep the states near the data, although the model is wrong; the one
along which a term removes most is used, and free runs beside it, which alone show what acts on outputs or slowly. All
places, variables and factors are compared by regression (`screening`). The best formulas of the best places are fitted
by their prediction errors. What stays is judged elsewhere, in free runs (`judgement`).
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.lab.discovery.fitting import Point, Simulation, Terms, fit
from optodrive.lab.discovery.forms import CURVE, CURVES
from optodrive.lab.discovery.held_out import MEMORY_FIT, UNCOMPUTABLE, Proposal
from optodrive.lab.discovery.judgement import is_same
from optodrive.lab.discovery.memory import NONE
from optodrive.lab.discovery.model import Record
from optodrive.lab.discovery.screening import (
    Filtered,
    Screened,
    list_memories,
    list_places,
    rank_formulas,
    screen,
    screen_memories,
)

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
PLACES, PLACES_FROM_REST, PLAIN_PLACES, MEMORIES, FORMULAS = 3, 7, 2, 6, 5
"""Places whose formulas are fitted, with a filter and without one, further ones without a factor, and how many of each.

A large effect leads free runs away from where it acts, and the first-order comparison of places with them.
"""
JUDGED, JUDGED_PER_PLACE = 8, 4
"""Formulas that are judged on what is held out."""
EQUAL = 1e-6
"""Squared difference of two functions, relative to the smaller one, by which rounding differs."""
FREE_PLACES, FREE_PER_PLACE = 2, 2
"""Places of free runs, beside those of a filter, of outputs and of memories each, and formulas judged of each."""
REFINEMENTS = 2
"""How often formulas are ranked again along the free runs with the best one."""
MIN_SQUARES = 12.0
"""Squares in units of noise that a curve removes in cross-validation, below which no formula is fitted."""


@dataclass(frozen=True, eq=False)
class Screening:
    """Places in order of evidence along records that one filter follows.

    point: its fitted parameters; is_free: free runs, without a filter
    """

    point: Point
    filtered: list[Filtered]
    ranked: list[Screened]
    is_free: bool


class TermSearch:
    """Search along a part of the records.

    records: with the fold of each sample [m]; noise: [o] of the outputs
    """

    def __init__(
        self, simulation: Simulation, records: Sequence[tuple[Record, IntArray]], noise: FloatArray, is_white: bool
    ) -> None:
        self.simulation, self.records, self.noise, self.is_white = simulation, records, noise, is_white
        self.model = simulation.model
        self.state_sizes = np.ones(len(self.model.states))
        self.rate_sizes = np.ones(len(self.model.states))

    @property
    def tightest(self) -> float:
        """Tightness of the filter nearest to the data, 0 where none is needed."""
        return 0.0 if self.model.from_rest else TIGHTNESS[0]

    def measure_sizes(self, point: Point) -> None:
        """Note rms of states and of their rates along the filtered records."""
        filtered = self.filter(point, self.tightest)
        states = [each.line.states for each in filtered]
        rates = [np.diff(x, axis=0) / np.diff(e.record.t_s)[:, None] for x, e in zip(states, filtered, strict=True)]
        for name, values in (("state_sizes", states), ("rate_sizes", rates)):
            joined = np.concatenate(values)
            joined = joined[np.isfinite(joined).all(axis=1)]
            if len(joined):
                sizes = np.sqrt(np.mean(joined**2, axis=0))
                setattr(self, name, np.where(sizes > 0.0, sizes, 1.0))

    def filter(self, point: Point, tightness: float) -> list[Filtered]:
        """Return the search records, filtered under model errors of this relative size, and linearised."""
        simulation, filtered = self.simulation, []
        for record, fold in self.records:
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

    def fit_filtered(self, point: Point, filtered: Sequence[Filtered], evaluations: int = 15) -> tuple[Point, float]:
        """Return the point that minimises the prediction errors where fitted, with the filters' gains kept."""
        weights = [each.weights * (each.fold >= 0)[:, None] for each in filtered]
        gains, records = [each.line.gains for each in filtered], [each.record for each in filtered]
        return fit(self.simulation, records, point, weights, gains, evaluations)

    def find_proposals(self, point: Point, known: Sequence[Proposal]) -> tuple[list[Proposal], list[Filtered], Point]:
        """Return the forms of a further term that are worth a free run, none that is one of those known.

        Beside them, the records that the best filter follows, and the model without the term there.
        """
        screenings, chosen = self._screen(point), list(known)
        starts = [self.fit_filtered(each.point, each.filtered, 5)[0] for each in screenings]
        for screening, start in zip(screenings, starts, strict=True):
            is_first = screening is screenings[0]
            places = self._choose_places(screening, point.terms, is_first)
            proposals = list[Proposal]()
            for screened in places:
                evaluations = 3 if self.model.from_rest else 5
                if self.model.from_rest and screened.at.memory != NONE:
                    evaluations = MEMORY_FIT  # its first steps find the scale, and gain little
                proposals += self._propose(screened, start, point.terms, screening.filtered, evaluations)
            if self.model.from_rest:
                for _ in range(REFINEMENTS if proposals else 0):
                    with suppress(*UNCOMPUTABLE):
                        proposals += self._refine(point, min(proposals, key=lambda p: p.loss))
            chosen += self._choose(proposals, chosen, JUDGED_PER_PLACE if is_first else FREE_PER_PLACE)
        filtered = screenings[0].filtered if screenings else self.filter(point, self.tightest)
        return chosen[len(known) :], filtered, starts[0] if starts else point

    def _is_change(self, screened: Screened) -> bool:
        time = len(self.model.states) + len(self.model.inputs)
        return time in (screened.at.variable, screened.at.factor)

    def _choose_places(self, screening: Screening, terms: Terms, is_first: bool) -> list[Screened]:
        """Return the places whose formulas are fitted."""
        # The curve of a term shows what its formula lacks at its own place; a curve without one lacks one.
        found = {tuple(row[[0, 2, 3, 4]].tolist()) for row in terms.table if row[1] not in CURVES}
        changes = [each for each in screening.ranked if self._is_change(each)]
        ranked = [each for each in screening.ranked if not self._is_change(each) and each.at.key not in found]
        past = [each for each in ranked if each.at.memory != NONE]
        present = [each for each in ranked if each.at.memory == NONE]
        places = PLACES_FROM_REST if self.model.from_rest else PLACES
        plain = [each for each in present[places:] if each.at.factor < 0]
        shown = [*present[:places], *plain[:PLAIN_PLACES], *past, *changes[:1]] if is_first else []
        if screening.is_free and not self.model.from_rest:
            # Free runs show what acts on outputs, or too slowly for one step.
            outputs = [each for each in present if each.at.place >= len(self.model.states)]
            further = [*outputs[:FREE_PLACES], *past[:FREE_PLACES], *present[:1]]
            shown += [each for each in further if each not in shown]
        return [each for each in shown if not self.is_white or (1.0 - each.loss) * each.total >= MIN_SQUARES]

    def _choose(self, proposals: Sequence[Proposal], known: Sequence[Proposal], per_place: int) -> list[Proposal]:
        """Return the best formulas, few of each place, and of each one curve, and two that change with time.

        One with memory does at least as well as the best one without. None is one of those known under another name.
        """
        chosen, counts, physical = list[Proposal](), dict[tuple[object, ...], int](), 0
        for each in sorted(proposals, key=lambda p: p.loss):
            at, is_curve = each.candidate.screened.at, each.candidate.form.kind == CURVE
            is_change = self._is_change(each.candidate.screened)
            has_memory = at.memory != NONE or self.model.is_follower(at.variable)
            key: tuple[object, ...] = (at.key, is_curve and not is_change)
            room = 2 if is_change else 1 if is_curve else per_place
            if each.candidate.is_constant:
                key, room = ("constant", at.place), 1
            is_plain = not (is_change or is_curve or has_memory)
            if counts.get(key, 0) >= room or (has_memory and physical) or (is_plain and physical >= JUDGED):
                continue
            if not any(is_same(each, other, EQUAL) for other in (*known, *chosen)):
                chosen.append(each)
                counts[key] = counts.get(key, 0) + 1
                physical += is_plain and not each.candidate.is_constant
        return chosen

    def _propose(
        self, screened: Screened, start: Point, terms: Terms, filtered: Sequence[Filtered], evaluations: int
    ) -> list[Proposal]:
        """Return the best formulas of a place, fitted by their prediction errors."""
        proposals = list[Proposal]()
        with suppress(*UNCOMPUTABLE):
            for candidate in rank_formulas(screened, FORMULAS):
                with suppress(*UNCOMPUTABLE):
                    longer = start.with_terms(terms.extend(candidate.build_terms()))
                    proposals.append(Proposal(candidate, *self.fit_filtered(longer, filtered, evaluations)))
        return proposals

    def _refine(self, point: Point, best: Proposal) -> list[Proposal]:
        """Return formulas at the place of the best one, ranked along its own free runs, nearer to the data."""
        frozen = best.point.terms.freeze()
        filtered = self.filter(best.point.with_terms(frozen), 0.0)
        rest = screen(filtered, best.candidate.screened.at, len(self.model.states))
        if rest is None:
            return []
        return self._propose(rest.add_curve(best.evaluate(rest.nodes)), best.point, point.terms, filtered, 20)

    def _screen(self, point: Point) -> list[Screening]:
        """Return the screening with the filter that shows a term most clearly, and that along free runs beside it.

        Each has at least one place that improves anything.
        """
        found = list[Screening]()
        for tightness in (0.0,) if self.model.from_rest else (*TIGHTNESS, 0.0):
            with suppress(*UNCOMPUTABLE):
                refitted, _ = self.fit_filtered(point, self.filter(point, tightness), 5)
                own = Screening(refitted, *self._screen_filtered(refitted, tightness), tightness == 0.0)
                if not own.ranked or own.ranked[0].loss >= 1.0:
                    continue
                if found and 1.0 - own.ranked[0].loss <= LOOSER * (1.0 - found[0].ranked[0].loss):
                    found = [found[0], own] if own.is_free else found[:1]
                else:
                    found = [own]
        return found

    def _screen_filtered(self, point: Point, tightness: float) -> tuple[list[Filtered], list[Screened]]:
        """Return the filtered records, and the places in order of evidence, none where the model diverges."""
        filtered, found = self.filter(point, tightness), list[Screened]()
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
