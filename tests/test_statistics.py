"""Intervals of means."""

import numpy as np
import pytest

from sb3_uav.common.statistics import confidence_halfwidth


def test_student_intervals_agree_with_tables():
    """Quantiles 2.262 (9 degrees of freedom), 2.228 (10) and 2.042 (30)."""
    for n, quantile in ((10, 2.262), (11, 2.228), (31, 2.042)):
        values = np.arange(float(n))
        assert confidence_halfwidth(values) == pytest.approx(quantile * values.std(ddof=1) / n**0.5, rel=1e-3)
