"""What is wrong with a configuration only as a whole is refused with its file, as what its parser refuses."""

import re

import pytest

from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config, locate_shipped
from optodrive.planning.display_model import DisplayModel

SHIPPED = locate_shipped("display-16.toml").read_text()
WRONG = {
    "limits.galvo_acceleration_rms_max_rad_per_s2": "1000.0",
    "pixel_model.parameters": '"unknown"',
    "panel.capacity_j_per_k": "0.1",
    "scanner.bandwidth_hz": "60.0",
}


@pytest.mark.parametrize("place", WRONG)
def test_a_value_that_no_display_can_have_is_refused_with_its_file(place, tmp_path):
    section, key = place.split(".")
    text = re.sub(rf"(?m)^{key} = .*\n", "", SHIPPED)
    text = text.replace(f"[{section}]\n", "") if section == "panel" else text
    line = f"{key} = {WRONG[place]}\n"
    text = f"{text}\n[panel]\n{line}" if section == "panel" else text.replace(f"[{section}]\n", f"[{section}]\n{line}")
    path = tmp_path / "my-display.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        DisplayModel.from_config(load_config(path))
    assert str(caught.value).startswith((f"{path}: {place}: got ", f"{path}: {section}: got "))


def test_a_configuration_without_a_file_names_its_key():
    config = load_config("display-16")
    table = config.model_dump()
    table["limits"]["galvo_acceleration_rms_max_rad_per_s2"] = 1000.0
    with pytest.raises(InputError) as caught:
        DisplayModel.from_config(type(config).model_validate(table))
    assert str(caught.value).startswith("limits.galvo_acceleration_rms_max_rad_per_s2: got 1000.0")
