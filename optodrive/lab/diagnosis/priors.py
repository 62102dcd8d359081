"""What is known of a pixel before its recording is looked at."""

from math import log

from optodrive.core.types.measurements import Measurement
from optodrive.device.config import Config
from optodrive.lab.diagnosis.fitting import Prior
from optodrive.lab.diagnosis.nominal_fit import BROAD, EPSILON
from optodrive.physics.parameters import load_parameters
from optodrive.physics.pixel import Pixel

TABLE = "calibrated"
R_SIGMA, C_SIGMA, GAS_SIGMA = 0.25, 0.16, 0.4
"""Relative: one sample against its row of Table S3; gas, membrane and force against the calibrated set."""


def prior_of(measurement: Measurement, config: Config | None) -> tuple[Prior, float, float | None]:
    """Prior, epsilon and bridge width: the config's pixel, else the recording's width, else the whole of Table S3."""
    widths = [run.attributes.get("bridge_width_m") for run in measurement.runs]
    stated = next((float(width) for width in widths if isinstance(width, (int, float))), None)
    if config is not None:
        width_m = stated or config.display.bridge_width_m
        return _around(load_parameters(config.pixel_model.parameters).pixel(width_m)), EPSILON, width_m
    if stated is not None:
        return _around(load_parameters(TABLE).pixel(stated)), EPSILON, stated
    return BROAD, EPSILON, None


def _around(pixel: Pixel) -> Prior:
    values = (pixel.r_k_per_w, pixel.c_j_per_k, pixel.tau_g_s, pixel.kappa_m_per_k, pixel.phi_n_per_k)
    return Prior(tuple(log(value) for value in values), (R_SIGMA, C_SIGMA, GAS_SIGMA, GAS_SIGMA, GAS_SIGMA))
