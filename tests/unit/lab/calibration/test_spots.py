"""The file of a calibrated field is read again for every scanner that a configuration describes."""

import pytest

from displays import DISPLAYS
from optodrive.device.config import Config
from optodrive.device.field_geometry import GEOMETRY_RANGES, FieldGeometry
from optodrive.lab.calibration.spots import FieldPrior


@pytest.mark.parametrize("name", ["display-1", "display-1511"])
@pytest.mark.parametrize("focal_length_m", [0.05, 0.22, 0.8])
def test_what_tolerances_permit_is_plausible(name, focal_length_m):
    table = DISPLAYS[name].config.model_dump()
    range_rad = min(0.75, 0.02 + 0.1 / (2.0 * focal_length_m) * (name == "display-1511"))
    table["scanner"] |= {"focal_length_m": focal_length_m, "range_rad": range_rad}
    if name == "display-1511":
        table["display"]["pitch_m"] = 2.5e-3
    prior = FieldPrior.from_config(Config.model_validate(table))
    for key, mean, sigma in zip(FieldGeometry._fields, prior.mean, prior.sigma, strict=True):
        plausible = GEOMETRY_RANGES.get(key)
        assert plausible is None or abs(mean) + 4.0 * sigma <= plausible.high, key
