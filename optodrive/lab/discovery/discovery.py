"""Discovery: find the terms that a simulation lacks, from measured records.

Theory of operation. 1. The parameters are fitted, first with filters that keep the states near the data, then in free
run. 2. Filters of several tightness give the states; `screening` compares all places, variables and factors on what no
parameter can do, by cross-validation over blocks of samples. 3. The best formulas of the best places are fitted,
together with all parameters, by their prediction errors and then in free run; the simplest of those that do as well as
the best is proposed. 4. It is a finding if it predicts held-out blocks, which no choice has used, better than the model
without it, by more than the noise can explain. 5. Steps 2 to 4 are repeated with the finding in the model.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.lab.discovery.blocks import Data, split, thin
from optodrive.lab.discovery.evidence import compute_probability, find_p_value
from optodrive.lab.discovery.fitting import (
    Point,
    Simulation,
    Terms,
    choose_step,
    estimate_noise,
    fit,
    free_run_rmse,
    output_sizes,
)
from optodrive.lab.discovery.formula_text import build_terms
from optodrive.lab.discovery.model import Discovery, OdeModel, Record
from optodrive.lab.discovery.proposals import Proposal, Step, choose_simplest, describe_steps
from optodrive.lab.discovery.screening import (
    Filtered,
    Screened,
    list_places,
    rank_formulas,
    screen,
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
MAX_TERMS = 4
PLACES, PLACES_FROM_REST, FORMULAS = 3, 7, 5
"""Places whose formulas are fitted, with a filter and without one, and how many of each.

A large effect leads free runs away from where it acts, and the first-order comparison of places with them.
"""
ATTEMPTS = 3
"""Places whose best formula is judged by held-out free runs, one after another, until one predicts them."""
REFINEMENTS = 2
"""How often formulas are ranked again along the free runs with the best one."""
MIN_ERROR = 1e-3
"""Error of a model, relative to the output, that the integration and the inputs' interpolation may cause."""
MIN_REDUCTION, MIN_FURTHER_REDUCTION = 0.005, 0.03
"""Reduction of the held-out RMSE of the first term, and of further ones, below which none is reported."""
MIN_FURTHER_GAIN, MIN_FURTHER_GAIN_WHITE = 0.01, 0.1
"""Share of the first model's avoidable error that a further term removes at least, where noise is estimated and known.

Where it is known a little more than the first formula's form is seen, which is no term of its own.
"""
MIN_GAIN_WHITE = 0.5
"""Share of the avoidable error that the first term removes at least, where noise is known: one that leaves more than it
removes is not what is missing."""
MAX_P = 1e-3
MIN_SQUARES = 12.0
"""Squares in units of noise that a curve removes in cross-validation, below which no formula is fitted."""
Progress = Callable[[str, float], None]


def discover(
    model: OdeModel,
    train: Sequence[Record],
    seed: int = 0,
    progress: Progress = lambda stage, fraction: None,
    held_out: Sequence[int] = (),
) -> Discovery:
    """Return the terms that a simulation lacks, and the model extended by them.

    held_out: numbers of records that are held out as a whole, parts of all records by default; progress: receives the
    name of each stage and the share of the work that is done. seed: kept for methods that draw; this one does not.
    Raises InputError for records that do not fit the model.
    """
    del seed
    if not train:
        raise InputError("train", "no record", "at least one record")
    for record in train:
        record.check(model)
    return _Search(model, split(train, held_out), progress).run()


