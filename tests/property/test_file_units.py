"""Files of every format with one quantity in a wrong unit are refused in one line, sound ones are not."""

from collections import Counter

import numpy as np
import pytest

from sound_files import FIRST_SEEDS, FORMATS, read_refusal

REFUSED_SHARE = 0.99
DRAWS = [
    ("development", 30),
    pytest.param("report", 200, marks=[pytest.mark.slow, pytest.mark.timeout(1200)]),
]
"""Seeds, and the number of sound and of wrong files of each of the formats."""


@pytest.mark.parametrize(("seeds", "count"), DRAWS)
def test_sound_files_pass_and_wrong_units_are_named(seeds, count, tmp_path):
    refused, missed, tried = [], Counter(), Counter()
    for item in FORMATS:
        for row in range(count):
            rng = np.random.default_rng([FIRST_SEEDS[seeds] + row, FORMATS.index(item)])
            content = item.draw(rng)
            message = read_refusal(item, tmp_path, content)
            if message:
                refused.append((item.name, row, message))
            wrong = item.mistake(rng, content)
            tried[item.name] += 1
            message = read_refusal(item, tmp_path, wrong.content)
            guess = max(message.partition(words)[2] for words in ("likely", "look like", "just beyond it, or in"))
            if wrong.quantity not in message or wrong.unit not in guess or "\n" in message:
                missed[item.name, wrong.quantity, wrong.unit, message] += 1
    print(f"{seeds}: {tried.total()} wrong, {missed.total()} missed; {tried.total()} sound, {len(refused)} refused")
    assert refused == []
    assert missed.total() <= (1.0 - REFUSED_SHARE) * tried.total(), missed
