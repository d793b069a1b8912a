"""Schedules at points that are known."""

import pytest

from pgkit import controllers


def test_schedules_by_hand():
    straight, wave = controllers.linear(4.0, 2.0), controllers.cosine(4.0, 2.0)
    assert [straight(x) for x in (-1.0, 0.0, 0.25, 1.0, 2.0)] == [4.0, 4.0, 3.5, 2.0, 2.0]
    # 2 + 2 * (1 + cos(pi x)) / 2; cos(pi / 3) = 1/2
    assert [wave(x) for x in (-1.0, 0.0, 1 / 3, 0.5, 1.0, 2.0)] == pytest.approx([4.0, 4.0, 3.5, 3.0, 2.0, 2.0])
    assert controllers.constant(7.0)(0.3) == 7.0
