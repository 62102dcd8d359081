"""Text of quantities."""

import sys
from math import inf, nan

import pytest

from optodrive.core.quantity import format_number, format_quantity


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (6e-5, "s", "60 µs"),
        (2e-6, "m", "2 µm"),
        (0.05, "s", "50 ms"),
        (-2.5e-7, "m", "-250 nm"),
        (999.96e-6, "s", "1 ms"),
        (0.99999, "s", "1 s"),
        (1234.0, "s", "1230 s"),
        (0.3, "1", "0.3"),
        (0.0, "m", "0 m"),
        (12.5, "K", "12.5 K"),
        (2e-3, "K", "0.002 K"),
        (101e-6, "J/K", "101 µJ/K"),
        (1.234e-6, "m/K", "1.23 µm/K"),
        (245.0, "K/W", "245 K/W"),
        (50e3, "Hz", "50 kHz"),
        (0.5, "Hz", "0.5 Hz"),
        (3e-5, "1/K", "3×10⁻⁵ 1/K"),
        (1.23e-12, "m", "0.00123 nm"),
        (1.3e-7, "m^2", "1.3×10⁻⁷ m²"),
        (4.5e8, "", "4.5×10⁸"),
        (nan, "m", "nan m"),
        (inf, "s", "inf s"),
        (sys.float_info.max, "s", "1.8e+308 s"),
        (5e-324, "s", "4.94×10⁻³¹⁵ ns"),
    ],
)
def test_quantities_read_as_people_write_them(value, unit, text):
    assert format_quantity(value, unit) == text


def test_digits_are_significant_ones():
    assert format_quantity(1.23456e-3, "s", 5) == "1.2346 ms"
    assert format_quantity(0.1 + 0.2, "s", 9) == "300 ms"
    assert format_number(123456.0, 2) == "120000"
    assert format_number(sys.float_info.max, 4) == "1.798e+308"
    assert format_number(1e-4) == "0.0001"


@pytest.mark.parametrize("exponent", range(-9, 3))
def test_no_prefixed_quantity_has_a_power_of_ten(exponent):
    for mantissa in (1.0, 9.9949, 9.9951):
        text = format_quantity(mantissa * 10.0**exponent, "s")
        assert "e" not in text
        assert "×" not in text
        assert 0.5 <= float(text.split()[0]) < 1000 or exponent < -8 or exponent > 1