class _Search:
    """One discovery."""

    def __init__(self, model: OdeModel, data: Data, progress: Progress) -> None:
        self.model, self.data, self.few, self.progress = model, data, thin(data), progress
        progress("compiling", 0.0)
        self.simulation = Simulation(model, hold=0 if model.from_rest else 1)
        self.is_white = all(record.whiten is not None for record in data.records)
        self.sizes = np.ones(len(model.outputs)) if self.is_white else output_sizes(data.records)
        self.noise = np.maximum(estimate_noise(data.records), 1e-4 * self.sizes * (not self.is_white))
        self.min_further_gain = MIN_FURTHER_GAIN_WHITE if self.is_white else MIN_FURTHER_GAIN
        self.state_sizes = np.ones(len(model.states))
        self.rate_sizes = np.ones(len(model.states))

    def run(self) -> Discovery:
        """Return the answer."""
        base = self._fit_base()
        base_rmse = rmse = self._held_out_rmse(base)
        point, found = base, list[Step]()
        for number in range(MAX_TERMS):
            self.progress(f"term {number + 1}", 0.2 + 0.16 * number)
            if float(np.max(rmse / self.sizes)) < MIN_ERROR:
                break
            if found and self._share_left(base_rmse, rmse) < self.min_further_gain:
                break
            min_reduction = MIN_FURTHER_REDUCTION if found else MIN_REDUCTION
            if self.is_white and not found:
                min_reduction = max(min_reduction, MIN_GAIN_WHITE * (1.0 - 1.0 / max(float(rmse[0]), 1.0)))
            proposal, probability = self._extend(point, min_reduction)
            if proposal is None:
                break
            shorter_rmse = self._held_out_rmse(proposal.point)
            floor = np.minimum(1.0 if self.is_white else self.noise, shorter_rmse)
            gain = float(np.max((rmse - shorter_rmse) / np.maximum(base_rmse - floor, 1e-300)))
            if found and gain < self.min_further_gain:
                break
            point, rmse = proposal.point, shorter_rmse
            found.append(Step(proposal, gain, probability))
        self.progress("final fit", 0.85)
        everything = [*self.data.fitted, *self.data.held_out]
        final_base = self._fit_free(base, everything)
        final = self._fit_free(point, everything) if found else final_base
        filtered = self._filter(final, 0.0 if self.model.from_rest else TIGHTNESS[1])
        findings = describe_steps(self.model, final, found, filtered, self.few.fitted)
        self.progress("done", 1.0)
        simulation = self.simulation

        def simulate(record: Record) -> FloatArray:
            record.check(self.model)
            return simulation.run(record, final)[0]

        return Discovery(
            findings,
            float(np.sqrt(np.mean(base_rmse**2))),
            float(np.sqrt(np.mean(rmse**2))),
            dict(zip(simulation.names, final.parameters.tolist(), strict=True)),
            dict(zip(simulation.names, final_base.parameters.tolist(), strict=True)),
            simulate,
        )

    # Base model

    def _fit_base(self) -> Point:
        """Return the fitted parameters, and settle the inputs' interpolation and the integration step."""
        simulation = self.simulation
        dt_s = float(np.median(np.concatenate([np.diff(r.t_s) for r in self.data.records])))
        simulation.h_max = dt_s
        start = Point(simulation.start, Terms.none())
        simulation.h_max = choose_step(simulation, self.few.records, start)
        self._measure_sizes(start)
        if self.model.from_rest:
            return self._fit_free(start, self.data.fitted)
        best: tuple[float, int, Point] | None = None
        for hold in (0, 1, 2) if self.model.inputs else (0,):
            simulation.hold, point, loss = hold, start, np.inf
            for tightness in TIGHTNESS[:2]:
                filtered = self._filter(point, tightness)
                point, loss = self._fit_filtered(point, filtered)
                self._measure_sizes(point)
            if best is None or loss < best[0]:
                best = (loss, hold, point)
            self.progress("parameters", 0.02 + 0.04 * hold)
        assert best is not None  # noqa: S101
        simulation.hold, point = best[1], best[2]
        simulation.h_max = choose_step(simulation, self.few.records, point)
        trials = [start, point, self._fit_free(point, self.data.fitted)]
        masks = self.data.masks(self.data.fitted)
        losses = [np.sum((free_run_rmse(simulation, self.data.records, p, masks) / self.sizes) ** 2) for p in trials]
        return trials[int(np.argmin(np.nan_to_num(losses, nan=np.inf)))]

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
        for record, block in zip(self.few.records, self.few.block, strict=True):
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
            filtered.append(Filtered(record, line, columns, block, weights, *variables))
        return filtered

    def _fit_filtered(self, point: Point, filtered: Sequence[Filtered], evaluations: int = 15) -> tuple[Point, float]:
        """Return the point that minimises the prediction errors in fitted blocks, with the filters' gains kept."""
        masks = self.few.masks(self.few.fitted)
        weights = [each.weights * mask[:, None] for each, mask in zip(filtered, masks, strict=True)]
        gains, records = [each.line.gains for each in filtered], [each.record for each in filtered]
        return fit(self.simulation, records, point, weights, gains, evaluations)

    def _fit_free(self, point: Point, blocks: Sequence[int], evaluations: int = 15) -> Point:
        """Return the point that minimises the error of free runs in these blocks."""
        masks = self.data.masks(blocks)
        weights = [np.outer(mask, 1.0 / self.sizes) for mask in masks]
        return fit(self.simulation, self.data.records, point, weights, evaluations=evaluations)[0]

    def _held_out_rmse(self, point: Point) -> FloatArray:
        """Return the RMSE of free runs in held-out blocks, of each output [o], or of all in units of noise [1]."""
        rmse = free_run_rmse(self.simulation, self.data.records, point, self.data.masks(self.data.held_out))
        return np.sqrt(np.mean(rmse**2, keepdims=True)) if self.is_white else rmse

    def _share_left(self, base_rmse: FloatArray, rmse: FloatArray) -> float:
        """Return the share of the first model's avoidable error that is left, or 1 where noise is estimated."""
        return float((rmse[0] - 1.0) / max(base_rmse[0] - 1.0, 1e-9)) if self.is_white else 1.0

    # One further term

    def _extend(self, point: Point, min_reduction: float) -> tuple[Proposal | None, float]:
        """Return the best further term, None if there is no evidence for one, and its probability."""
        base, filtered, ranked = self._screen(point)
        if not ranked or ranked[0].loss >= 1.0:
            return None, 0.0
        if self.is_white and (1.0 - ranked[0].loss) * ranked[0].total < MIN_SQUARES:
            return None, 0.0
        base, base_loss = self._fit_filtered(base, filtered, 5)
        proposals = []
        places, evaluations = (PLACES_FROM_REST, 3) if self.model.from_rest else (PLACES, 5)
        for screened in ranked[:places]:
            for candidate in rank_formulas(screened, FORMULAS):
                terms = point.terms.extend(build_terms(candidate, screened.nodes))
                longer, loss = self._fit_filtered(base.with_terms(terms), filtered, evaluations)
                proposals.append(Proposal(screened, candidate, longer, loss))
        for _ in range(ATTEMPTS if self.model.from_rest else 1):
            if not proposals:
                break
            if self.model.from_rest:
                for _ in range(REFINEMENTS):
                    proposals += self._refine(point, min(proposals, key=lambda p: p.loss))
            chosen = choose_simplest(proposals, base_loss)
            chosen, p_value = self._judge(point, base, filtered, chosen, min_reduction)
            if p_value <= MAX_P:
                return chosen, compute_probability(p_value)
            proposals = [each for each in proposals if each.candidate.at != chosen.candidate.at]
        return None, 0.0

    def _judge(
        self, point: Point, base: Point, filtered: Sequence[Filtered], chosen: Proposal, min_reduction: float
    ) -> tuple[Proposal, float]:
        """Return the proposal as fitted in free run, and its p value, 1 if held-out free runs gain too little."""
        p_value = find_p_value(self.simulation, self.few, filtered, base, chosen.point)
        if p_value > MAX_P:
            return chosen, 1.0
        # Numbers that fit one step ahead need not fit free runs best; those of a chaotic system fit only the former.
        masks, records = self.data.masks(self.data.fitted), self.data.records
        trials = [chosen.point, self._fit_free(chosen.point, self.data.fitted, 8)]
        losses = [np.sum((free_run_rmse(self.simulation, records, p, masks) / self.sizes) ** 2) for p in trials]
        fitted = replace(chosen, point=trials[int(np.argmin(np.nan_to_num(losses, nan=np.inf)))])
        before, after = self._held_out_rmse(point) / self.sizes, self._held_out_rmse(fitted.point) / self.sizes
        is_better = np.sum(after**2) < np.sum(before**2) * (1.0 - min_reduction) ** 2
        return fitted, p_value if is_better else 1.0

    def _refine(self, point: Point, best: Proposal) -> list[Proposal]:
        """Return formulas at the place of the best one, ranked along its own free runs, nearer to the data."""
        frozen = best.point.terms.freeze()
        filtered = self._filter(best.point.with_terms(frozen), 0.0)
        rest = screen(filtered, best.candidate.at, self.few.fitted, len(self.model.states))
        if rest is None:
            return []
        proposals = []
        for candidate in rank_formulas(rest.add_curve(best.evaluate(rest.nodes)), FORMULAS):
            terms = point.terms.extend(build_terms(candidate, rest.nodes))
            longer, loss = self._fit_filtered(best.point.with_terms(terms), filtered, 20)
            proposals.append(Proposal(best.screened, candidate, longer, loss))
        return proposals

    def _screen(self, point: Point) -> tuple[Point, list[Filtered], list[Screened]]:
        """Return the places in order of evidence, with the filter that shows it most clearly, and its parameters."""
        best: tuple[Point, list[Filtered], list[Screened]] = (point, [], [])
        for tightness in (0.0,) if self.model.from_rest else (*TIGHTNESS, 0.0):
            refitted, _ = self._fit_filtered(point, self._filter(point, tightness), 5)
            filtered, found = self._screen_filtered(refitted, tightness)
            if found and (not best[2] or 1.0 - found[0].loss > LOOSER * (1.0 - best[2][0].loss)):
                best = (refitted, filtered, found)
        return best

    def _screen_filtered(self, point: Point, tightness: float) -> tuple[list[Filtered], list[Screened]]:
        """Return the filtered records, and the places in order of evidence, none where the model diverges."""
        filtered = self._filter(point, tightness)
        if not all(np.isfinite(each.line.predicted).all() for each in filtered):
            return filtered, []
        found = [
            screened
            for place in list_places(self.simulation, filtered, point)
            # A term in an output also changes how strongly a filter follows the data: only free runs judge it.
            if (place.place < len(self.model.states) or tightness == 0.0)
            and (screened := screen(filtered, place, self.few.fitted, len(self.model.states))) is not None
        ]
        return filtered, sorted(found, key=lambda each: each.loss)
