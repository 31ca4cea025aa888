"""How new a view is: by angles and by sizes."""

from __future__ import annotations

import numpy as np
import pytest

from vcl_companion.mapping.novelty import novelty_deg


def test_new_is_what_is_seen_from_aside_or_from_twice_as_near() -> None:
    points = np.column_stack([np.full(9, 20.0), np.linspace(-1.0, 1.0, 9), np.zeros(9)])
    origin = np.zeros((9, 3))
    assert novelty_deg(points, np.zeros(3), origin) == 0.0
    turn = np.deg2rad(12.0)
    aside = np.array([20.0 * (1.0 - np.cos(turn)), 20.0 * np.sin(turn), 0.0])
    assert novelty_deg(points, aside, origin) == pytest.approx(12.0, abs=0.3)
    assert novelty_deg(points, np.array([10.0, 0.0, 0.0]), origin) == pytest.approx(15.0, abs=0.3)
    assert novelty_deg(points, np.array([-20.0, 0.0, 0.0]), origin) == pytest.approx(15.0, abs=0.3)
