"""Columns for pyarrow: a missing value is null, and NaN is a number."""

import numpy as np
import pyarrow
import pytest
from softrig_core.arrow import arrow


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        (["a", None, "", "\u00e9"], pyarrow.string()),
        ([True, None, False], pyarrow.bool_()),
        ([1, None, 1 << 60], pyarrow.int64()),
        ([1, None, 0.5], pyarrow.float64()),
        ([None, None], pyarrow.float64()),
    ],
    ids=str,
)
def test_none_in_a_sequence_is_null(values, kind):
    result = arrow(values)
    result.validate(full=True)
    assert (result.type, result.to_pylist(), result.null_count) == (kind, values, values.count(None))


@pytest.mark.parametrize("kind", [np.float64, np.int64, np.uint64, bool], ids=str)
def test_an_array_has_nulls_where_they_are_marked(kind):
    values = np.arange(20).astype(kind)[::2]
    missing = np.arange(10) % 3 == 0
    result = arrow(values, missing)
    result.validate(full=True)
    assert result.to_pylist() == [None if m else v for v, m in zip(values.tolist(), missing.tolist(), strict=True)]
    assert (arrow(values).null_count, arrow(values).to_pylist()) == (0, values.tolist())


def test_nan_is_no_null():
    result = arrow(np.array([1.0, np.nan]))
    assert result.null_count == 0
    assert np.isnan(result.to_numpy()[1])
