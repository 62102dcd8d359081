"""Write the field of a fit as field.toml."""

from pathlib import Path

import numpy as np

from optodrive.core.files import write_text
from optodrive.device.field_file import format_field, strip_toml_specials
from optodrive.lab.calibration.field_fit import FieldFit


def write_field(path: Path, fit: FieldFit, source: str = "") -> None:
    """Write the field of a fit atomically.

    source: plain-text origin of the measurement
    """
    metadata: dict[str, str | float | int] = {
        "source": strip_toml_specials(source),
        "spots": len(fit.spots),
        "outliers": int(fit.outlier.sum()),
        "rms_um": round(1e6 * fit.rms_m, 3) if np.isfinite(fit.rms_m) else 0.0,
        "noise_um": round(1e6 * fit.noise_m, 3),
        "surface_um": round(1e6 * fit.surface_m, 3),
    }
    write_text(path, format_field(fit.field, metadata))
