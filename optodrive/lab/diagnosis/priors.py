"""Prior knowledge of a pixel's base parameters."""

from math import log

from optodrive.core.plausibility import RECORDING, check_plausible
from optodrive.core.types.measurements import Measurement
from optodrive.device.config import Config
from optodrive.lab.diagnosis.fitting import BaseParameterPrior
from optodrive.lab.diagnosis.nominal_fit import BROAD_PRIOR
from optodrive.physics.parameters import load_parameters

DEFAULT_PARAMETER_SET = "calibrated"
R_SIGMA, C_SIGMA, GAS_SIGMA = 0.25, 0.16, 0.4
"""Relative σ: one sample against its row of Table S3; gas, membrane and force against the calibrated set."""


def build_prior(measurement: Measurement, config: Config | None) -> tuple[BaseParameterPrior, float | None]:
    """Return prior and bridge width.

    The prior is centred on the configured pixel, else on the stated bridge width, else it covers the whole of Table S3.
    """
    stated_m = None
    for run in measurement.runs:
        width = run.attributes.get("bridge_width_m")
        if isinstance(width, int | float):
            check_plausible(f"recording: {run.name}: bridge_width_m", float(width), RECORDING["bridge_width_m"])
            stated_m = float(width) if stated_m is None else stated_m
    width_m = stated_m if config is None else stated_m or config.display.bridge_width_m
    if width_m is None:
        return BROAD_PRIOR, None
    parameter_set = DEFAULT_PARAMETER_SET if config is None else config.pixel_model.parameters
    pixel = load_parameters(parameter_set).build_pixel(width_m)
    values = (pixel.r_k_per_w, pixel.c_j_per_k, pixel.tau_g_s, pixel.kappa_m_per_k, pixel.phi_n_per_k)
    sigma = (R_SIGMA, C_SIGMA, GAS_SIGMA, GAS_SIGMA, GAS_SIGMA)
    return BaseParameterPrior(tuple(map(log, values)), sigma), width_m
