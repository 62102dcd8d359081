"""What is held out never lies between fitted samples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.core.errors import InputError
from optodrive.lab.discovery import Record
from optodrive.lab.discovery.held_out import FOLDS, choose_splits, prepare_search


def make_record(count, size, name=""):
    t = 0.1 * np.arange(count)
    return Record(t, np.zeros((count, 0)), size * np.sin(t), name=name)


@given(
    st.lists(st.tuples(st.integers(64, 9000), st.floats(0.1, 10.0)), min_size=1, max_size=6, unique_by=lambda x: x[1])
)
def test_no_held_out_sample_lies_between_fitted_ones(drawn):
    records = [make_record(*each) for each in drawn]
    splits = choose_splits(records)
    assert len(splits) >= 2
    for split in splits:
        masks = list(zip(split.fitted, split.held_out, strict=True))
        assert any(mask.any() for mask, _ in masks)
        assert any(held_out.any() for _, held_out in masks)
        for fitted, held_out in masks:
            assert (fitted != held_out).all()
            if len(records) > 1:
                assert fitted.all() or held_out.all()
            else:
                rows = np.flatnonzero(held_out)
                assert rows[0] == 0 or rows[-1] == len(held_out) - 1
                assert np.ptp(rows) == len(rows) - 1
    largest = max(range(len(records)), key=lambda k: np.sqrt(np.mean(records[k].outputs ** 2)))
    if len(records) > 1:
        assert splits[0].fitted[largest].all()  # an effect that it alone shows would not be found
        assert any(split.held_out[largest].all() for split in splits)
    for _, fold in prepare_search(records, splits[0]):
        assert fold.max() < FOLDS
        assert (np.diff(fold[fold >= 0]) >= 0).all()  # folds are long parts


def test_splits_are_named_by_records():
    records = [make_record(100, size, name) for size, name in ((1.0, "monday"), (3.0, "tuesday"), (2.0, ""))]
    names = [split.name for split in choose_splits(records)]
    assert names == ["record 3", "tuesday (the largest)", "monday (the smallest)"]
    with pytest.raises(InputError, match="64 or more"):
        choose_splits([make_record(63, 1.0)])
