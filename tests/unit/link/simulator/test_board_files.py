"""The simulated board's limits file, script file and faulty link."""

import pytest

from optodrive.core.errors import InputError
from optodrive.link.simulator.guards import DEFAULT_LIMITS, SETTING_RANGES, BoardSettings, load_settings, tighten
from optodrive.link.simulator.pseudo_terminal import FaultyLink
from optodrive.link.simulator.script import ACTIONS, ScriptStep, load_script


@pytest.fixture
def file(tmp_path):
    def write(text):
        path = tmp_path / "file.toml"
        path.write_text(text)
        return path

    return write


def test_limits_file_replaces_what_it_names(file):
    settings = load_settings(
        file('max_on_us = 20000\nlease_ms = 50\nuid = "00112233445566778899AABB"\nkey_edge = true')
    )
    assert (settings.limits.max_on_us, settings.limits.lease_ms, settings.limits.max_duty) == (
        20000,
        50,
        DEFAULT_LIMITS.max_duty,
    )
    assert (settings.uid, settings.key_edge) == ("00112233445566778899AABB", True)
    assert load_settings(file("")) == BoardSettings()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("max_on = 1", "nearest is 'max_on_us'"),
        ("max_on_us = 65536", "max_on_us: got 65536, expected a whole number from 0 to 65535"),
        ("spot_uj = 4294967296", "from 0 to 4294967295"),
        ("lease_ms = -1", "lease_ms: got -1"),
        ("lease_ms = 1.5", "lease_ms: got 1.5"),
        ("lease_ms = true", "lease_ms: got True"),
        ("cell_codes = 0", "from 1 to 65535"),
        ("queue_points = 23", "from 24 to 65535"),
        ('uid = "abc"', "24 hexadecimal digits"),
        ("uid = 5", "24 hexadecimal digits"),
        ("key_edge = 1", "true or false"),
        ("max_on_us = ", "valid TOML"),
    ],
)
def test_limits_file_that_cannot_be_meant(file, text, says):
    with pytest.raises(InputError, match=says) as caught:
        load_settings(file(text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [name for name in SETTING_RANGES if hasattr(DEFAULT_LIMITS, name)])
def test_every_limit_takes_the_ends_of_its_field(file, name):
    for value in SETTING_RANGES[name]:
        limits = load_settings(file(f"{name} = {value}")).limits
        assert limits.parse(limits.encode_body()) == limits
        assert getattr(limits, name) == value


def test_tightened_is_the_same_whoever_is_first():
    other = type(DEFAULT_LIMITS)(
        *(value + (-1) ** k if value else 1 for k, value in enumerate(vars(DEFAULT_LIMITS).values()))
    )
    once = tighten(DEFAULT_LIMITS, other)
    assert tighten(once, other) == once
    assert tighten(once, DEFAULT_LIMITS) == once
    assert once.full_power_uw == DEFAULT_LIMITS.full_power_uw


def test_script_is_sorted_and_has_defaults(file):
    steps = load_script(
        file(
            '[[step]]\nat_s = 2\ndo = "flip_bits"\nrate = 0.5\n'
            '[[step]]\nat_s = 1.5\nset = "key"\n[[step]]\nat_s = 3\ndo = "hang"\nfrom = "light"\n'
            '[[step]]\nfrom = "signal"\ndo = "reset"'
        )
    )
    assert steps == [
        ScriptStep(0.0, "do", "reset", rate=0.01, origin="signal"),
        ScriptStep(1.5, "set", "key", value=False, rate=0.01),
        ScriptStep(2.0, "do", "flip_bits", rate=0.5),
        ScriptStep(3.0, "do", "hang", rate=0.01, origin="light"),
    ]
    assert load_script(file("")) == []


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[[step]]\nset = "key"', "step 0: at_s: missing"),
        ('[[step]]\nat_s = -1\nset = "key"', "at_s: got -1"),
        ('[[step]]\nat_s = nan\nset = "key"', "at_s: got nan"),
        ('[[step]]\nat_s = "1"\nset = "key"', "at_s: got '1'"),
        ('[[step]]\nat_s = 1\nset = "interlok"', "nearest is 'interlock'"),
        ('[[step]]\nat_s = 1\ndo = "explode"', "do: got 'explode'"),
        ("[[step]]\nat_s = 1\ndo = [1]", "do: got"),
        ("[[step]]\nat_s = 1", "do: missing"),
        ('[[step]]\nat_s = 1\nset = "key"\nvalue = 1', "true or false"),
        ('[[step]]\nat_s = 1\nset = "key"\nvlaue = true', "nearest is 'value'"),
        ('[[step]]\nat_s = 1\nset = "key"\ndo = "reset"', "got 'do'"),
        ('[[step]]\nat_s = 1\ndo = "flip_bits"\nrate = 2', "rate: got 2"),
        ('[[step]]\nat_s = 1\ndo = "hang"\nfrom = "dawn"', "from: got 'dawn'"),
        ('[[step]]\nat_s = 1\ndo = "hang"\nfrom = "signal"', "step 0: got 'at_s'"),
        ('[step]\nat_s = 1\ndo = "reset"', "two brackets"),
        ("steps = 1", "nothing but"),
    ],
)
def test_script_that_cannot_be_meant(file, text, says):
    with pytest.raises(InputError, match=says) as caught:
        load_script(file(text))
    assert "\n" not in str(caught.value)


def test_link_breaks_down_and_is_repaired():
    link, data = FaultyLink(seed=1), bytes(range(256)) * 40
    assert link.transmit(data) == data
    link.inject_fault("flip_bits", 0.01)
    flipped = link.transmit(data)
    wrong = [a ^ b for a, b in zip(data, flipped, strict=True) if a != b]
    assert 60 < len(wrong) < 150
    assert all(bits.bit_count() == 1 for bits in wrong)
    link.repair()
    link.inject_fault("drop_bytes", 0.01)
    assert 60 < len(data) - len(link.transmit(data)) < 150
    link.inject_fault("hang")
    assert link.transmit(data) == b""
    link.repair()
    assert link.transmit(data) == data
    with pytest.raises(ValueError, match="explode"):
        link.inject_fault("explode")


def test_every_way_to_break_down_can_be_scripted():
    link = FaultyLink()
    for how in ACTIONS[:3]:
        link.inject_fault(how, 0.1)
