"""Discovery of the terms that the nominal pixel lacks, in a recording."""

from time import perf_counter

import numpy as np

from optodrive.core.types.discrepancy import InstrumentDisturbance
from optodrive.core.types.measurements import Measurement
from optodrive.lab.diagnosis.dataset import PIXEL_KINDS, build_dataset
from optodrive.lab.diagnosis.detection import ProgressCallback, ignore_progress
from optodrive.lab.diagnosis.fitting import BaseParameterPrior, FitProblem, ModelFit, compute_jitter_sensitivity
from optodrive.lab.diagnosis.instrument_disturbances import find_disturbances, remove_disturbances
from optodrive.lab.diagnosis.model_selection import has_replicate_excess
from optodrive.lab.diagnosis.nominal_fit import BROAD_PRIOR, fit_nominal
from optodrive.lab.diagnosis.prediction import EPSILON
from optodrive.lab.discovery import discover
from optodrive.lab.inference.claim import NOTHING_SOUGHT, TermForm
from optodrive.lab.pixel_discovery.experiment_records import build_records
from optodrive.lab.pixel_discovery.findings import PixelDiscovery, PixelFinding
from optodrive.lab.pixel_discovery.pixel_model import AFTER, LIGHT, OUTPUTS, TEMPERATURE, build_model
from optodrive.lab.pixel_discovery.random_light import find_random_light

OTHER_SIGNALS = "displacement and force, by powers fitted to the temperature alone"
MIN_EXPERIMENTS = 4
"""Experiments below which none can be held out and the others still tell places apart."""


def discover_in_pixel(
    measurement: Measurement,
    prior: BaseParameterPrior = BROAD_PRIOR,
    on_progress: ProgressCallback = ignore_progress,
) -> PixelDiscovery:
    """Return the terms that the nominal pixel lacks, with evidence from experiments that were held out.

    measurement, prior: as of `diagnose`
    """
    began_s = perf_counter()
    on_progress("discovery: noise and nominal model")
    parts = [part for part in build_dataset(measurement).split_subsystems() if set(part.kinds) <= set(PIXEL_KINDS)]
    if not parts:
        return PixelDiscovery((), (), NOTHING_SOUGHT, "", 0.0, 0.0, {}, perf_counter() - began_s)
    problem, base = fit_nominal(parts[0], prior)
    if has_replicate_excess(problem):
        # Before disturbances are subtracted: missed pulses would pass for hops of an instrument.
        found, errors = find_random_light(problem, base)
        if found:
            claimed = found[0].term.claim
            return PixelDiscovery(found, (), claimed, OTHER_SIGNALS, *errors, {}, perf_counter() - began_s)
    # A large effect shifts the sensitivities to jitters, and repeats then differ too; held-out experiments judge it.
    problem, base, disturbances = _subtract_disturbances(problem, base)
    records = build_records(problem, base)
    if len(records) < MIN_EXPERIMENTS:
        return PixelDiscovery((), disturbances, NOTHING_SOUGHT, "", 0.0, 0.0, {}, perf_counter() - began_s)
    measured = [name for name, kind in zip(OUTPUTS, PIXEL_KINDS, strict=True) if kind in problem.data.kinds]
    answer = discover(
        build_model(np.exp(np.array(base.point.base)).tolist(), measured),
        records,
        progress=lambda stage, fraction: on_progress(f"discovery: {stage}"),
    )
    return PixelDiscovery(
        tuple(PixelFinding(_find_node(each.term.chosen), each.term, each.curve) for each in answer.findings),
        disturbances,
        answer.claim,
        f"held-out experiments: {answer.judged_by}",
        answer.base_rmse,
        answer.extended_rmse,
        answer.parameters,
        perf_counter() - began_s,
        max(float(record.inputs[:, 0].max()) for record in records) / EPSILON,
    )


def _subtract_disturbances(
    problem: FitProblem, base: ModelFit
) -> tuple[FitProblem, ModelFit, tuple[InstrumentDisturbance, ...]]:
    """Return noise and nominal fit without disturbances of the instruments, and these."""
    data = problem.data
    sensitivity = compute_jitter_sensitivity(data, base.point, base.prediction)
    disturbances, added = find_disturbances(data, data.value - base.prediction, sensitivity, problem.noise)
    if disturbances:
        problem, base = fit_nominal(remove_disturbances(data, added), problem.prior)
    return problem, base, disturbances


def _find_node(form: TermForm) -> str:
    """Return the node in which a term acts. One of light that acts on a signal is an instrument's."""
    if form.where == "dgas/dt":
        return "gas"
    if form.where == "dabsorber/dt":
        if form.depends_on[0] == "memory":
            return "wall"
        return "light" if LIGHT in form.depends_on or AFTER in form.depends_on else "absorber"
    is_instrument = form.where == TEMPERATURE or form.depends_on[0] in (LIGHT, "t")
    return "sensor" if is_instrument else "membrane"
