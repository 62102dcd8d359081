"""The laser's power over its duty: both ways, the weakest pulse, and tables of power meters."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.cli.main import run
from optodrive.core.errors import InputError
from optodrive.core.laser_power import (
    compute_duty,
    compute_power_w,
    find_min_power_w,
    find_proportion_excess,
    find_proportional_power_w,
    read_power_table,
)
from optodrive.device.config_file import load_config, locate_shipped
from optodrive.link.protocol.quantisation import DUTY_MAX

TABLE = "duty,power_W\n0,0.001\n0.05,0.002\n0.1,0.11\n0.25,0.52\n0.5,1.31\n0.75,1.95\n1,2.41\n"


@st.composite
def curves(draw):
    """Sample a curve with up to some rows without light, and its full power."""
    rises = draw(st.lists(st.floats(1e-3, 1.0), min_size=2, max_size=6))
    steps = draw(st.lists(st.floats(1e-2, 1.0), min_size=len(rises), max_size=len(rises)))
    dark = draw(st.integers(0, 1))
    powers = np.cumsum(np.where(np.arange(len(rises)) < dark, 0.0, rises))
    duties = np.cumsum(steps) / np.sum(steps)
    duties[-1] = 1.0
    rows = [(0.0, 0.0), *zip(duties.tolist(), powers.tolist(), strict=True)]
    return rows, float(powers[-1]), (rows[2][1] if dark else 0.0)


@given(curves(), st.integers(0, DUTY_MAX))
def test_a_step_of_the_duty_survives_the_way_to_power_and_back(curve, code):
    rows, full_w, threshold_w = curve
    power_w = compute_power_w(np.array(code / DUTY_MAX), full_w, rows)
    back = int(np.floor(float(compute_duty(power_w, full_w, rows)) * DUTY_MAX * (1 + 1e-12) + 1e-9))
    assert back in ({code} if power_w > 0.0 else {0})
    weakest_w = find_min_power_w(full_w, rows, threshold_w, DUTY_MAX)
    assert threshold_w <= weakest_w <= full_w
    counted_w = find_proportional_power_w(full_w, rows)
    assert power_w <= counted_w * code / DUTY_MAX * (1 + 1e-12)
    if power_w >= weakest_w:
        excess = find_proportion_excess(full_w, rows, weakest_w)
        assert counted_w * code / DUTY_MAX <= excess * power_w * (1 + 1e-9)


def test_a_table_becomes_a_configuration(tmp_path, capsys):
    meter, part = tmp_path / "meter.csv", tmp_path / "laser.toml"
    meter.write_text("# 2026-11-29\nDuty;Power [mW]\n1;2410\n0,75;1950\n0,5;1310\n0,25;520\n0,1;110\n0,05;2\n0;1\n")
    assert run(["calibrate", "power", str(meter), "--out", str(part)]) == 0
    assert "2.41 W at full duty" in capsys.readouterr().out
    text = locate_shipped("display-16.toml").read_text()
    keys = part.read_text().split("[laser]\n")[1]
    config = tmp_path / "c.toml"
    text = "\n".join(line for line in text.splitlines() if not line.startswith("max_power_w"))
    config.write_text(text.replace("[laser]\n", f"[laser]\n{keys}"))
    laser = load_config(config).laser
    assert (laser.max_power_w, laser.threshold_w) == (2.41, 0.11)
    assert laser.curve == ((0, 0), (0.05, 0), (0.1, 0.11), (0.25, 0.52), (0.5, 1.31), (0.75, 1.95), (1, 2.41))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("0.5,1.31", "0.5,0.3"), "duty 0.5: got 0.3 W, expected more than 0.52 W, the power at duty 0.25"),
        (("0.75,1.95", "0.75,2.5"), "duty 1: got 2.41 W, expected more than 2.5 W, the power at duty 0.75"),
        (("0.5,1.31", "0.25,1.31"), "duty 0.25: got two rows, expected each duty once"),
        (("0,0.001", "0,0.2"), "duty 0: got 0.2 W, expected no light at duty 0: zero the meter"),
        (("1,2.41", "1,2410"), "power_W: got 2410.0, expected 0 to 60; this value is likely in mW"),
        (("1,2.41", "100,2.41"), "duty: got 100.0, expected 0 to 1; this value is likely in %"),
        (("1,2.41", "0.9,2.41"), "duty: got 0.9, expected a last row at duty 1 with light"),
        (("0.5,1.31", "0.5,nan"), "row 6: power_W: got nan, expected a finite number"),
        (("0.5,1.31", "half,1.31"), "row 6: duty: got 'half', expected a number"),
        (("0.1,0.11\n0.25,0.52\n0.5,1.31\n", ""), "got 4 rows, expected at least 5 duties"),
        (("power_W", "light"), "expected a column power_W too"),
    ],
)
def test_a_bad_table_is_refused_in_one_line(tmp_path, capsys, change, says):
    meter = tmp_path / "meter.csv"
    assert change[0] in TABLE
    meter.write_text(TABLE.replace(*change, 1))
    with pytest.raises(InputError):
        read_power_table(meter)
    assert run(["calibrate", "power", str(meter)]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
