"""Write the field of a fit as field.toml."""

from pathlib import Path

import numpy as np

from optodrive.core.files import written_whole
from optodrive.device.field_file import field_toml, plain
from optodrive.lab.calibration.field_fit import FieldFit


def write_field(path: Path, fit: FieldFit, source: str = "") -> None:
    """Write the field of a fit, whole or not at all. source: what it was measured from, in words."""
    about: dict[str, str | float | int] = {
        "source": plain(source),
        "spots": len(fit.spots),
        "outliers": int(fit.outlier.sum()),
        "rms_um": round(1e6 * fit.rms_m, 3) if np.isfinite(fit.rms_m) else 0.0,
        "noise_um": round(1e6 * fit.noise_m, 3),
        "surface_um": round(1e6 * fit.surface_m, 3),
    }
    with written_whole(path) as temporary:
        temporary.write_text(field_toml(fit.field, about), encoding="utf-8")
